"""Simulations of recordings from initial states, their residuals and their dependence on these states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Chain
from vjm.errors import SimulationDivergedError
from vjm.model.dynamics import mechanism_of
from vjm.model.modes import linearise
from vjm.records import Array, Indices, Recording, SimulatedRecording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import locked_joint_frequencies, simulate_trajectories, steps_per_half_interval
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.measurement import Observations, sensor_readings
from vjm.simulation.sensitivity import Linearization, ModalBasis, PerturbedArm, with_coefficients
from vjm.simulation.system import Trajectory
from vjm.simulation.timing_noise import TimingNoise

_LARGEST = 1e100  # derivative, in units of the noise
_INDEPENDENT_OF_PRIOR = ("timing_noise", "residual", "chi2", "stride", "basis")  # cached properties


@dataclass(frozen=True)
class InitialStatePrior:
    """Weak prior for rest of a recording's initial state.

    Its unit is the energy of bending the arm by a tenth of its length, and a turn of active joints by one radian: it
    counts as much as one or two of the recording's values do, and matters only for motion that these cannot show.

    Attributes:
        rest: (2 nv,) angles of rest at the first measured active angles, and zero rates [rad, rad/s].
        sqrt_information: (2 nv, 2 nv) S, where |S (state - rest)|^2 is added to chi^2.
        scale: size of a weighted residual that counts as one standard deviation beside it.
    """

    rest: Array
    sqrt_information: Array
    scale: float = 1.0

    @classmethod
    def of(cls, arm: Arm, recording: Recording, scale: float = 1.0) -> InitialStatePrior:
        """Return the prior of an arm at a recording's beginning, beside residuals of a size `scale`.

        Raises:
            SimulationDivergedError: joints that move nothing.
        """
        # Not a copy of the same chain, whose mechanism would have to be built again.
        chain = replace(arm.chain, armature=0.0) if arm.chain.armature else arm.chain
        recording = arm.inputs(recording)
        M, _, _, q = linearise(chain, recording.payload, recording.gravity, recording.initial_theta)
        stiffness = min(link.bending_stiffness for link in chain.links)
        energy = 1.5 * stiffness * 0.1**2 / sum(link.length for link in chain.links)
        n = chain.size
        root = np.zeros((2 * n, 2 * n))
        root[range(n), range(n)] = np.sqrt(chain.stiffness / (2 * energy))
        root[chain.active, chain.active] = 1.0
        try:
            root[n:, n:] = np.linalg.cholesky(M / (2 * energy)).T
        except np.linalg.LinAlgError:
            remedy = "a joint moves nothing that has inertia: give the hub some"
            raise SimulationDivergedError(float(recording.time[0]), 0.0, remedy) from None
        return cls(np.concatenate([q, np.zeros(n)]), root, scale)


@dataclass(frozen=True)
class Run:
    """A simulation of one recording from an initial state, and the measurements.

    Attributes:
        observed: the measurements.
        prior: of the initial state.
        arm: simulated.
        state: (2 nv,) initial angles and rates.
        trajectory: at the integrator's instants; one copy.
    """

    observed: Observations
    prior: InitialStatePrior
    arm: Arm
    state: Array
    trajectory: Trajectory

    @property
    def chain(self) -> Chain:
        """The arm's chain."""
        return self.arm.chain

    @cached_property
    def residual(self) -> Array:
        """(N,) measured less simulated, weighted and whitened."""
        return self._timed(self.observed.residual(self.arm, self.trajectory))

    @cached_property
    def timing_noise(self) -> TimingNoise:
        """Errors of the instants at which the frames were taken."""
        return TimingNoise.of(self.observed, self.arm, self.trajectory)

    def _timed(self, weighted: Array) -> Array:
        """Weighted values (N, ...) without the correlation that errors of the frames' instants bring."""
        return self.timing_noise.whitened(weighted) if self.arm.timing_variance else weighted

    @cached_property
    def chi2(self) -> float:
        """Sum of the squared weighted residuals, and the logarithm of the determinant of their errors of time."""
        return float(self.residual @ self.residual) + self._log_determinant

    @property
    def expected_chi2(self) -> float:
        """Mean of `chi2` where the model is right: the number of values, but for errors of time."""
        return self.observed.count + self._log_determinant

    @property
    def _log_determinant(self) -> float:
        return self.timing_noise.log_determinant if self.arm.timing_variance else 0.0

    @cached_property
    def cost(self) -> float:
        """Sum of the residuals' loss and the prior's term."""
        away = self.prior.scale * (self.prior.sqrt_information @ (self.state - self.prior.rest))
        return float(np.sum(self.observed.loss.value(self.residual**2)) + away @ away) + self._log_determinant

    def with_scaled_prior(self) -> Run:
        """Return the run with a prior in units of the residuals' size."""
        return self.with_prior_scale(float(np.sqrt(max(self.chi2 / max(self.expected_chi2, 1), 1.0))))

    def with_prior_scale(self, scale: float) -> Run:
        """Return the run with a prior beside residuals of a size `scale`."""
        run = replace(self, prior=replace(self.prior, scale=scale))
        run.__dict__.update({name: self.__dict__[name] for name in _INDEPENDENT_OF_PRIOR if name in self.__dict__})
        return run

    @cached_property
    def stride(self) -> int:
        """Steps in half an interval over which derivatives are advanced."""
        return steps_per_half_interval(self.chain, self.observed.recording, self.trajectory.step)

    @cached_property
    def basis(self) -> ModalBasis:
        """The m modes in which its derivatives are expressed."""
        driven = self.arm.inputs(self.observed.recording)
        return ModalBasis.of(self.chain, driven, 2 * self.stride * self.trajectory.step)

    def transferred_state(self, arm: Arm) -> Array:
        """Return the initial state (2 nv,) in an arm with other virtual joints, with the active joints' momentum.

        Initial rates of fast modes differ from chain to chain; a joint that turns freely must not drift by that.
        """
        state = transfer_state(self.chain, arm.chain, self.state)
        active = arm.chain.active
        if not active.size:
            return state
        recording = self.observed.recording
        (q, v), (other_q, other_v) = np.split(self.state, 2), np.split(state, 2)
        mass = mechanism_of(self.chain, self.arm.inputs(recording).payload).mass_matrix(q[None])[0]
        other_mass = mechanism_of(arm.chain, arm.inputs(recording).payload).mass_matrix(other_q[None])[0]
        missing = (mass @ v)[self.chain.active] - (other_mass @ other_v)[active]
        other_v[active] += np.linalg.solve(other_mass[np.ix_(active, active)], missing)
        return np.concatenate([other_q, other_v])

    def linearization(self, perturbed: Sequence[PerturbedArm] = ()) -> Linearization:
        """Return the linearised simulation, of perturbed arms as well."""
        arm, kept = self.arm.smooth
        trajectory = self.trajectory
        if kept.size < trajectory.z.shape[1]:
            trajectory = replace(trajectory, z=trajectory.z[:, kept])
        smooth = [PerturbedArm(other.smooth[0], step) for other, step in perturbed]
        return Linearization(self.observed, arm, self.basis, smooth, trajectory, self.stride)

    def slopes(self, linearization: Linearization) -> Iterator[tuple[Indices, Array]]:
        """Yield indices (r,) of values and derivatives (r, 2 slow + p) of their weighted and whitened predictions."""
        parts = linearization.jacobian()
        if self.observed.whitening is None and not self.arm.timing_variance:
            yield from parts
            return
        rows, slopes = zip(*parts, strict=True)
        measured = np.concatenate(rows)
        whole = np.empty((measured.size, slopes[0].shape[1]))
        whole[measured] = np.concatenate(slopes)
        yield np.arange(measured.size), self._timed(self.observed.whitened(whole))

    def weighted_slopes(self, linearization: Linearization) -> Iterator[tuple[Array, Array]]:
        """Yield derivatives (r, 2 slow + p) of predictions and residuals (r,), weighted by the loss."""
        kept = np.sqrt(self.observed.loss.slope(self.residual**2))
        for measured, part in self.slopes(linearization):
            yield kept[measured, None] * part, kept[measured] * self.residual[measured]

    def linearized(self, linearization: Linearization) -> SquareRootInformation:
        """Return the linearised least-squares problem: modes' initial coordinates and rates first, then p parameters.

        Raises:
            SimulationDivergedError: derivatives that are not finite.
        """
        columns = 2 * self.basis.slow_count + len(linearization.perturbed)
        problem = SquareRootInformation.of(self.weighted_slopes(linearization), columns)
        problem = problem.with_rows(*self.prior_rows(columns)).with_rows(*self.timing_rows(linearization))
        if not np.abs(problem.R).max(initial=0.0) < _LARGEST:
            remedy = "the motion depends on its start or parameters beyond all bounds: check them"
            raise SimulationDivergedError(float(self.trajectory.time[-1]), self.trajectory.step, remedy)
        return problem

    @cached_property
    def linearized_by_state(self) -> SquareRootInformation:
        """The linearised problem of the initial state alone."""
        return self.linearized(self.linearization())

    def prior_rows(self, columns: int) -> tuple[Array, Array]:
        """Return the prior's rows (2 nv, columns) and right-hand side (2 nv,)."""
        states = self.basis.states
        rows = np.zeros((self.state.size, columns))
        weight = self.prior.scale * self.prior.sqrt_information
        rows[:, : states.shape[1]] = weight @ states
        return rows, weight @ (self.prior.rest - self.state)

    def timing_rows(self, linearization: Linearization, far: bool = False) -> tuple[Array, Array]:
        """Return rows (r, columns) and right-hand side (r,) of the variance of the frames' instants; r is 0 or 1.

        `far` says whether they shall promise what the best variance explains, however far it is.
        """
        before = self.arm.timing_variance
        by_parameters = [(other.timing_variance - before) / step for other, step in linearization.perturbed]
        columns = 2 * self.basis.slow_count + len(by_parameters)
        if not any(by_parameters):
            return np.zeros((0, columns)), np.zeros(0)
        noise = self.timing_noise
        slope, residual = (noise.likelihood_ratio if far else noise.score)(self.residual)
        row = np.r_[np.zeros(columns - len(by_parameters)), slope * np.array(by_parameters)]
        return row[None], np.array([residual])

    def scores(self, linearization: Linearization, linearized: SquareRootInformation) -> Array:
        """Return (T, p) each instant's part in the slope of -chi^2 / 2 by the parameters, initial state eliminated."""
        parameters = len(linearization.perturbed)
        states = linearized.columns - parameters
        by_parameters = linearized.elimination_slopes(states)
        instants = self.observed.instants
        scores = np.zeros((self.observed.recording.time.size, parameters))
        for measured, part in self.slopes(linearization):
            slopes = part[:, states:] - part[:, :states] @ by_parameters
            np.add.at(scores, instants[measured], slopes * self.residual[measured, None])
        return scores

    def residual_series(self) -> list[Array]:
        """Return weighted residuals of each kind of sensor, (F, 2 k) and (T, n_a); NaN where nothing was measured."""
        return [series for series in self.observed.on_grid(self.residual) if np.isfinite(series).any()]

    def simulated_recording(self, converged: bool) -> SimulatedRecording:
        """Return the record of the run; `converged` says whether its initial state was found."""
        observed = self.observed
        return SimulatedRecording(
            recording=observed.recording,
            simulation=sensor_readings(self.arm, observed.arcs, observed.recording, self.trajectory),
            noise=observed.noise,
            chi2=float(self.residual @ self.residual),
            count=observed.count,
            status="converged" if converged else "not converged",
        )


