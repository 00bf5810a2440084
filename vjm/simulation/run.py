"""A simulation of one recording from an initial state, beside what was measured, and how it depends on that state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vjm.chain.curve import curvature_spline
from vjm.chain.virtual_links import Chain
from vjm.errors import SimulationDivergedError
from vjm.model.modes import equilibrium, linearise
from vjm.records import Array, Indices, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import half_interval, locked_frequencies, rollouts
from vjm.simulation.integrators import Steps, sample
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.measurement import Observed
from vjm.simulation.sensitivity import Basis, Moved, first_angles, jacobian

_USUAL_BEND = 0.1  # lengths; bending of the arm's whole length by this much is nothing unusual to start from
_USUAL_TURN = 1.0  # rad of an active joint
_LONGEST_STEP = 0.25  # periods of the fastest mode that derivatives must resolve, two steps at a time
_LARGEST = 1e100  # derivative, in units of the noise
_KEPT = ("path", "residual", "chi2", "stride", "basis")  # what does not depend on the preference


@dataclass(frozen=True)
class Start:
    """What is known of a recording's initial state before it is looked at.

    A weak preference for rest, by the energy that bending the arm by a tenth of its length takes: it counts as much as
    one or two of the recording's values do, and matters only for motion that these cannot show.

    Attributes:
        rest: (2 nv,) angles of rest at the first measured active angles, and zero rates [rad, rad/s].
        root: (2 nv, 2 nv) |root (state - rest)|^2 is added to chi^2.
        spread: size of a weighted residual that counts as one standard deviation beside it.
    """

    rest: Array
    root: Array
    spread: float = 1.0

    @classmethod
    def of(cls, arm: Arm, recording: Recording) -> Start:
        """Of an arm at a recording's beginning.

        Raises:
            SimulationDivergedError: joints that move nothing.
        """
        chain, recording = arm.chain, arm.inputs(recording)
        theta = first_angles(recording)
        q = equilibrium(chain, recording.payload, recording.gravity, theta)
        M, _, _, _ = linearise(chain, recording.payload, recording.gravity, theta)
        stiffness = min(link.bending_stiffness for link in chain.links)
        energy = 1.5 * stiffness * _USUAL_BEND**2 / sum(link.length for link in chain.links)
        n = chain.size
        root = np.zeros((2 * n, 2 * n))
        root[range(n), range(n)] = np.sqrt(chain.stiffness / (2 * energy))
        root[chain.active, chain.active] = 1 / _USUAL_TURN
        try:
            root[n:, n:] = np.linalg.cholesky(M / (2 * energy)).T
        except np.linalg.LinAlgError:
            remedy = "a joint moves nothing that has inertia: give the hub some"
            raise SimulationDivergedError(float(recording.time[0]), 0.0, remedy) from None
        return cls(np.concatenate([q, np.zeros(n)]), root)


@dataclass(frozen=True)
class Run:
    """A simulation of one recording from an initial state, beside what was measured.

    Attributes:
        observed: the measurements.
        start: what was known of the initial state.
        arm: what was simulated.
        state: (2 nv,) initial angles and rates.
        steps: the trajectory at the integrator's instants; one copy.
    """

    observed: Observed
    start: Start
    arm: Arm
    state: Array
    steps: Steps

    @property
    def chain(self) -> Chain:
        """The arm's chain."""
        return self.arm.chain

    @cached_property
    def path(self) -> tuple[Array, Array]:
        """q, v (T, nv) at the recording's instants [rad, rad/s]."""
        q, v = sample(self.steps, self.observed.recording.time)
        return q[:, 0], v[:, 0]

    @cached_property
    def residual(self) -> Array:
        """(N,) measured less simulated, weighted and whitened."""
        return self.observed.residual(self.arm, self.steps)

    @cached_property
    def chi2(self) -> float:
        """Sum of the squared weighted residuals."""
        return float(self.residual @ self.residual)

    @cached_property
    def cost(self) -> float:
        """The residuals' loss and what the initial state adds to it."""
        away = self.start.spread * (self.start.root @ (self.state - self.start.rest))
        return float(np.sum(self.observed.loss.value(self.residual**2)) + away @ away)

    def weighed(self) -> Run:
        """The same run with the preference for rest as strong as the residuals are large."""
        spread = float(np.sqrt(max(self.chi2 / max(self.observed.count, 1), 1.0)))
        run = replace(self, start=replace(self.start, spread=spread))
        run.__dict__.update({name: self.__dict__[name] for name in _KEPT if name in self.__dict__})
        return run

    @cached_property
    def stride(self) -> int:
        """Steps in half an interval over which derivatives are advanced."""
        return half_interval(self.chain, self.observed.recording, self.steps.step)

    @cached_property
    def basis(self) -> Basis:
        """The m modes that its derivatives are told in."""
        driven = self.arm.inputs(self.observed.recording)
        return Basis.of(self.chain, driven, 2 * self.stride * self.steps.step)

    def rows(self, moved: Sequence[Moved]) -> Iterator[tuple[Array, Array]]:
        """Derivatives (r, 2 slow + p) of the weighted predictions, and the residuals (r,), as far as they count."""
        kept = np.sqrt(self.observed.loss.slope(self.residual**2))
        for measured, part in self.slopes(moved):
            yield kept[measured, None] * part, kept[measured] * self.residual[measured]

    def slopes(self, moved: Sequence[Moved]) -> Iterator[tuple[Indices, Array]]:
        """Derivatives (r, 2 slow + p) of the weighted and whitened predictions that indices (r,) name."""
        arm, kept = self.arm.smooth
        steps = self.steps if kept.size == self.steps.z.shape[2] else replace(self.steps, z=self.steps.z[:, :, kept])
        smooth = [Moved(each.arm.with_feedback(arm.feedback).smooth[0], each.by) for each in moved]
        parts = jacobian(self.observed, arm, self.basis, smooth, steps, self.stride)
        if self.observed.whitening is None:
            yield from parts
            return
        gathered = [*parts]
        measured = np.concatenate([each for each, _ in gathered])
        whole = np.empty((measured.size, gathered[0][1].shape[1]))
        whole[measured] = np.concatenate([part for _, part in gathered])
        yield np.arange(measured.size), self.observed.whitened(whole)

    def linearized(self, moved: Sequence[Moved] = ()) -> SquareRootInformation:
        """The linearised least-squares problem: modes' initial coordinates and rates first, then p parameters.

        Raises:
            SimulationDivergedError: derivatives that are not finite.
        """
        columns = 2 * self.basis.slow + len(moved)
        found = SquareRootInformation.of(self.rows(moved), columns).with_rows(*self.preferred(columns))
        if not np.abs(found.R).max(initial=0.0) < _LARGEST:
            remedy = "the motion depends on its start or parameters beyond all bounds: check them"
            raise SimulationDivergedError(float(self.steps.time[-1]), self.steps.step, remedy)
        return found

    def preferred(self, columns: int) -> tuple[Array, Array]:
        """Rows (2 nv, columns) and what they want (2 nv,) that stand for what was known of the initial state."""
        states = self.basis.states
        root = np.zeros((self.state.size, columns))
        preference = self.start.spread * self.start.root
        root[:, : states.shape[1]] = preference @ states
        return root, preference @ (self.start.rest - self.state)

    def scores(self, moved: Sequence[Moved], linearized: SquareRootInformation) -> Array:
        """(T, p) each instant's part in the slope of -chi^2 / 2 by the parameters, initial state eliminated.

        Args:
            moved: as in `triangle`.
            linearized: this run's.
        """
        states = linearized.columns - len(moved)
        followed = linearized.followed(states)
        instants = self.observed.instants
        found = np.zeros((self.observed.recording.time.size, len(moved)))
        for measured, part in self.slopes(moved):
            own = part[:, states:] - part[:, :states] @ followed
            np.add.at(found, instants[measured], own * self.residual[measured, None])
        return found

    def series(self) -> list[Array]:
        """Weighted residuals over each kind of sensor's instants, (F, 2 k) and (T, n_a); NaN where nothing was seen."""
        return [each for each in self.observed.spread(self.residual) if np.isfinite(each).any()]


