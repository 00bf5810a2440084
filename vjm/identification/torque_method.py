"""The torque method (eqs. 14-16), and with natural frequencies (section 6.5): from recordings to coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import least_squares, lsq_linear

from vjm.chain.layout import chain_layouts, nominal_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.spectrum import MeasuredModes, match
from vjm.identification.parameters import Parametrisation
from vjm.identification.prepare import Data, Prepared, Settings, prepare
from vjm.model import dynamics
from vjm.model.modes import modes
from vjm.model.torque import torque_errors
from vjm.records import Array, Experiment, Progress, Recording, Rig

_RIDGE = 1e-12  # of the mean variance; keeps exact data's covariance invertible
_MOST_EVALUATIONS = 100
_TOLERANCE = 1e-10


@dataclass(frozen=True)
class FrequencyTarget:
    """A measured natural frequency for section 6.5's term.

    Attributes:
        mode: its number in the model, from 0.
        frequency: [Hz].
        std: standard error [Hz].
    """

    mode: int
    frequency: float
    std: float


@dataclass(frozen=True)
class TorqueFit:
    """A minimum of the objective.

    Attributes:
        x: (p,) coordinates.
        residuals: weighted torque errors of each recording, (S, r) each.
        jacobians: their derivatives by x, (S, r, p) each.
        frequency_residuals, frequency_jacobian: (f,) and (f, p) of the frequency term.
        prepared: the recordings at the found lengths.
        converged: whether the optimiser met its tolerance.
        spread: the problem's.
    """

    x: Array
    residuals: tuple[Array, ...]
    jacobians: tuple[Array, ...]
    frequency_residuals: Array
    frequency_jacobian: Array
    prepared: tuple[Prepared, ...]
    converged: bool
    spread: float


@dataclass(frozen=True)
class TorqueProblem:
    """Weighted torque errors of several recordings as a function of a parametrisation's coordinates.

    Attributes:
        rig: the arm.
        parametrisation: the coordinates.
        given: the recordings, prepared at the template's lengths.
        settings: how they were prepared.
        targets: measured natural frequencies (section 6.5); none for the plain torque method.
        payload: extra tip mass with which the targets were measured [kg].
        preference: centre and width (p,) of the coordinates wanted where the data are silent; None: no preference.
        spread: size of the weighted torque errors that counts as one standard error beside the other terms.
    """

    rig: Rig
    parametrisation: Parametrisation
    given: tuple[Prepared, ...]
    settings: Settings
    targets: tuple[FrequencyTarget, ...] = ()
    payload: float = 0.0
    preference: tuple[Array, Array] | None = None
    spread: float = 1.0

    def prepared(self, chain: Chain) -> tuple[Prepared, ...]:
        """The recordings at the chain's lengths, through the filter found at the start."""
        if self.parametrisation.kind not in ("lengths", "full"):
            return self.given
        cuts = chain_layouts(chain)
        return tuple(prepare(self.rig, cuts, given.recording, self.settings, given) for given in self.given)

    def errors(self, x: Array, prepared: Sequence[Prepared]) -> list[Array]:
        """Torque errors (S, r) of each recording in the rows the data speak of [N m]."""
        chain = self.parametrisation.chain(x)
        return [seen_errors(chain, one) for one in prepared]

    def weighted(self, x: Array) -> list[Array]:
        """Noise-weighted torque errors (S, r) of each recording, weights belonging to x."""
        chain = self.parametrisation.chain(x)
        prepared = self.prepared(chain)
        return [whiten(seen_errors(chain, one), noise_factor(chain, one)) for one in prepared]

    def frequency_residuals(self, x: Array) -> Array:
        """(f,) model frequencies less measured ones, in standard errors (section 6.5)."""
        if not self.targets:
            return np.empty(0)
        found = modes(self.parametrisation.chain(x), self.payload, self.rig.gravity).frequencies
        return np.array([(found[target.mode] - target.frequency) / target.std for target in self.targets])

    def vector(self, x: Array) -> Array:
        """Everything the final search minimises the squares of."""
        torque = [r.ravel() / self.spread for r in self.weighted(x)]
        return np.concatenate([*torque, self.frequency_residuals(x), self.preferred(x)])

    def preferred(self, x: Array) -> Array:
        """(p,) distance from the preferred coordinates in their widths; empty without a preference."""
        if self.preference is None:
            return np.empty(0)
        centre, width = self.preference
        return (x - centre) / width


