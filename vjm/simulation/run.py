"""Simulations of recordings beside their measurements: residuals, chi^2 and the linearised problem."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import eigh, solve_triangular

from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Chain
from vjm.effects.effect import is_nonsmooth
from vjm.errors import SimulationDivergedError
from vjm.model.dynamics import mechanism_of
from vjm.model.modes import Modes, linearise, locked_modes
from vjm.records import Array, Indices, Recording, SimulatedRecording
from vjm.simulation.arm import Arm
from vjm.simulation.given_motion import acceleration_errors
from vjm.simulation.integrate import locked_joint_frequencies, simulate_trajectories, steps_per_half_interval
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.measurement import Observations, principal_errors, sensor_readings
from vjm.simulation.sensitivity import Linearization, computed_together
from vjm.simulation.system import Trajectory
from vjm.simulation.timing_noise import TimingNoise
from vjm.simulation.variational_equations import ModalBasis, PerturbedArm

_LARGEST_DERIVATIVE = 1e100  # of a weighted value, whose square is then still a finite number
# Modes that chains may exchange are nearer to each other; the first ten of a beam are further apart, ((2k+1)/(2k-1))^2.
_FREQUENCY_TOLERANCE = 0.1
# Values that errors of a given motion make at once, 0.3 GB: the slowest, in a minute of five markers up to 5 Hz.
_MOST_ERROR_VALUES = 40_000_000
_INDEPENDENT_OF_PRIOR = ("timing_noise", "residual", "chi2", "stride", "basis")  # cached, and kept with another prior


@dataclass(frozen=True)
class InitialStatePrior:
    """Weak normal prior of a recording's initial state, centred at rest.

    One standard deviation is the energy of bending the arm by a tenth of its length, and one radian of an active joint.
    In faster modes of bending it falls as 1/omega^2, as in the shape that a force at the tip bends. The prior counts as
    much as one or two measured values, and matters only for motion that the recording cannot show.

    Attributes:
        rest: (2 nv,) angles of rest at the first measured active angles, and zero rates [rad, rad/s].
        sqrt_information: (2 nv, 2 nv) S, where |S (state - rest)|^2 is added to chi^2.
        scale: factor of S: the RMS weighted residual, if that is above one, since one value then tells less.
    """

    rest: Array
    sqrt_information: Array
    scale: float = 1.0

    @classmethod
    def of(cls, arm: Arm, recording: Recording, scale: float = 1.0) -> InitialStatePrior:
        """Return the prior of an arm at a recording's beginning.

        Raises:
            SimulationDivergedError: joints that move nothing.
        """
        # Not a copy of the same chain, whose mechanism would have to be built again.
        chain = replace(arm.chain, armature=0.0) if arm.chain.armature else arm.chain
        recording = arm.inputs(recording)
        M, _, _, q = linearise(chain, recording.payload_body, recording.gravity, recording.initial_theta)
        stiffness = min(link.bending_stiffness for link in chain.links)
        energy = 1.5 * stiffness * 0.1**2 / sum(link.length for link in chain.links)
        n = chain.size
        root = np.zeros((2 * n, 2 * n))
        root[range(n), range(n)] = np.sqrt(chain.stiffness / (2 * energy))
        root[chain.active, chain.active] = 1.0
        bends = np.r_[chain.passive_slices]
        block, K = np.ix_(bends, bends), np.diag(chain.stiffness[bends])
        rates = M / (2 * energy)
        try:
            # Energies that fall as 1/omega^2 are those of K M^-1 K and K, where all modes alike would have K and M.
            slowest = 2 * energy * eigh(K, M[block], eigvals_only=True, subset_by_index=[0, 0])[0]
            root[block] = solve_triangular(np.linalg.cholesky(slowest * M[block]), K, lower=True)
            rates[block] = K / slowest
            root[n:, n:] = np.linalg.cholesky(rates).T
        except np.linalg.LinAlgError:
            problem, remedy = "a joint moves nothing that has inertia", "give its hub some"
            raise SimulationDivergedError(float(recording.time[0]), 0.0, remedy, problem) from None
        return cls(np.concatenate([q, np.zeros(n)]), root, scale)


@dataclass(frozen=True)
class Run:
    """A simulation of one recording or segment from an initial state, and the measurements.

    Attributes:
        observed: the measurements.
        prior: prior of the initial state.
        arm: the arm that was simulated.
        state: (2 nv,) initial angles and rates [rad, rad/s].
        trajectory: the motion at the integrator's instants.
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
    def predicted(self) -> Array:
        """(N,) what the sensors would show [m, rad]."""
        return self.observed.predicted(self.arm, self.trajectory)

    @cached_property
    def residual(self) -> Array:
        """(N,) measured less simulated, weighted and whitened."""
        return self._whiten_timing(self.observed.residual(self.arm, self.trajectory))

    @cached_property
    def timing_noise(self) -> TimingNoise:
        """Errors of the instants at which the frames were taken."""
        return TimingNoise.of(self.observed, self.arm, self.trajectory)

    def _whiten_timing(self, weighted: Array) -> Array:
        """Whiten weighted values (N, ...) that errors of the frames' instants correlate."""
        return self.timing_noise.whitened(weighted) if self.arm.timing_variance else weighted

    @cached_property
    def chi2(self) -> float:
        """Minus twice the log-likelihood, up to a constant: sum of squared residuals, and log det of timing noise."""
        return float(self.residual @ self.residual) + self.log_determinant

    @property
    def expected_chi2(self) -> float:
        """Expected value of `chi2` where the model is right: the number of values, and log det of timing noise."""
        return self.observed.count + self.log_determinant

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the residuals' covariance by timing noise; zero without any."""
        return self.timing_noise.log_determinant if self.arm.timing_variance else 0.0

    @cached_property
    def cost(self) -> float:
        """Objective of the search for the initial state: the residuals' loss, and the prior's term."""
        deviation = self.prior.scale * (self.prior.sqrt_information @ (self.state - self.prior.rest))
        return float(np.sum(self.observed.loss.value(self.residual**2)) + deviation @ deviation) + self.log_determinant

    def with_scaled_prior(self) -> Run:
        """Return the run with its prior scaled by its own RMS weighted residual, if that is above one."""
        return self.with_prior_scale(float(np.sqrt(max(self.chi2 / max(self.expected_chi2, 1), 1.0))))

    def with_prior_scale(self, scale: float) -> Run:
        """Return the run with another scale of its prior; what does not depend on it is not computed again."""
        run = replace(self, prior=replace(self.prior, scale=scale))
        run.__dict__.update({name: self.__dict__[name] for name in _INDEPENDENT_OF_PRIOR if name in self.__dict__})
        return run

    @cached_property
    def stride(self) -> int:
        """Number of integrator steps in half an interval of the variational equations."""
        return steps_per_half_interval(self.chain, self.observed.recording, self.trajectory.step)

    @cached_property
    def basis(self) -> ModalBasis:
        """The m modes in which derivatives are expressed."""
        driven, interval = self.arm.inputs(self.observed.recording), 2 * self.stride * self.trajectory.step
        return ModalBasis.of(self.chain, driven, interval, is_nonsmooth(self.arm.effects))

    def transferred_state(self, arm: Arm) -> Array:
        """Transfer the initial state (2 nv,) to an arm with other virtual joints, keeping the active joints' momentum.

        Recordings hardly determine the rates of fast modes, which interpolation between joints would pass on to slower
        ones: that part is left out. Without the momentum's correction a joint that turns freely would drift.
        """
        q, v = np.split(self.state, 2)
        other_q, other_v = np.split(transfer_state(self.chain, arm.chain, self.state), 2)
        passive, other_passive = self.chain.passive, arm.chain.passive
        modes, inertia = self._locked_modes(self.arm)
        other_modes, other_inertia = self._locked_modes(arm)
        rates = np.zeros((2 * self.chain.size, modes.frequencies.size))
        rates[self.chain.size + passive] = modes.shapes
        interpolated = transfer_state(self.chain, arm.chain, rates)[arm.chain.size + other_passive]
        # How much of the other arm's j-th mode (rows) is in the k-th. Slower is what comes before it in order and in
        # frequency: chains with few joints may be far off in frequency, and exchange modes that are as fast.
        by_modes = other_modes.shapes.T @ other_inertia @ interpolated
        slower = other_modes.frequencies[:, None] < (1 - _FREQUENCY_TOLERANCE) * modes.frequencies
        by_modes[np.triu(slower, 1)] = 0.0
        other_v[other_passive] = other_modes.shapes @ (by_modes @ (modes.shapes.T @ inertia @ v[passive]))
        active = arm.chain.active
        if not active.size:
            return np.concatenate([other_q, other_v])
        recording = self.observed.recording
        mass = mechanism_of(self.chain, self.arm.inputs(recording).payload_body).mass_matrix(q[None])[0]
        other_mass = mechanism_of(arm.chain, arm.inputs(recording).payload_body).mass_matrix(other_q[None])[0]
        lost_momentum = (mass @ v)[self.chain.active] - (other_mass @ other_v)[active]
        other_v[active] += np.linalg.solve(other_mass[np.ix_(active, active)], lost_momentum)
        return np.concatenate([other_q, other_v])

    def _locked_modes(self, arm: Arm) -> tuple[Modes, Array]:
        driven = arm.inputs(self.observed.recording)
        return locked_modes(arm.chain, driven.payload_body, driven.gravity, driven.initial_theta)

    def linearization(self, perturbed: Sequence[PerturbedArm] = ()) -> Linearization:
        """Return the linearization of the simulation by its initial state, and by the parameters of perturbed arms."""
        # Where the arm sticks, it is known when: dry friction needs not be gradual.
        arm, *others = (
            each if self.arm.has_dry_friction else each.smooth
            for each in (self.arm, *(perturbation.arm for perturbation in perturbed))
        )
        smooth = [perturbation._replace(arm=other) for perturbation, other in zip(perturbed, others, strict=True)]
        return Linearization(self.observed, arm, self.basis, smooth, self.trajectory, self.stride)

    def jacobian(self, linearization: Linearization) -> Iterator[tuple[Indices, Array]]:
        """Yield indices (r,) of values and derivatives (r, 2 slow + p) of their weighted and whitened predictions."""
        parts = linearization.jacobian()
        if self.observed.is_white and not self.arm.timing_variance:
            yield from parts
            return
        rows, slopes = zip(*parts, strict=True)
        measured = np.concatenate(rows)
        all_slopes = np.empty((measured.size, slopes[0].shape[1]))
        all_slopes[measured] = np.concatenate(slopes)
        yield np.arange(measured.size), self._whiten_timing(self.observed.whitened(all_slopes))

    def weighted_jacobian(self, linearization: Linearization) -> Iterator[tuple[Array, Array]]:
        """Yield derivatives (r, 2 slow + p) of predictions and residuals (r,), weighted by the robust loss."""
        weights = np.sqrt(self.observed.loss.slope(self.residual**2))
        for measured, part in self.jacobian(linearization):
            yield weights[measured, None] * part, weights[measured] * self.residual[measured]

    def linearized(self, linearization: Linearization) -> SquareRootInformation:
        """Return the linearised least-squares problem of the slow modes' initial coordinates, rates, and parameters.

        Raises:
            SimulationDivergedError: derivatives that are not finite.
        """
        columns = 2 * self.basis.slow_count + len(linearization.perturbed)
        problem = SquareRootInformation.of(self.weighted_jacobian(linearization), columns)
        problem = problem.with_rows(*self.prior_rows(columns)).with_rows(*self.timing_rows(linearization))
        if not np.abs(problem.R).max(initial=0.0) < _LARGEST_DERIVATIVE:
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

    def timing_rows(self, linearization: Linearization, likelihood_ratio: bool = False) -> tuple[Array, Array]:
        """Return the row (r, columns) and right-hand side (r,) of the timing noise's variance; r is 0 or 1.

        Args:
            linearization: of this run.
            likelihood_ratio: True for a row that predicts the likelihood ratio at the best variance, however large that
                is; False for the score at the present one.
        """
        variance = self.arm.timing_variance
        by_parameters = [
            (perturbed_arm.timing_variance - variance) / step for perturbed_arm, step in linearization.perturbed
        ]
        columns = 2 * self.basis.slow_count + len(by_parameters)
        if not any(by_parameters):
            return np.zeros((0, columns)), np.zeros(0)
        noise = self.timing_noise
        slope, residual = (noise.likelihood_ratio if likelihood_ratio else noise.score)(self.residual)
        row = np.r_[np.zeros(columns - len(by_parameters)), slope * np.array(by_parameters)]
        return row[None], np.array([residual])

    def scores(self, linearization: Linearization, linearized: SquareRootInformation) -> Array:
        """Return the scores (T, p): each instant's part in the gradient of -chi^2 / 2, initial state eliminated."""
        instants = self.observed.instants
        scores = np.zeros((self.observed.recording.time.size, len(linearization.perturbed)))
        for measured, slopes in self._parameter_jacobian(linearization, linearized):
            np.add.at(scores, instants[measured], slopes * self.residual[measured, None])
        return scores

    def with_motion_errors(self, observed: Observations) -> Observations:
        """Return measurements of the same motion with what errors of given motions make of the markers.

        Of the encoders' readings, from which the motions are, no more than their own noise is known.
        """
        if not observed.encoders_are_input:
            return observed
        run, effects, recording = replace(self, observed=observed), self.arm.smooth.effects, observed.recording
        resolved = 4 * 2 * self.stride * self.trajectory.step  # four intervals of the variational equations
        most = max(1, _MOST_ERROR_VALUES // (observed.count * recording.theta.shape[1]))
        errors = [
            PerturbedArm(Arm(self.chain, (*effects, error)), 1.0)
            for error in acceleration_errors(recording, observed.noise[1], resolved, most)
        ]
        by_errors = np.zeros((observed.count, len(errors)))
        for measured, slopes in run.linearization(errors).jacobian():
            by_errors[measured] = slopes[:, slopes.shape[1] - len(errors) :]
        by_errors[observed.marker_indices.size :] = 0.0
        return replace(observed, motion_errors=principal_errors(by_errors))

    def _parameter_jacobian(
        self, linearization: Linearization, linearized: SquareRootInformation
    ) -> Iterator[tuple[Indices, Array]]:
        """Yield indices (r,) of values and derivatives (r, p) by parameters, initial state eliminated."""
        states = linearized.columns - len(linearization.perturbed)
        by_parameters = linearized.elimination_jacobian(states)
        for measured, part in self.jacobian(linearization):
            yield measured, part[:, states:] - part[:, :states] @ by_parameters

    def residual_series(self) -> list[Array]:
        """Return weighted residuals of each kind of sensor, (F, 2 k) and (T, n_a); NaN where nothing was measured."""
        return [series for series in self.observed.on_grid(self.residual) if np.isfinite(series).any()]

    def simulated_recording(self, converged: bool) -> SimulatedRecording:
        """Return the run as a record; `converged` says whether the search for its initial state did."""
        observed = self.observed
        return SimulatedRecording(
            recording=observed.recording,
            simulation=sensor_readings(self.arm, observed.arcs, observed.recording, self.trajectory),
            noise=observed.noise,
            status="converged" if converged else "not converged",
        )


def is_followed(runs: Sequence[Run]) -> bool:
    """Return True if a recording's runs follow its motion so closely that their linearization is valid.

    An oscillation whose phase is off by phi leaves a residual of 2 sin(phi/2) times its amplitude. Up to 30 % of the
    motion (phi = 17 deg) that is linear in phi within 0.5 %, so that derivatives lead to the minimum.
    """
    excess = sum(run.chi2 - run.expected_chi2 for run in runs)
    motion = sum(run.observed.signal_power for run in runs)
    return all(run.observed.recording.kind == "quiet" for run in runs) or excess <= 0.3**2 * motion


def by_recording(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Return the runs of each recording's segments, by its file."""
    grouped: dict[str, list[Run]] = {}
    for run in runs:
        grouped.setdefault(run.observed.recording.file, []).append(run)
    return grouped


def all_followed(runs: Sequence[Run]) -> bool:
    """Return True if each recording is followed by the runs of it."""
    return all(map(is_followed, by_recording(runs).values()))


def earlier_runs(runs: Sequence[Run], observed: Observations) -> list[Run]:
    """Return the runs of the same recording that begin before a segment of it and last until it begins."""
    began, same_recording = observed.recording.time[0], by_recording(runs).get(observed.recording.file, [])
    return [run for run in same_recording if run.trajectory.time[0] < began <= run.trajectory.time[-1]]


def state_at(runs: Sequence[Run], observed: Observations) -> Array:
    """Return the state (2 nv,) in which the runs of a recording pass the beginning of a segment of it."""
    instant = observed.recording.time[:1]
    paths = [run.trajectory for run in by_recording(runs)[observed.recording.file]]
    begun = [path for path in paths if path.time[0] <= instant[0]]
    path = max(begun, key=lambda path: float(path.time[0]), default=paths[0])
    return np.concatenate([values[0] for values in path.sample(instant)])


def linearize(runs: Sequence[Run], perturbed: Sequence[Sequence[PerturbedArm]]) -> Iterator[Linearization]:
    """Yield each run's linearization by its perturbed arms; short runs of the same arms are computed in one batch."""
    yield from computed_together([run.linearization(arms) for run, arms in zip(runs, perturbed, strict=True)])


def linearize_by_states(runs: Sequence[Run]) -> None:
    """Compute runs' linearised problems of their initial states together, which is faster than one after another."""
    unknown = [run for run in runs if "linearized_by_state" not in run.__dict__]
    for run, linearization in zip(unknown, linearize(unknown, [()] * len(unknown)), strict=True):
        run.__dict__["linearized_by_state"] = run.linearized(linearization)


def _derivative_step(chain: Chain, recordings: Sequence[Recording]) -> float:
    """Return the longest step [s] with which derivatives resolve the fastest mode of the chain or the camera."""
    _, fastest = locked_joint_frequencies(chain)
    frames = [recording.time[recording.frames] for recording in recordings]
    nyquist = 0.5 / min((float(np.median(np.diff(time))) for time in frames if time.size > 1), default=np.inf)
    return 0.25 / max(min(fastest, nyquist), 1e-300)  # a quarter of a period: derivatives advance two steps at a time


def simulate_runs(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    priors: Sequence[InitialStatePrior] | None,
    states: Sequence[Array],
    step_multiple: float,
) -> list[Run]:
    """Simulate several recordings in one batch, each from its initial state.

    Args:
        arms: one a recording.
        observed: the recordings.
        priors: priors of their initial states; None: those of the arms.
        states: (2 nv,) initial states.
        step_multiple: multiple of the integrator's default step.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    recordings = [values.recording for values in observed]
    longest = _derivative_step(arms[0].chain, recordings)
    trajectories = _trajectories(arms, observed, states, None, step_multiple, longest)
    if priors is None:
        priors = [InitialStatePrior.of(arm, recording) for arm, recording in zip(arms, recordings, strict=True)]
    return [Run(*parts) for parts in zip(observed, priors, arms, states, trajectories, strict=True)]


def _trajectories(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    states: Sequence[Array],
    step: float | None,
    step_multiple: float,
    longest: float = np.inf,
) -> list[Trajectory]:
    """Simulate several recordings in one batch; see `simulate_trajectories`."""
    q, v = zip(*(np.split(state, 2) for state in states), strict=True)
    z = [values.internal_states(arm, angles) for values, arm, angles in zip(observed, arms, q, strict=True)]
    recordings, began = [values.recording for values in observed], [values.began for values in observed]
    return simulate_trajectories(arms, recordings, q, v, step, step_multiple, longest, began, z)
