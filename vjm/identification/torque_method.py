"""The torque method (eqs. 14-16), and with natural frequencies (section 6.5): from recordings to coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import least_squares, lsq_linear

from vjm.chain.layout import nominal_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.spectrum import match
from vjm.identification.parameters import Parametrisation
from vjm.identification.training_data import PreparedRecording, TrainingData
from vjm.model import dynamics
from vjm.model.modes import modes
from vjm.model.torque import torque_errors
from vjm.records import Array, Progress

START_KELVIN_VOIGT = 1e-3  # s; searches start here, within a decade or two of metals' and polymers'
MODE_TOLERANCE = 0.15  # relative; consecutive bending modes are a factor of 2.8 or more apart, nominal values are not
_MODEL_ACCURACY = 5e-4  # relative, of a small chain's frequencies, however sharp the measured ones are
_MOST_EVALUATIONS = 100


class _FrequencyTarget(NamedTuple):
    """A measured natural frequency and its standard error [Hz], of the model's mode of that number (from 0)."""

    mode: int
    frequency: float
    std: float


@dataclass(frozen=True)
class TorqueProblem:
    """Weighted torque errors of several recordings as a function of a parametrisation's coordinates.

    Attributes:
        data: the recordings.
        parametrisation: the coordinates.
        targets: measured natural frequencies (section 6.5); none for the plain torque method.
        preference: centre and width (p,) of the coordinates wanted where the data are silent; None: no preference.
        residual_scale: weighted torque error that counts as one standard error beside the other terms.
    """

    data: TrainingData
    parametrisation: Parametrisation
    targets: tuple[_FrequencyTarget, ...] = ()
    preference: tuple[Array, Array] | None = None
    residual_scale: float = 1.0

    def torque_residuals(self, x: Array) -> list[Array]:
        """Return the noise-weighted torque errors (S, r) of each recording at x (p,), weights belonging to x."""
        chain = self.parametrisation.chain(x)
        return weighted_torque_errors(chain, self.data.prepared_for(chain), chain)

    def frequency_residuals(self, x: Array) -> Array:
        """Return the model's frequencies less the measured ones (f,), in standard errors (section 6.5)."""
        if not self.targets:
            return np.empty(0)
        frequencies = modes(self.parametrisation.chain(x), self.data.payload, self.data.rig.gravity).frequencies
        return np.array([(frequencies[target.mode] - target.frequency) / target.std for target in self.targets])

    def vector(self, x: Array) -> Array:
        """Return all residuals whose squares the search minimises."""
        torque = [r.ravel() / self.residual_scale for r in self.torque_residuals(x)]
        preferred = [] if self.preference is None else [(x - self.preference[0]) / self.preference[1]]
        return np.concatenate([*torque, self.frequency_residuals(x), *preferred])

    def fit(self, progress: Progress | None = None, start: Array | None = None) -> TorqueFit:
        """Minimise from `start` (p,); by default from the template or, without a preference, the linear solution."""
        parametrisation = self.parametrisation
        if start is None:
            start = parametrisation.start if self.preference is not None else _linear_solution(self)
        lower, upper = parametrisation.bounds
        report = progress or (lambda *_: None)
        count = 0

        def vector(x: Array) -> Array:
            nonlocal count
            count += 1
            report("fitting torque errors", min(count, _MOST_EVALUATIONS - 1), _MOST_EVALUATIONS)
            return self.vector(x)

        result = least_squares(
            vector,
            np.clip(start, lower + 1e-6, upper),
            bounds=(lower, upper),
            x_scale="jac",
            ftol=1e-10,
            xtol=1e-10,
            gtol=1e-10,
            max_nfev=_MOST_EVALUATIONS,
        )
        report("fitting torque errors", _MOST_EVALUATIONS, _MOST_EVALUATIONS)
        return self._linearized(np.asarray(result.x), np.asarray(result.jac), result.status > 0)

    def evaluate(self, x: Array) -> TorqueFit:
        """Return the residuals and their derivatives at x (p,), without a search."""
        base = self.vector(x)
        steps = 1e-6 * np.maximum(np.abs(x), 1e-2)
        columns = [
            (self.vector(x + step * unit) - base) / step for step, unit in zip(steps, np.eye(x.size), strict=True)
        ]
        return self._linearized(x, np.stack(columns, axis=1), True)

    def _linearized(self, x: Array, jacobian: Array, converged: bool) -> TorqueFit:
        residuals = self.torque_residuals(x)
        jacobians, start = [], 0
        for residual in residuals:
            block = self.residual_scale * jacobian[start : start + residual.size]
            jacobians.append(block.reshape(*residual.shape, x.size))
            start += residual.size
        frequency = jacobian[start : start + len(self.targets)]
        return TorqueFit(self, x, tuple(residuals), tuple(jacobians), frequency, converged)


