"""The torque method (eqs. 14-16), and with natural frequencies (section 6.5): from recordings to coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import approx_fprime, least_squares, lsq_linear

from vjm.chain.layout import starting_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.spectrum import match
from vjm.identification.parameters import NEAREST_TO_BOUND, Parametrisation
from vjm.identification.training_data import TrainingData
from vjm.model.modes import modes
from vjm.records import Array, Progress

MODE_TOLERANCE = 0.15  # relative; consecutive bending modes are a factor of 2.8 or more apart, nominal values are not


@dataclass(frozen=True)
class _TorqueProblem:
    """Weighted torque errors of several recordings as a function of a parametrisation's coordinates."""

    data: TrainingData
    parametrisation: Parametrisation
    # Number of a mode of the model, from 0, its measured frequency and standard error [Hz] (section 6.5).
    targets: tuple[tuple[int, float, float], ...] = ()
    preference: tuple[Array, Array] | None = None  # centre and width (p,) where the data are silent
    residual_scale: float = 1.0  # weighted torque error that counts as one standard error beside the other terms

    def torque_residuals(self, x: Array) -> list[Array]:
        """Return the noise-weighted torque errors (S, r) of each recording at x (p,), weights belonging to x."""
        return self._weighted(x, x)

    def _weighted(self, x: Array, weighting: Array) -> list[Array]:
        """Return the torque errors (S, r) of each recording at x (p,) over their noise at other coordinates (p,)."""
        chain = self.parametrisation.chain(weighting)
        if not self.parametrisation.linear.all():
            return self.data.weighted_errors(self.parametrisation.chain(x), chain)
        with_one, weighting_with_one = np.r_[1.0, x], np.r_[1.0, weighting]
        return [
            prepared.over_noise(np.tensordot(with_one, errors, 1), chain, np.tensordot(weighting_with_one, inertias, 1))
            for prepared, (errors, inertias) in zip(self.data.prepared, self._linear_terms, strict=True)
        ]

    @cached_property
    def _linear_terms(self) -> list[tuple[Array, Array]]:
        """For each recording, torque errors (1 + p, S, r) and inertia (1 + p, nv, nv): constant, and by coordinate.

        Both are linear in stiffness, damping and hub inertia: one batched RNEA a coordinate does for the whole search.
        """
        chains = [self.parametrisation.chain(x) for x in np.eye(1 + len(self.parametrisation.coordinates))[:, 1:]]
        terms = []
        for prepared in self.data.prepared_for(chains[0]):
            errors = np.stack([prepared.determined_errors(chain) for chain in chains])
            inertias = np.stack([prepared.inertia(chain) for chain in chains])
            errors[1:] -= errors[0]
            inertias[1:] -= inertias[0]
            terms.append((errors, inertias))
        return terms

    def vector(self, x: Array) -> Array:
        """Return all residuals to minimise: torque errors, frequencies (section 6.5), and the preference."""
        parts = [residual.ravel() / self.residual_scale for residual in self.torque_residuals(x)]
        if self.targets:
            frequencies = modes(self.parametrisation.chain(x), self.data.payload, self.data.rig.gravity).frequencies
            mode, measured, std = np.array(self.targets).T
            # A small chain's frequencies are right to 0.05 %, however sharp the measured ones are.
            parts.append((frequencies[mode.astype(int)] - measured) / np.hypot(std, 5e-4 * measured))
        if self.preference is not None:
            parts.append((x - self.preference[0]) / self.preference[1])
        return np.concatenate(parts)

    def fit(self, progress: Progress | None = None, start: Array | None = None) -> TorqueFit:
        """Minimise from `start` (p,); by default from the template or, without a preference, the linear solution."""
        if start is None:
            start = self.parametrisation.start if self.preference is not None else self._linear_solution()
        lower, upper = self.parametrisation.bounds
        report, maximum, count = progress or (lambda *_: None), 100, 0

        def vector(x: Array) -> Array:
            nonlocal count
            count += 1
            report("fitting torque errors", min(count, maximum - 1), maximum)
            return self.vector(x)

        result = least_squares(
            vector,
            np.clip(start, lower + NEAREST_TO_BOUND, upper),
            bounds=(lower, upper),
            jac="3-point" if self.parametrisation.linear.all() else "2-point",  # the former is cheap then
            x_scale="jac",
            ftol=1e-10,
            xtol=1e-10,
            gtol=1e-10,
            max_nfev=maximum,
        )
        report("fitting torque errors", maximum, maximum)
        return TorqueFit(self, np.asarray(result.x), np.asarray(result.jac), result.status > 0)

    def evaluate(self, x: Array) -> TorqueFit:
        """Return the residuals and their derivatives at x (p,), without a search."""
        jacobian = approx_fprime(x, self.vector, 1e-6 * np.maximum(np.abs(x), 1e-2))
        return TorqueFit(self, x, np.asarray(jacobian), True)

    def _linear_solution(self) -> Array:
        """Solve for uniform links under the template's weights, in which their torque errors are linear."""
        start = self.parametrisation.start

        def vector(x: Array) -> Array:
            return np.concatenate([part.ravel() for part in self._weighted(x, start)])

        constant = vector(np.zeros(start.size))
        matrix = np.stack([vector(unit) - constant for unit in np.eye(start.size)], axis=1)  # exact, as they are linear
        return np.asarray(lsq_linear(matrix, -constant, bounds=self.parametrisation.bounds).x)


