"""What each absent effect would do to the residuals: one column of the linearised problem for each of its sizes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vjm.diagnosis.candidate_fit import adds_joint
from vjm.diagnosis.screen import Screen
from vjm.diagnosis.workers import ALONE, Workers
from vjm.effects.effect import Effect
from vjm.errors import SimulationDivergedError
from vjm.identification.trajectory_fit import Point
from vjm.records import REFERENCE, Array
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.run import Run, Start, run_all, transferred
from vjm.simulation.sensitivity import Moved

Told = tuple[Array, Array]  # a recording's triangle, initial state eliminated, and (c,) squares of its directions

_STEP = 0.1  # everyday sizes, over which the slope is taken
_JOINT_STEP = 0.05  # the same where all has to be simulated again, and its curvature told from its slope
_LARGEST = 1e12  # slope, in units of the noise


@dataclass(frozen=True)
class Directions:
    """Columns of all recordings, initial states projected out: a fit's coordinates, absent effects' sizes, residuals.

    Attributes:
        effects: V absent effects.
        parts: the columns of each one's sizes, after the coordinates.
        rows: (r, p + c + 1) rows with the same inner products.
        whole: (c,) squares of the effects' directions before anything was projected out.
    """

    effects: tuple[Effect, ...]
    parts: tuple[slice, ...]
    rows: Array
    whole: Array

    def screen(self, again: tuple[Effect, slice] | None = None, chosen: Sequence[int] | None = None) -> Screen:
        """What is left of the effects' directions once all coordinates are chosen best.

        Args:
            again: an effect that is present, with its coordinates, whose sizes are told among the others instead of
                projected out; it comes first.
            chosen: of the absent effects; None: all.
        """
        coordinates = self.rows.shape[1] - 1 - self.whole.size
        chosen = range(len(self.effects)) if chosen is None else chosen
        effects, counts = [self.effects[k] for k in chosen], [self.effects[k].magnitude_count for k in chosen]
        sizes = [column for k in chosen for column in range(self.parts[k].start, self.parts[k].stop)]
        whole, told = self.whole[sizes], list[int]()
        if again is not None:
            effect, part = again
            told = [*range(part.start, part.start + effect.magnitude_count)]
            effects, counts, whole = [effect, *effects], [len(told), *counts], np.r_[np.zeros(len(told)), whole]
        others = [k for k in range(coordinates) if k not in told]
        rows = self.rows[:, [*others, *told, *(coordinates + k for k in sizes), -1]]
        together = SquareRootInformation.of([(rows[:, :-1], rows[:, -1])], rows.shape[1] - 1)
        return Screen(tuple(effects), _parts(counts), together.eliminated(len(others)).R, whole)


def screen(point: Point, present: Sequence[Effect], variants: Sequence[Effect], workers: Workers = ALONE) -> Screen:
    """Screen absent effects beside a fit, as of `directions`."""
    return directions(point, present, variants, workers).screen()


def directions(
    point: Point, present: Sequence[Effect], variants: Sequence[Effect], workers: Workers = ALONE
) -> Directions:
    """What absent effects would do beside a fit.

    Args:
        point: the fit.
        present: effects that it already has.
        variants: absent effects, one a place and choice of inner parameters.
        workers: share the work.
    """
    # What sticks or rattles takes longest, and is begun first.
    jumping = [k for k, variant in enumerate(variants) if _jumps(point, variant)]
    jumping.sort(key=lambda k: not variants[k].nonsmooth)
    found = workers.map(partial(_secants, point, present), [variants[k] for k in jumping])
    secants = dict(zip(jumping, found, strict=True))
    jobs = [(_only(point, run), {k: each[n] for k, each in secants.items()}) for n, run in enumerate(point.runs)]
    told = workers.map(partial(_told, present, variants), jobs)
    counts = [variant.magnitude_count for variant in variants]
    whole = sum((squares for _, squares in told), start=np.zeros(sum(counts)))
    return Directions(tuple(variants), _parts(counts), np.vstack([rows for rows, _ in told]), whole)


def _parts(counts: Sequence[int]) -> tuple[slice, ...]:
    stops = np.cumsum(counts, dtype=int).tolist()
    return tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))


def _only(point: Point, run: Run) -> Point:
    """The point with one of its recordings."""
    return replace(point, runs=(run,), problem=replace(point.problem, observed=(run.observed,)))


def _told(present: Sequence[Effect], variants: Sequence[Effect], job: tuple[Point, dict[int, Array]]) -> Told:
    """Of a point with one recording, and with slopes (N,) that were found otherwise, by variant."""
    point, secants = job
    (run,), (coordinates,) = point.runs, point.problem.moved(point.x)
    own = [moved for variant in variants for moved in _moved(run, point, present, variant)]
    parts = _parts([variant.magnitude_count for variant in variants])
    rows = _Rows(run, (*coordinates, *own), [secants.get(k) for k in range(len(variants))], parts)
    columns = 2 * run.basis.slow + len(coordinates) + len(own)
    linearized = SquareRootInformation.of(rows.counted(), columns).with_rows(*run.preferred(columns))
    return linearized.eliminated(2 * run.basis.slow).R, rows.squares


def _jumps(point: Point, variant: Effect) -> bool:
    """Whether the effect has no slope at its null, being a joint that is not there then."""
    return adds_joint(variant, point.chain)


def _unit(variant: Effect, size: int, by: float) -> Effect:
    coordinates = np.where(np.arange(variant.coordinates.size) < variant.magnitude_count, 0.0, variant.coordinates)
    coordinates[size] = by
    return variant.at(coordinates)


def _moved(run: Run, point: Point, present: Sequence[Effect], variant: Effect) -> list[Moved]:
    """The arm with each size of an effect moved off its null; as it is where the slope has to be found otherwise."""
    absent = run.observed.recording.condition == REFERENCE or _jumps(point, variant)
    if absent:
        return [Moved(run.arm, _STEP)] * variant.magnitude_count
    effects = [Arm.of(point.chain, (*present, _unit(variant, size, _STEP))) for size in range(variant.magnitude_count)]
    return [Moved(arm, _STEP) for arm in effects]


def _secants(point: Point, present: Sequence[Effect], variant: Effect) -> list[Array]:
    """For each recording, (N,) slope of the whitened predictions where the effect leaves its null, to second order.

    A joint that gives way a little shifts frequencies, which in a long recording is soon out of proportion. Infinite
    where it moves nothing, beside a wrong fit.
    """
    null = [run.residual for run in point.runs]
    sizes = [_unit(variant, 0, size) for size in (_JOINT_STEP, 2 * _JOINT_STEP)]
    try:
        one, two = _residuals(point, present, sizes)
    except SimulationDivergedError:
        return [np.full(each.size, np.inf) for each in null]
    return [(3 * r0 - 4 * r1 + r2) / (2 * _JOINT_STEP) for r0, r1, r2 in zip(null, one, two, strict=True)]


def _residuals(point: Point, present: Sequence[Effect], added: Sequence[Effect]) -> list[list[Array]]:
    """For each further effect and each recording, (N,) whitened residuals with it, all else as it is."""
    arms, states, starts = [], [], []
    for effect in added:
        extended = Arm.of(point.chain, (*present, effect))
        for run in point.runs:
            absent = run.observed.recording.condition == REFERENCE
            arms.append(run.arm if absent else extended)
            states.append(run.state if absent else transferred(run.chain, extended.chain, run.state))
            starts.append(Start.of(arms[-1], run.observed.recording))
    count = len(point.runs)
    observed = [run.observed for run in point.runs] * len(added)
    found = [run.residual for run in run_all(arms, observed, starts, states, point.problem.step_multiple)]
    return [found[first : first + count] for first in range(0, len(found), count)]


class _Rows:
    """Rows of one recording's linearised problem, with slopes that were found otherwise in their places."""

    def __init__(
        self, run: Run, moved: Sequence[Moved], secants: Sequence[Array | None], parts: Sequence[slice]
    ) -> None:
        self.run = run
        self.moved = moved
        self.secants = secants
        self.parts = parts
        self.squares = np.zeros(parts[-1].stop if parts else 0)

    def counted(self) -> Iterator[tuple[Array, Array]]:
        """Derivatives and residuals, as far as the loss lets them count."""
        residual = self.run.residual
        kept = np.sqrt(self.run.observed.loss.slope(residual**2))
        count = self.squares.size
        for measured, part in self.run.slopes(self.moved):
            first = part.shape[1] - count
            for given, columns in zip(self.secants, self.parts, strict=True):
                if given is not None:
                    part[:, first + columns.start] = given[measured]
            # Beside a motion that is all wrong an effect's slope may grow beyond all bounds: it says nothing then.
            wild = ~(np.abs(part[:, first:]) < _LARGEST).all(axis=0)
            part[:, first:][:, wild] = 0.0
            self.squares[wild] = np.inf
            self.squares += np.sum(part[:, first:] ** 2, axis=0)
            yield kept[measured, None] * part, kept[measured] * residual[measured]