@dataclass(frozen=True)
class TorqueFit:
    """A minimum of the weighted torque errors.

    Attributes:
        problem: what was minimised.
        x: (p,) coordinates.
        residuals: weighted torque errors of each recording, (S, r) each.
        jacobians: their derivatives by x, (S, r, p) each.
        frequency_jacobian: (f, p) of the frequency residuals.
        converged: True if the optimiser met its tolerance.
    """

    problem: TorqueProblem
    x: Array
    residuals: tuple[Array, ...]
    jacobians: tuple[Array, ...]
    frequency_jacobian: Array
    converged: bool

    @property
    def chain(self) -> Chain:
        """The chain at x."""
        return self.problem.parametrisation.chain(self.x)

    @property
    def residual_scale(self) -> float:
        """RMS weighted error times the root of the number of samples that each independent one stands for.

        Neither a model that misses more than the noise nor samples that the filter has made alike may outvote the rest.
        """
        mean_square = sum(float(np.sum(r**2)) for r in self.residuals) / sum(r.size for r in self.residuals)
        prepared = self.problem.data.prepared  # whose filters do not depend on the cuts
        independent = float(np.mean([one.derivatives.gains[0, 0] for one in prepared]))
        return float(np.sqrt(max(mean_square, 1.0) / min(independent, 1.0)))

    def refined(self, parameters: str) -> TorqueProblem:
        """Return the problem with more parameters, which starts from this fit and prefers it where data are silent."""
        parametrisation = Parametrisation(self.chain, parameters, self.problem.parametrisation.hubs)
        return replace(self.problem, parametrisation=parametrisation, preference=parametrisation.preference)

    def with_frequencies(self, progress: Progress | None = None) -> TorqueFit:
        """Fit again, with the natural frequencies that the recordings show (section 6.5).

        Raises:
            InsufficientDataError: none of them is a mode of the model.
        """
        data, targets = self.problem.data, []
        for mode, frequency in enumerate(modes(self.chain, data.payload).frequencies):
            measured = match(float(frequency), data.modes, MODE_TOLERANCE)
            if measured is not None:
                std = float(np.hypot(measured.frequency_std, _MODEL_ACCURACY * measured.frequency))
                targets.append(_FrequencyTarget(mode, measured.frequency, std))
        if not targets:
            reason = "no peak of the recordings' spectra is near a mode of the model"
            raise InsufficientDataError("torque+frequency", reason, "use method 'torque'")
        return replace(self.problem, targets=tuple(targets)).fit(progress, self.x)


def fit_torque(data: TrainingData, frequencies: bool = False, progress: Progress | None = None) -> TorqueFit:
    """Identify by torque errors and, if `frequencies`, by the recordings' natural frequencies as well.

    Raises:
        InsufficientDataError: no recording has what the method needs; or no measured frequency is the model's.
    """
    fit = fit_uniform_torque(data, progress)
    if data.parameters != "uniform":
        fit = _fit_refined(fit.refined(data.parameters), progress)
    return fit.with_frequencies(progress) if frequencies else fit