def seen_errors(chain: Chain, prepared: Prepared) -> Array:
    """(S, r) torque errors in the rows the data speak of [N m]."""
    recording = prepared.recording
    errors = torque_errors(
        chain, prepared.q, prepared.v, prepared.a, prepared.tau, recording.payload, recording.gravity
    )
    return np.nan_to_num(errors) @ prepared.rows


def noise_factor(chain: Chain, prepared: Prepared) -> Array:
    """(r, r) Cholesky factor of the torque errors' noise covariance [N m]."""
    recording = prepared.recording
    mechanism = dynamics.build(chain, recording.payload, recording.gravity)
    inertia = dynamics.mass_matrix(mechanism, prepared.q.mean(axis=0)[None])[0]
    factors = [prepared.rows.T @ A for A in (np.diag(chain.stiffness), np.diag(chain.damping), inertia)]
    gains, noise = prepared.derivatives.gains, prepared.angles.covariance
    covariance = sum(gains[i, j] * factors[i] @ noise @ factors[j].T for i in range(3) for j in range(3))
    covariance = np.asarray(covariance)
    covariance = (covariance + covariance.T) / 2
    return cholesky(covariance + _RIDGE * np.trace(covariance) * np.eye(len(covariance)), lower=True)


def whiten(errors: Array, factor: Array) -> Array:
    """Errors (S, r) divided by the noise's Cholesky factor."""
    result: Array = solve_triangular(factor, errors.T, lower=True).T
    return result


def fit_torque(problem: TorqueProblem, progress: Progress | None = None, start: Array | None = None) -> TorqueFit:
    """Minimise the torque errors: variable projection with fixed weights, then all coordinates with their own weights.

    Args:
        problem: the recordings and the parametrisation.
        progress: told (text, done, total) now and then.
        start: (p,) coordinates of an earlier fit; from the template when None.
    """
    parametrisation = problem.parametrisation
    if start is None:
        start = parametrisation.start
        if problem.preference is None:
            start = _projected_start(problem, start)
    lower, upper = parametrisation.bounds
    start = np.clip(start, lower + 1e-6, upper)
    count = 0

    def vector(x: Array) -> Array:
        nonlocal count
        count += 1
        if progress is not None:
            progress("fitting torque errors", min(count, _MOST_EVALUATIONS - 1), _MOST_EVALUATIONS)
        return problem.vector(x)

    result = least_squares(
        vector,
        start,
        bounds=(lower, upper),
        x_scale="jac",
        ftol=_TOLERANCE,
        xtol=_TOLERANCE,
        gtol=_TOLERANCE,
        max_nfev=_MOST_EVALUATIONS,
    )
    x = np.asarray(result.x)
    if progress is not None:
        progress("fitting torque errors", _MOST_EVALUATIONS, _MOST_EVALUATIONS)
    return _unpacked(problem, x, np.asarray(result.jac), result.status > 0)


def evaluate(problem: TorqueProblem, x: Array) -> TorqueFit:
    """The residuals and their derivatives at x, without a search."""
    base = problem.vector(x)
    columns = []
    for k, value in enumerate(x):
        step = 1e-6 * max(abs(value), 1e-2)
        moved = x.copy()
        moved[k] += step
        columns.append((problem.vector(moved) - base) / step)
    return _unpacked(problem, x, np.stack(columns, axis=1), True)