def is_followed(runs: Sequence[Run]) -> bool:
    """Return True if simulations of parts of a recording follow its motion, so that slopes show what they lack.

    Where its phase is off by phi a swing leaves a share 2 sin(phi/2) of its motion. Up to 30 % (phi = 17 deg) that is
    linear in phi within 0.5 %, so that derivatives lead back.
    """
    missed = sum(run.chi2 - run.expected_chi2 for run in runs)
    moved = sum(run.observed.motion for run in runs)
    return all(run.observed.recording.kind == "quiet" for run in runs) or missed <= 0.3**2 * moved


def earlier_runs(runs: Sequence[Run], observed: Observations) -> list[Run]:
    """Return the simulations of the same recording that begin earlier than a part of it."""
    own = [run for run in runs if run.observed.recording.file == observed.recording.file]
    return [run for run in own if run.trajectory.time[0] < observed.recording.time[0]]


def state_at(runs: Sequence[Run], observed: Observations) -> Array:
    """Return the state (2 nv,) at which an observation begins, from the simulations of the same recording."""
    instant = observed.recording.time[:1]
    paths = [run.trajectory for run in runs if run.observed.recording.file == observed.recording.file]
    begun = [path for path in paths if path.time[0] <= instant[0]]
    path = max(begun, key=lambda path: float(path.time[0]), default=paths[0])
    return np.concatenate([values[0] for values in path.sample(instant)])


