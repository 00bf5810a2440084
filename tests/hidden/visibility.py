"""How large a hidden effect looks, in standard deviations of the sensors' noise: as it is, and after a refit.

What a refit of the usual parameters leaves (bending stiffness, damping, hub inertia, initial states) is found in
proportion, from an effect of a fiftieth of the size: what large effects leave is larger or smaller than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam import Beam, Faults, Physics
from tests.fine_beam.extended import Extended
from tests.hidden.plans import Plan, plans_of
from tests.hidden.rigs import Shown, perform, perform_plans
from tests.hidden.settings import CAMERA, ENCODER, Rig, Setting, setting_of
from tests.hidden.severities import Planted, draw, effects_of

Array = NDArray[np.float64]

RIGS: tuple[Rig, ...] = ("hub", "clamped")
SMALL = 0.02  # of an everyday size
MODES = 4  # of an initial state, the hub's free rotation included


def fitted(plan: Plan) -> bool:
    """Whether a fit would use the recording."""
    return plan.entry.role == "train" and plan.entry.kind in ("driven", "decay")


def seen(recordings: Sequence[Shown]) -> list[Array]:
    """What is measured in each recording that is fitted, over its noise, (m,)."""
    return [
        np.concatenate([each.markers.ravel() / CAMERA.noise, each.angle / ENCODER.noise])
        for each in recordings
        if fitted(each.plan)
    ]


def sigmas(with_effect: Sequence[Shown], without: Sequence[Shown]) -> float:
    """Norm of the difference between the fitted recordings in units of the noise; nothing is refitted."""
    return float(np.linalg.norm(np.concatenate(seen(with_effect)) - np.concatenate(seen(without))))


def usual_directions(rig: Rig, seed: int) -> Array:
    """Orthonormal columns (m, p): how the fitted recordings move with what is refitted anyway."""
    setting = setting_of(rig, seed)
    beam = setting.beam
    plans = [plan for plan in plans_of(setting, seed, reference=False) if fitted(plan)]
    base = _measured(setting, plans)
    changed = [replace(beam, bending_stiffness=beam.bending_stiffness * (1.0 + 1e-5))]
    changed.append(replace(beam, kelvin_voigt_time=beam.kelvin_voigt_time * 1.01))
    if setting.turns:
        changed.append(replace(beam, hub_inertia=beam.hub_inertia * (1.0 + 1e-4)))
    columns = [np.concatenate(_measured(replace(setting, beam=each), plans)) - np.concatenate(base) for each in changed]
    sizes = [len(each) for each in base]
    for k, plan in enumerate(plans):
        before, after = sum(sizes[:k]), sum(sizes[k + 1 :])
        for push in _pushes(beam, plan):
            moved = _measured(setting, [plan], push)[0] - base[k]
            columns.append(np.concatenate([np.zeros(before), moved, np.zeros(after)]))
    matrix = np.stack(columns, axis=1)
    basis: Array = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), full_matrices=False)[0]
    return basis


def _measured(setting: Setting, plans: Sequence[Plan], push: Array | None = None) -> list[Array]:
    return seen(perform_plans(setting, Physics(), Faults(), plans, push))


def _pushes(beam: Beam, plan: Plan) -> list[Array]:
    """Small changes of the initial state: coordinates and rates of the lowest modes, (2 n,) each."""
    extended = Extended(beam, Physics(), [plan.entry.body])
    turn = np.eye(extended.size)[:, :1] if extended.revolute else np.empty((extended.size, 0))
    shapes = np.hstack([turn, extended.modes()[1] / extended.modes()[0]])[:, :MODES].T
    still = np.zeros(extended.size)
    return [1e-5 * np.append(shape, still) for shape in shapes] + [1e-4 * np.append(still, shape) for shape in shapes]


def left(planted: Sequence[Shown], clean: Sequence[Shown], directions: Array) -> float:
    """Norm of the difference that remains after the refit."""
    difference = np.concatenate(seen(planted)) - np.concatenate(seen(clean))
    return float(np.linalg.norm(difference - directions @ (directions.T @ difference)))


def shown_as(planted: Planted) -> str:
    """An effect's parameters in a few words."""
    return ", ".join(f"{name} {value:.5g}" for name, value in planted.parameters.items())


def main() -> None:
    """Print a Markdown table of every effect on either rig, at the sizes of one seed."""
    print("| rig | effect | drawn by seed 1 | sigma | left by a refit |\n|---|---|---|---|---|")
    for rig in RIGS:
        clean, directions = perform(rig, (), 1), usual_directions(rig, 1)
        for effect in effects_of(rig):
            planted, small = (draw(effect, 1, rig, multiple) for multiple in (1.0, SMALL))
            total = sigmas(perform(rig, [planted], 1), clean)
            rest = left(perform(rig, [small], 1), clean, directions) / SMALL
            print(f"| {rig} | {effect} | {shown_as(planted)} | {total:.0f} | {rest:.0f} |", flush=True)
