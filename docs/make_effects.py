"""Write docs/effects.md, the list of built-in effects, from the effects themselves.

Run from the repository's root: python docs/make_effects.py
"""

from __future__ import annotations

import inspect
import textwrap
from pathlib import Path

import numpy as np

from vjm.effects import BUILTIN, Effect

FILE = Path(__file__).parent / "effects.md"
HEAD = """\
# The effects

The candidate causes of `vjm diagnose`. Each effect is one class in
`vjm/effects/` with the id given here; at its null value it changes nothing, exactly. With several links, an effect of a
joint or of a link is one candidate for each. `--effects a,b,c` restricts the search; [an effect of your
own](how-to/own-effect.md) can be added. This page is written by `docs/make_effects.py` from the classes.
"""
NULLS = {np.inf: "infinite", 0.0: "0", 1.0: "1"}


def parameters(effect: Effect) -> str:
    """Return an effect's parameters with unit and null value, as one cell of a table."""
    cells = []
    for parameter in effect.parameters:
        unit = parameter.unit or "-"
        null = "" if parameter.shape_parameter else f"; null {NULLS.get(parameter.null, parameter.null)}"
        cells.append(f"{parameter.name} [{unit}{null}]")
    return ", ".join(cells) or "-"


def definition(effect: Effect) -> str:
    """Return what an effect is and what its parameters mean, as its class says."""
    text, _, attributes = (inspect.getdoc(type(effect)) or "").partition("\nAttributes:\n")
    paragraphs, names = [text.strip()], {parameter.name for parameter in effect.parameters}
    for line in textwrap.dedent(attributes).splitlines():
        attribute, _, meaning = line.partition(": ")
        if names.issuperset(attribute.split(", ")):
            paragraphs.append(f"`{attribute}`: {meaning}")
    return "\n\n".join(paragraphs)


def page() -> str:
    """Return the whole page."""
    parts = [HEAD]
    for title, sensor in (("Mechanics", False), ("Sensors", True)):
        parts.append(f"\n## {title}\n")
        for effect in BUILTIN:
            if effect.sensor != sensor:
                continue
            parts.append(f"\n### `{effect.id}`\n\n{effect.description[0].upper()}{effect.description[1:]}.\n")
            parts.append(f"\n{definition(effect)}\n")
            parts.append(f"\n- Parameters: {parameters(effect)}\n")
            parts.append(f"- Assumes: {effect.assumptions}\n")
            if effect.distinguishing_experiment:
                parts.append(f"- Distinguished from similar effects by: {effect.distinguishing_experiment}\n")
            if effect.reference:
                parts.append(f"- Source: {effect.reference}\n")
    return "".join(parts)


if __name__ == "__main__":
    FILE.write_text(page(), encoding="utf-8")