def _unpacked(problem: TorqueProblem, x: Array, jacobian: Array, converged: bool) -> TorqueFit:
    residuals = problem.weighted(x)
    frequency = problem.frequency_residuals(x)
    jacobians, start = [], 0
    for residual in residuals:
        block = problem.spread * jacobian[start : start + residual.size]
        jacobians.append(block.reshape(*residual.shape, x.size))
        start += residual.size
    return TorqueFit(
        x=x,
        residuals=tuple(residuals),
        jacobians=tuple(jacobians),
        frequency_residuals=frequency,
        frequency_jacobian=jacobian[start : start + frequency.size],
        prepared=problem.prepared(problem.parametrisation.chain(x)),
        converged=converged,
        spread=problem.spread,
    )


def spread_of(fit: TorqueFit) -> float:
    """Root mean square of the weighted errors times that of the samples each independent one stands for.

    Neither a model that misses more than the noise nor samples that the filter has made alike may outvote the rest.
    """
    squares = sum(float(np.sum(r**2)) for r in fit.residuals)
    count = sum(r.size for r in fit.residuals)
    independent = float(np.mean([prepared.derivatives.gains[0, 0] for prepared in fit.prepared]))
    return float(np.sqrt(max(squares / count, 1.0) / min(independent, 1.0)))


def _projected_start(problem: TorqueProblem, x: Array) -> Array:
    """Lengths and masses searched with K, D and hub inertia solved for inside, under the template's weights."""
    linear = problem.parametrisation.linear
    template = problem.parametrisation.chain(x)
    factors = [noise_factor(template, one) for one in problem.prepared(template)]

    def solved(outer: Array) -> Array:
        full = x.copy()
        full[~linear] = outer
        return _solve_linear(problem, full, factors)

    if linear.all():
        return solved(np.empty(0))

    def residual(outer: Array) -> Array:
        return _weighted_by(problem, solved(outer), factors)

    lower, upper = problem.parametrisation.bounds
    result = least_squares(residual, x[~linear], bounds=(lower[~linear], upper[~linear]), max_nfev=10)
    return solved(np.asarray(result.x))


def _weighted_by(problem: TorqueProblem, x: Array, factors: Sequence[Array]) -> Array:
    prepared = problem.prepared(problem.parametrisation.chain(x))
    return np.concatenate(
        [whiten(e, factor).ravel() for e, factor in zip(problem.errors(x, prepared), factors, strict=True)]
    )


def _solve_linear(problem: TorqueProblem, x: Array, factors: Sequence[Array]) -> Array:
    """The linear coordinates that minimise the errors under given weights, all others as in x."""
    linear = np.flatnonzero(problem.parametrisation.linear)
    prepared = problem.prepared(problem.parametrisation.chain(x))

    def vector(point: Array) -> Array:
        errors = problem.errors(point, prepared)
        return np.concatenate([whiten(e, factor).ravel() for e, factor in zip(errors, factors, strict=True)])

    base = x.copy()
    base[linear] = 0.0
    constant = vector(base)
    columns = []
    for k in linear:
        unit = base.copy()
        unit[k] = 1.0
        columns.append(vector(unit) - constant)  # exact: the errors are linear in these
    lower, upper = problem.parametrisation.bounds
    matrix = np.stack(columns, axis=1)
    solution = lsq_linear(matrix, -constant, bounds=(lower[linear], upper[linear]))
    result = x.copy()
    result[linear] = solution.x
    return result


_MODEL_FLOOR = 5e-4  # relative accuracy of a small chain's frequencies, however sharp the measured ones are
START_DAMPING = 1e-3  # s, Kelvin-Voigt time the search starts from
_MOST_PASSES = 5  # with a weight of the preference that follows from the pass before