def linearize(runs: Sequence[Run], perturbed: Sequence[Sequence[PerturbedArm]]) -> Iterator[Linearization]:
    """Yield each run's linearization by its perturbed arms, those of short ones of the same arms computed together."""
    return with_coefficients([run.linearization(own) for run, own in zip(runs, perturbed, strict=True)])


def linearize_by_states(runs: Sequence[Run]) -> None:
    """Compute runs' linearised problems of their initial states together, which is faster than one after another."""
    unknown = [run for run in runs if "linearized_by_state" not in run.__dict__]
    for run, linearization in zip(unknown, linearize(unknown, [()] * len(unknown)), strict=True):
        run.__dict__["linearized_by_state"] = run.linearized(linearization)


def _longest_step(chain: Chain, recordings: Sequence[Recording]) -> float:
    """Step [s] with which derivatives resolve the fastest mode that the chain has or a camera shows."""
    _, fastest = locked_joint_frequencies(chain)
    frames = [recording.time[recording.frames] for recording in recordings]
    nyquist = 0.5 / min((float(np.median(np.diff(time))) for time in frames if time.size > 1), default=np.inf)
    return 0.25 / max(min(fastest, nyquist), 1e-300)  # a quarter of a period: two steps at a time


def simulate_runs(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    priors: Sequence[InitialStatePrior] | None,
    states: Sequence[Array],
    step_multiple: float,
) -> list[Run]:
    """Simulate several recordings together.

    Args:
        arms: one a recording.
        observed: the recordings.
        priors: of their initial states; None: those of the arms.
        states: (2 nv,) initial states.
        step_multiple: multiple of the default step.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    recordings = [values.recording for values in observed]
    q, v = zip(*(np.split(state, 2) for state in states), strict=True)
    began = [values.began for values in observed]
    z = [values.internal_states(arm, angles) for values, arm, angles in zip(observed, arms, q, strict=True)]
    longest = _longest_step(arms[0].chain, recordings)
    trajectories = simulate_trajectories(arms, recordings, q, v, None, step_multiple, longest, began, z)
    if priors is None:
        priors = [InitialStatePrior.of(arm, recording) for arm, recording in zip(arms, recordings, strict=True)]
    return [Run(*parts) for parts in zip(observed, priors, arms, states, trajectories, strict=True)]