def _longest_step(chain: Chain, recordings: Sequence[Recording]) -> float:
    """Step [s] that resolves, in the derivatives, the fastest mode that the chain has or a camera shows."""
    _, fastest = locked_frequencies(chain)
    frames = [recording.time[recording.frames] for recording in recordings]
    shown = 0.5 / min((float(np.median(np.diff(time))) for time in frames if time.size > 1), default=np.inf)
    return _LONGEST_STEP / max(min(fastest, shown), 1e-300)


def transferred(given: Chain, wanted: Chain, state: Array) -> Array:
    """An initial state (2 nv,) told in the joints of another chain of the same arm: with the same curvatures.

    A root joint that the given chain lacks is turned by the moment that the link's curvature there exerts on it.
    """
    links = zip(given.links, wanted.links, given.passive_slices, wanted.passive_slices, strict=True)
    turn = np.zeros((wanted.size, given.size))
    turn[wanted.active, given.active] = 1.0
    for one, two, here, there in links:
        curvature = curvature_spline(one)
        turn[there, here] = two.cells[:, None] * curvature(two.joint_arcs)
        if two.root_stiffness is None:
            continue
        if one.root_stiffness is not None:
            turn[there.start - 1, here.start - 1] = 1.0
        else:
            turn[there.start - 1, here] = one.bending_stiffness / max(two.root_stiffness, 1e-300) * curvature(0.0)
    q, v = np.split(state, 2)
    return np.concatenate([turn @ q, turn @ v])


def run_all(
    arms: Sequence[Arm],
    observed: Sequence[Observed],
    starts: Sequence[Start],
    states: Sequence[Array],
    step_multiple: float,
) -> list[Run]:
    """Simulate several recordings together.

    Args:
        arms: one a recording.
        observed, starts: the recordings.
        states: (2 nv,) initial states.
        step_multiple: multiple of the default step.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    recordings = [each.recording for each in observed]
    q, v = zip(*(np.split(state, 2) for state in states), strict=True)
    arms = [arm.with_feedback(each.feedback) for arm, each in zip(arms, observed, strict=True)]
    longest = _longest_step(arms[0].chain, recordings)
    steps = rollouts(arms, recordings, q, v, step_multiple=step_multiple, longest=longest)
    return [
        Run(seen, start, arm, state, path)
        for seen, start, arm, state, path in zip(observed, starts, arms, states, steps, strict=True)
    ]
