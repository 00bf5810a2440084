"""Every example runs as a user would run it, in a folder of its own, and what it prints and writes is right."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.model.chains import model_of, write_model
from tests.model.urdf_contents import springs_from
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.model.modes import modes
from vjm.records import Link

EXAMPLES = Path(__file__).parents[1] / "examples"
PNG = b"\x89PNG"


class Runner:
    """Runs examples in the current folder, and gives what they print."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, name: str, *arguments: str) -> str:
        self.monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return self.capsys.readouterr().out


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Runner:
    monkeypatch.chdir(tmp_path)
    return Runner(monkeypatch, capsys)


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.\d+(?:e[+-]\d+)?", text)]


def test_every_example_is_tested() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    assert [path.name for path in EXAMPLES.glob("*.py") if f'run("{path.name}"' not in here] == []


def test_identify_and_plot(run: Runner, tmp_path: Path) -> None:
    said = run("identify_and_plot.py")
    assert said.startswith("stainless steel beam, clamped: converged")
    value, error = numbers(next(line for line in said.splitlines() if "bending_stiffness" in line))
    assert value == pytest.approx(1.973629, rel=0.01)  # the truth behind the demo
    assert 0 < error < 0.02
    assert (tmp_path / "tip.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("joint", ["clamped", "revolute"])
def test_urdf_in_pinocchio(run: Runner, tmp_path: Path, joint: str) -> None:
    link = Link("beam", joint, 1.0, 0.44, 1.9, (1.0,), hub_inertia=0.02 if joint == "revolute" else 0.0)  # type: ignore[arg-type]
    chain = Chain("one beam", (uniform_chain(link, layout(1.0, 4), kelvin_voigt=3e-4),), gravity=(0.0, 0.0))
    (tmp_path / "vjm-out").mkdir()
    write_model(model_of(chain), tmp_path / "vjm-out" / "model.json")
    swinging, linearised = numbers(run("urdf_in_pinocchio.py").splitlines()[-1])
    assert swinging == pytest.approx(linearised, rel=1e-3)
    assert linearised == pytest.approx(modes(chain).frequencies[0], rel=1e-4)
    assert [*springs_from(tmp_path / "arm.urdf").values()] == chain.stiffness[chain.passive].tolist()


def test_two_links(run: Runner, tmp_path: Path) -> None:
    said = run("two_links.py")
    frequencies = numbers(said.splitlines()[0])
    assert len(frequencies) == 4
    assert frequencies == sorted(frequencies)
    assert (tmp_path / "two_links.png").read_bytes().startswith(PNG)


def test_own_experiment(run: Runner, tmp_path: Path) -> None:
    said = run("own_experiment.py", "lab")
    assert "--parameters uniform: 2 of 2 determined" in said
    (recording,) = vjm.load_experiment(tmp_path / "lab" / "experiment.toml").recordings
    hidden = np.isnan(recording.markers).any(axis=(0, 2))
    assert hidden.tolist() == [False, False, True, False]
    assert np.isnan(recording.markers[:, 2, 0]).sum() == 3