def fit_uniform_torque(data: TrainingData, progress: Progress | None = None) -> TorqueFit:
    """Fit uniform links by their torque errors, from the nominal ones.

    Raises:
        InsufficientDataError: no recording has what the method needs.
    """
    if not data.prepared:
        raise InsufficientDataError("the torque method", data.problems[0], "record more complete frames")
    start = nominal_chain(data.rig, data.cuts, START_KELVIN_VOIGT)
    hubs = data.driven_hubs([one.recording for one in data.prepared])
    fit = TorqueProblem(data, Parametrisation(start, "uniform", hubs)).fit(progress)
    return replace(fit, problem=replace(fit.problem, residual_scale=fit.residual_scale))


def _fit_refined(problem: TorqueProblem, progress: Progress | None = None) -> TorqueFit:
    """Fit with a preference, whose weight beside the data follows from what this model itself leaves unexplained."""
    fit = problem.fit(progress)
    for _ in range(5):  # the scale settles to 10 % in two or three
        before = problem.residual_scale
        problem = replace(problem, residual_scale=fit.residual_scale)
        fit = problem.fit(progress, fit.x)
        if abs(problem.residual_scale - before) < 0.1 * before:
            break
    return fit


def weighted_torque_errors(chain: Chain, prepared: Sequence[PreparedRecording], weighting: Chain) -> list[Array]:
    """Divide a chain's torque errors by the Cholesky factors of their noise, which are those of the `weighting` chain.

    Returns:
        (S, r) for each recording, in the rows that its data determine.
    """
    return [_whitened(chain, one, _noise_factor(weighting, one)) for one in prepared]


def _whitened(chain: Chain, prepared: PreparedRecording, factor: Array) -> Array:
    recording = prepared.recording
    errors = torque_errors(chain, *prepared.interior, recording.payload, recording.gravity)
    whitened: Array = solve_triangular(factor, (np.nan_to_num(errors) @ prepared.rows).T, lower=True).T
    return whitened


def _noise_factor(chain: Chain, prepared: PreparedRecording) -> Array:
    """(r, r) Cholesky factor of the torque errors' noise covariance [N m]."""
    recording = prepared.recording
    mechanism = dynamics.build(chain, recording.payload, recording.gravity)
    inertia = dynamics.mass_matrix(mechanism, prepared.interior[0].mean(axis=0)[None])[0]
    factors = [prepared.rows.T @ A for A in (np.diag(chain.stiffness), np.diag(chain.damping), inertia)]
    gains, noise = prepared.derivatives.gains, prepared.angles.covariance
    covariance = np.asarray(sum(gains[i, j] * factors[i] @ noise @ factors[j].T for i in range(3) for j in range(3)))
    covariance = (covariance + covariance.T) / 2
    ridge = 1e-12 * np.trace(covariance)  # keeps exact data's covariance invertible
    return cholesky(covariance + ridge * np.eye(len(covariance)), lower=True)


def _linear_solution(problem: TorqueProblem) -> Array:
    """Coordinates of uniform links under the template's weights, in which their torque errors are linear."""
    parametrisation, prepared = problem.parametrisation, problem.data.prepared
    template = parametrisation.chain(parametrisation.start)
    factors = [_noise_factor(template, one) for one in prepared]

    def vector(x: Array) -> Array:
        chain = parametrisation.chain(x)
        return np.concatenate([_whitened(chain, one, f).ravel() for one, f in zip(prepared, factors, strict=True)])

    count = len(parametrisation.coordinates)
    constant = vector(np.zeros(count))
    matrix = np.stack([vector(unit) - constant for unit in np.eye(count)], axis=1)  # exact, as they are linear
    return np.asarray(lsq_linear(matrix, -constant, bounds=parametrisation.bounds).x)
