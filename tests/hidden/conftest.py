"""`plant`: writes a folder with something hidden in it, and hands over the truth apart from it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.hidden.rigs import PLAIN, Conditions, Truth, write_hidden
from tests.hidden.settings import Rig
from tests.hidden.severities import draw

Plant = Callable[..., tuple[Path, Truth]]


@pytest.fixture
def plant(tmp_path: Path) -> Plant:
    """`plant("hub", "tip_payload", seed=3)`: the experiment file, and what is true of it.

    Any number of effects, each near its everyday size, or `multiple` times that; none for clean recordings.
    """

    def write(
        rig: Rig, *effects: str, seed: int = 1, multiple: float = 1.0, conditions: Conditions = PLAIN
    ) -> tuple[Path, Truth]:
        folder = tmp_path / "-".join([rig, *effects, str(seed)])
        planted = [draw(effect, seed, rig, multiple) for effect in effects]
        truth = write_hidden(folder, rig, planted, seed, conditions)
        return folder / "experiment.toml", truth

    return write
