"""The torque method (eqs. 14-16), and with natural frequencies (section 6.5): from recordings to coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vjm.chain.records import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.records import Experiment, Recording
from vjm.identification.assess import MATCH_TOLERANCE
from vjm.identification.data import Data
from vjm.identification.parametrisation import Parametrisation
from vjm.identification.select import nominal_chain
from vjm.identification.torque_fit import FrequencyTarget, Progress, TorqueFit, TorqueProblem, fit_torque, spread_of
from vjm.modes import modes
from vjm.spectrum import MeasuredModes, match

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