def by_torque(
    experiment: Experiment, data: Data, progress: Progress | None = None, frequencies: bool = False
) -> tuple[TorqueProblem, TorqueFit]:
    """Identify by torque errors.

    Args:
        experiment: the rig.
        data: its recordings.
        progress: told (text, done, total) now and then.
        frequencies: also hold the model to the recordings' natural frequencies.

    Raises:
        InsufficientDataError: no recording has what the method needs; or no measured frequency is the model's.
    """
    problem, fit = fit_uniform(experiment, data, progress)
    if data.options.parameters != "uniform":
        # The uniform link found first is where the search starts, and what it keeps to where the data are silent.
        problem, fit = fit_refined(refined(problem, fit, data.options.parameters), progress)
    return with_frequencies(problem, fit, data, progress) if frequencies else (problem, fit)


def fit_uniform(
    experiment: Experiment, data: Data, progress: Progress | None = None
) -> tuple[TorqueProblem, TorqueFit]:
    """Fit uniform links, from the nominal ones.

    Raises:
        InsufficientDataError: no recording has what the method needs.
    """
    if not data.prepared:
        raise InsufficientDataError("the torque method", data.problems[0], "record more complete frames")
    start = nominal_chain(experiment.rig, data.plan.cuts, START_DAMPING)
    hubs = driven_hubs(experiment, [one.recording for one in data.prepared])
    parametrisation = Parametrisation(start, "uniform", hubs)
    problem = TorqueProblem(experiment.rig, parametrisation, data.prepared, data.settings, payload=data.payload)
    fit = fit_torque(problem, progress)
    return replace(problem, spread=spread_of(fit)), fit


def refined(problem: TorqueProblem, fit: TorqueFit, parameters: str) -> TorqueProblem:
    """The problem with more parameters, starting from a fit with fewer."""
    template = problem.parametrisation.chain(fit.x)
    parametrisation = Parametrisation(template, parameters, problem.parametrisation.hubs)
    return replace(problem, parametrisation=parametrisation, preference=parametrisation.preference)


def fit_refined(problem: TorqueProblem, progress: Progress | None = None) -> tuple[TorqueProblem, TorqueFit]:
    """Fit with a preference, whose weight beside the data follows from what this model itself leaves unexplained."""
    fit = fit_torque(problem, progress)
    for _ in range(_MOST_PASSES):
        before = problem.spread
        problem = replace(problem, spread=spread_of(fit))
        fit = fit_torque(problem, progress, fit.x)
        if abs(problem.spread - before) < 0.1 * before:
            break
    return problem, fit


def with_frequencies(
    problem: TorqueProblem, fit: TorqueFit, data: Data, progress: Progress | None = None
) -> tuple[TorqueProblem, TorqueFit]:
    """Hold a fit to the natural frequencies that the recordings show (section 6.5).

    Raises:
        InsufficientDataError: none of them is a mode of the model.
    """
    targets = _targets(problem.parametrisation.chain(fit.x), data.payload, data.seen)
    if not targets:
        raise InsufficientDataError(
            "torque+frequency", "no peak of the recordings' spectra is near a mode of the model", "use method 'torque'"
        )
    problem = replace(problem, targets=tuple(targets))
    return problem, fit_torque(problem, progress, fit.x)


def driven_hubs(experiment: Experiment, recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Links whose hub inertia shows: their active joint's torque was measured."""
    return tuple(
        link
        for k, link in enumerate(experiment.rig.active_links)
        if any(np.isfinite(recording.tau[:, k]).any() for recording in recordings)
    )


def _targets(chain: Chain, payload: float, seen: Sequence[MeasuredModes]) -> list[FrequencyTarget]:
    """Measured frequencies that belong to modes of the chain."""
    targets = []
    for mode, frequency in enumerate(modes(chain, payload).frequencies):
        found = match(float(frequency), seen, MATCH_TOLERANCE)
        if found is not None:
            std = float(np.hypot(found.frequency_std, _MODEL_FLOOR * found.frequency))
            targets.append(FrequencyTarget(mode, found.frequency, std))
    return targets


MATCH_TOLERANCE = 0.15  # a measured frequency this close to the model's is the same mode
