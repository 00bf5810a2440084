"""Many fits of one model to data like those recorded: bootstrap and Monte Carlo, on any executor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from vjm.errors import ChoiceError, InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.identification.information import of_trajectory, reach_of
from vjm.identification.records import Identification
from vjm.identification.torque_fit import Progress
from vjm.identification.trajectory_fit import fit_trajectory
from vjm.identification.trajectory_problem import Point
from vjm.identification.uncertainty import covariance, to_physical
from vjm.simulate.observation import Observed
from vjm.simulate.run import Run

Array = NDArray[np.float64]
Kind = Literal["noise", "blocks"]
KINDS: tuple[str, ...] = get_args(Kind)


@dataclass(frozen=True)
class Resampled:
    """What the same fit finds in data made anew.

    Attributes:
        names: of the p parameters.
        truth: (p,) their values in the model that made the data.
        values: (B, p) found in each sample.
        std: (B, p) standard errors that each sample's fit gives itself.
        failed: number of samples whose fit did not converge; they are not among the values.
    """

    names: tuple[str, ...]
    truth: Array
    values: Array
    std: Array
    failed: int

    @property
    def spread(self) -> Array:
        """(p,) standard deviation over the samples."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))

    @property
    def bias(self) -> Array:
        """(p,) mean over the samples less the truth."""
        return np.asarray(np.mean(self.values, axis=0) - self.truth)

    @property
    def correlation(self) -> Array:
        """(p, p) correlation over the samples."""
        return np.asarray(np.corrcoef(self.values, rowvar=False)).reshape(len(self.names), len(self.names))

    def interval(self, confidence: float = 0.95) -> Array:
        """(p, 2) basic bootstrap interval of each parameter: the quantiles mirrored about the truth of the samples.

        Raises:
            ShapeError: a confidence outside (0, 1).
        """
        if not 0 < confidence < 1:
            raise ShapeError("confidence", confidence, "a number between 0 and 1")
        tails = [(1 + confidence) / 2, (1 - confidence) / 2]
        return np.asarray(2 * self.truth - np.quantile(self.values, tails, axis=0)).T


def bootstrap(
    fit: Identification,
    samples: int = 100,
    *,
    kind: str = "blocks",
    executor: Executor | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Resampled:
    """Fit data like those recorded again and again: how far do the parameters scatter?

    The data are the fitted trajectories with errors put back on: white noise of the sensors' size (a Monte Carlo
    study of the model), or the recordings' own residuals in blocks as long as they are correlated, which keeps their
    colour.

    Args:
        fit: of method `trajectory`.
        samples: number B of data sets.
        kind: of the errors: `blocks` or `noise`.
        executor: runs the fits; any `concurrent.futures.Executor`, such as a process pool's or
            `dask.distributed.Client.get_executor()`. None: one after another, here.
        seed: of the errors; the same seed gives the same samples on every executor.
        progress: told (text, done, total) after every fit.

    Raises:
        ChoiceError: an unknown kind.
        ShapeError: fewer than two samples.
        InsufficientDataError: a fit by another method, or too many fits that fail.
    """
    if kind not in KINDS:
        raise ChoiceError("kind", kind, KINDS)
    if samples < 2:
        raise ShapeError("samples", samples, "two or more")
    if fit.trajectory is None:
        raise InsufficientDataError("bootstrap", f"the fit is of method {fit.method!r}", "use method 'trajectory'")
    return resample(fit.trajectory.fit.point, samples, kind, executor, seed, progress)


def resample(
    point: Point,
    samples: int,
    kind: str = "noise",
    executor: Executor | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Resampled:
    """The same of any point, which need not be a minimum: with kind `noise`, data from a known truth."""
    seeds = np.random.SeedSequence(seed).spawn(samples)
    bare = replace(point, runs=tuple(replace(run) for run in point.runs))  # without what can be worked out again
    job = partial(_refit, bare, kind)
    run: Callable[..., object] = map if executor is None else executor.map
    found = []
    for k, each in enumerate(run(job, seeds)):  # type: ignore[arg-type, var-annotated]
        found.append(each)
        if progress is not None:
            progress("fitting resampled data", k + 1, samples)
    kept = [each for each in found if each is not None]
    if len(kept) < max(2, samples // 2):
        raise InsufficientDataError(
            "bootstrap", f"{samples - len(kept)} of {samples} fits failed", "identify fewer parameters"
        )
    values, std = (np.stack(each) for each in zip(*kept, strict=True))
    parametrisation = point.problem.parametrisation
    names = tuple(coordinate.name for coordinate in parametrisation.coordinates)
    return Resampled(names, parametrisation.physical(point.x), values, std, samples - len(kept))


def _refit(point: Point, kind: str, seed: np.random.SeedSequence) -> tuple[Array, Array] | None:
    """Parameters (p,) found in one data set, and their standard errors; None where the fit fails."""
    rng = np.random.default_rng(seed)
    errors = _noise if kind == "noise" else _blocks
    observed = tuple(_remade(run, errors(run, rng)) for run in point.runs)
    problem = replace(point.problem, observed=observed)
    try:
        fit = fit_trajectory(problem, point.x, states=[run.state for run in point.runs])
    except SimulationDivergedError:
        return None
    if not fit.converged:
        return None
    parametrisation, x = problem.parametrisation, fit.point.x
    information, _ = of_trajectory(fit, noise_known=True)
    return parametrisation.physical(x), np.sqrt(np.diag(to_physical(parametrisation, x, covariance(information))))


def _remade(run: Run, errors: Array) -> Observed:
    """The recording as the run would have made it, with weighted errors (N,)."""
    seen = run.observed
    return replace(seen, values=seen.predicted(run.arm, run.steps) + errors / seen.weights)


def _noise(run: Run, rng: np.random.Generator) -> Array:
    return rng.standard_normal(run.observed.count)


def _blocks(run: Run, rng: np.random.Generator) -> Array:
    """The run's own weighted residuals (N,), blocks as long as they are correlated drawn with replacement."""
    errors = []
    for series in run.series():
        # Instants at which the sensor showed nothing are no part of a block.
        rows = np.isfinite(series).any(axis=1)
        values = series[rows]
        length = min(reach_of(np.nan_to_num(values)), len(values))
        starts = rng.integers(0, len(values) - length + 1, -(-len(values) // length))
        drawn = np.concatenate([values[start : start + length] for start in starts])[: len(values)]
        # Where the block drawn has no value but one is wanted, the value itself stays.
        errors.append(np.where(np.isfinite(drawn), drawn, values)[np.isfinite(values)])
    return np.concatenate(errors)