@dataclass(frozen=True)
class TorqueFit:
    """A minimum of the weighted torque errors."""

    problem: _TorqueProblem
    x: Array  # (p,) coordinates
    jacobian: Array  # (N, p) derivatives of `problem.vector` by them
    converged: bool  # True if the optimiser met its tolerance

    @property
    def chain(self) -> Chain:
        """The chain at x."""
        return self.problem.parametrisation.chain(self.x)

    def refined(self, parameters: str) -> _TorqueProblem:
        """Return the problem with more parameters, which starts from this fit and prefers it where data are silent."""
        parametrisation = Parametrisation(self.chain, parameters, self.problem.parametrisation.hubs)
        return replace(self.problem, parametrisation=parametrisation, preference=parametrisation.preference)

    def rescaled(self) -> _TorqueProblem:
        """Return the problem with residuals over their RMS and the root of the number of samples per independent one.

        Else a model that misses more than the noise, or samples that the filter correlates, would outweigh other terms.
        """
        residuals = np.concatenate([residual.ravel() for residual in self.problem.torque_residuals(self.x)])
        prepared = self.problem.data.prepared  # whose filters do not depend on the cuts
        independent = float(np.mean([recording.derivatives.gains[0, 0] for recording in prepared]))
        scale = np.sqrt(max(float(np.mean(residuals**2)), 1.0) / min(independent, 1.0))
        return replace(self.problem, residual_scale=float(scale))

    def with_frequencies(self, progress: Progress | None = None) -> TorqueFit:
        """Fit again, with the natural frequencies that the recordings show (section 6.5).

        Raises:
            InsufficientDataError: none of them is a mode of the model.
        """
        data = self.problem.data
        matches = [match(f, data.modes, MODE_TOLERANCE) for f in modes(self.chain, data.payload).frequencies.tolist()]
        targets = tuple((mode, *measured[:2]) for mode, measured in enumerate(matches) if measured is not None)
        if not targets:
            reason = "no peak of the recordings' spectra is near a mode of the model"
            raise InsufficientDataError("torque+frequency", reason, "use method 'torque'")
        return replace(self.problem, targets=targets).fit(progress, self.x)


def fit_torque(
    data: TrainingData, parameters: str = "uniform", frequencies: bool = False, progress: Progress | None = None
) -> TorqueFit:
    """Fit a chain by its torque errors: uniform links from the nominal ones, other parameters from the uniform links.

    With `frequencies`, those that the recordings show are fitted as well (section 6.5).

    Raises:
        InsufficientDataError: no recording has what the method needs; or no measured frequency is the model's.
    """
    if not data.prepared:
        first = data.problems[0]
        raise InsufficientDataError("the torque method", f"{first.what}: {first.reason}", first.remedy)
    start = starting_chain(data.rig, data.cuts)
    hubs = data.driven_hubs([prepared.recording for prepared in data.prepared])
    fit = _TorqueProblem(data, Parametrisation(start, "uniform", hubs)).fit(progress)
    problem = fit.rescaled()
    fit = replace(fit, problem=problem, jacobian=fit.jacobian / problem.residual_scale)
    if parameters != "uniform":
        fit = fit.refined(parameters).fit(progress)
        # The preference's weight follows from what this model itself leaves; it settles in two or three rounds.
        for _ in range(5):
            before, problem = fit.problem.residual_scale, fit.rescaled()
            fit = problem.fit(progress, fit.x)
            if abs(problem.residual_scale - before) < 0.1 * before:
                break
    return fit.with_frequencies(progress) if frequencies else fit
