"""The command `vjm init`: what it asks on a terminal, and the experiment file it writes."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.prompt import InvalidResponse, Prompt, PromptBase

from vjm.errors import ExperimentError, InputError
from vjm.experiment.conventions import FACTORS
from vjm.experiment.proposal import ExperimentProposal, propose
from vjm.files import FolderError, write_text

_FILE = "experiment.toml"
_GIVEN = (
    *("name", "joint", "length", "mass", "bending_stiffness", "youngs_modulus", "width", "thickness"),
    *("hub_inertia", "gravity"),
)


def init(arguments: argparse.Namespace, ask: bool) -> tuple[Path, list[str]]:
    """Write an experiment file for the CSV files of a folder; ask for what was not given.

    Returns:
        Its path, and the keys that have to be filled in by hand.

    Raises:
        FolderError: there is an experiment file already, or none can be written.
        RecordingError: a recording has a column twice, or lacks one.
        InputError: there is no CSV file, one cannot be used, or what was given contradicts itself.
    """
    folder: Path = arguments.folder
    target = folder / _FILE
    if os.path.lexists(target):
        raise FolderError(
            target, "it exists already, and is left as it is", "choose another folder, or remove it first"
        )
    if not folder.is_dir():
        raise FolderError(folder, "there is no such folder", "make it, with the recordings (CSV) in it")
    paths = arguments.csv or sorted(folder.glob("*.csv"))
    if not paths:
        raise InputError(
            f"{folder}: there is no CSV file in it; put the recordings there, or name them with --csv FILE"
        )
    options = {key: value for key in _GIVEN if (value := getattr(arguments, key)) is not None}
    proposal = replace(propose(folder, paths), given=options)
    if ask:
        proposal = _ask(proposal, Console(stderr=True))
    try:
        proposal.check(target)
    except ExperimentError as error:
        if error.key not in proposal.given:
            raise
        section = r"\b(bending_stiffness|youngs_modulus|width|thickness)\b"
        text = re.sub(section, lambda key: _option(key[0]), f"{error.problem}; expected {error.expected}")
        raise InputError(f"{_option(error.key)}: {text}") from error
    write_text(target, proposal.text())
    return target, proposal.missing


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def stdin_is_terminal() -> bool:
    """Return True if somebody can answer questions."""
    return sys.stdin is not None and sys.stdin.isatty()


class _Answer(PromptBase[Any]):
    """A prompt whose answer is made by a function; an empty one leaves the number to be filled in."""

    def __init__(self, *arguments: Any, parse: Callable[[str], Any], **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.parse = parse

    def process_response(self, value: str) -> Any:
        if not value.strip():
            return None
        try:
            return self.parse(value.strip())
        except ValueError:
            raise InvalidResponse("[prompt.invalid]a number is expected, or nothing to fill it in later") from None


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise ValueError
    return value


def _plane(text: str) -> list[float]:
    x, y = (float(part) for part in text.replace(",", " ").split())
    return [x, y]


def _ask(proposal: ExperimentProposal, console: Console) -> ExperimentProposal:
    """Ask for what was not given and for the units that were guessed."""
    answers, link = dict(proposal.given), next(iter(proposal.links))
    counts = ", ".join(f"{name} with {count} markers" for name, count in proposal.links.items())
    console.print(f"{len(proposal.files)} recordings of {counts}. An empty answer leaves a '?' to be filled in.")

    def number(key: str, text: str, parse: Callable[[str], Any] = _positive) -> None:
        if key not in answers:
            value = _Answer(text, console=console, show_default=False, parse=parse)(default=None)
            answers.update({} if value is None else {key: value})

    if "joint" not in answers:
        answers["joint"] = Prompt.ask(
            f"Joint at {link}'s proximal end",
            console=console,
            choices=["revolute", "clamped"],
            default=proposal.joint(link)[0],
        )
    number("length", f"Length of {link} \\[m]")
    number("mass", f"Mass of {link} \\[kg]")
    if not any(key in answers for key in ("youngs_modulus", "width", "thickness")):
        number("bending_stiffness", f"Bending stiffness EI of {link} \\[N m^2] (empty: from E, width and thickness)")
    if "bending_stiffness" not in answers:
        number("youngs_modulus", "Young's modulus \\[Pa]")
        number("width", "Width, parallel to the joint's axis \\[m]")
        number("thickness", "Thickness, in the plane of bending \\[m]")
    if answers["joint"] == "revolute":
        number("hub_inertia", "Inertia of the hub with its motor \\[kg m^2] (empty: 0)")
    number("gravity", "Gravity in the plane, x y \\[m/s^2] (empty: 0 0, the plane is horizontal)", _plane)
    proposal = replace(proposal, given=answers)
    chosen = {
        quantity: Prompt.ask(
            f"Unit of {quantity} in the recordings ({reason})",
            console=console, choices=list(FACTORS[quantity]), default=unit,
        )
        for quantity, (unit, reason) in proposal.units.items()
        if not reason.startswith("none")
    }  # fmt: skip
    return replace(proposal, chosen=chosen)
