"""Records that pass between the stages: the experiment's, a parameter's estimate, and simulated recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from time import monotonic
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vjm.errors import require_choice
from vjm.experiment.payload import NO_PAYLOAD as NO_PAYLOAD
from vjm.experiment.payload import Payload as Payload
from vjm.experiment.records import Array as Array
from vjm.experiment.records import Complex as Complex
from vjm.experiment.records import Experiment as Experiment
from vjm.experiment.records import Indices as Indices
from vjm.experiment.records import Kind as Kind
from vjm.experiment.records import Link as Link
from vjm.experiment.records import Mask as Mask
from vjm.experiment.records import Recording as Recording
from vjm.experiment.records import Rig as Rig
from vjm.experiment.records import Role as Role
from vjm.text import unit, with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Progress = Callable[[str, int, int], None]  # called with (text, done, total) now and then


class Stages:
    """Overall progress of a computation whose number of stages is not known before: each takes a share of what remains.

    Where a larger share of the time budget has passed, that is the progress instead.
    """

    def __init__(self, progress: Progress | None, share: float, budget: float = math.inf) -> None:
        self._progress, self._share, self._budget = progress, share, budget
        self._began, self._stage, self._last = monotonic(), 0, ("", 0)

    def __call__(self, text: str) -> None:
        """Begin a stage."""
        self.inside(text, 0, 1)

    def inside(self, text: str, done: int, total: int) -> None:
        """Report the progress inside a stage; a new one begins where its name changes, or less is done than before.

        What follows a comma in the text is no part of the stage's name.
        """
        name, last = text.partition(",")[0], self._last
        self._stage += bool(last[0]) and (name != last[0] or done < last[1])
        self._last = name, done
        if self._progress is not None:
            stages = 1 - (1 - self._share) ** (self._stage + done / max(total, 1))
            spent = min((monotonic() - self._began) / self._budget, 1.0)
            self._progress(text, int(100 * max(stages, spent)), 100)


CI95 = 1.96  # standard errors: two-sided 95 % of a normal distribution
REFERENCE = "reference"  # the condition in which the effect being sought is known to be absent
VISIBLE_SHARE = 0.01  # of chi^2: a smaller change is one of 0.5 % of the RMS, less than the two digits shown of it
NOT_NOISE = 1e-3  # p-value below which residuals are not noise: three standard deviations


class Record:
    """Base of records that hold arrays or many other records: a repr of one line, without what is in those.

    Numbers and names at their defaults are left out.
    """

    def __repr__(self) -> str:
        values = ((field, getattr(self, field.name)) for field in fields(self))  # type: ignore[arg-type]
        parts = (
            f"{field.name}={_shown(value)}"
            for field, value in values
            if not (isinstance(value, str | float | int | None) and value == field.default)
        )
        return f"{type(self).__name__}({', '.join(parts)})"


def _shown(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"array {value.shape}"
    if isinstance(value, tuple | list) and value and (len(value) > 3 or is_dataclass(value[0])):
        return f"({len(value)} {type(value[0]).__name__})"
    if is_dataclass(value):
        return f"<{type(value).__name__}>"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


class Result:
    """Base of the results of an identification, a comparison, a check and a diagnosis: how they present themselves.

    The report is imported only when one of these methods is called.
    """

    def summary(self) -> str:
        """Return as plain text what the command prints: the verdict, its reasons, tables and warnings."""
        from vjm.report.output import result_page

        return result_page(self).text()  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, Any]:
        """Return the result object, the content of result.json: plain numbers, text, lists and dictionaries, SI."""
        from vjm.report.result_json import result_object

        return result_object(self)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        from vjm.report.output import result_page

        return result_page(self).brief(type(self).__name__)  # type: ignore[arg-type]

    def _repr_html_(self) -> str:
        from vjm.report.output import result_page

        return result_page(self).html(fragment=True)  # type: ignore[arg-type]


class SimulatedResult(Result):
    """Base of the results that hold simulations of all recordings."""

    experiment: Experiment
    recordings: tuple[RecordingComparison, ...]

    def plot_fit(self, recording: Recording | str | None = None, ax: Axes | None = None) -> NDArray[Any]:
        """Plot for each recording its outermost marker, measured and simulated [mm], against time [s].

        Args:
            recording: the only one to plot, or the name of its file; None: all.
            ax: axes to draw into, of one recording; None: a new figure.

        Returns:
            (k,) matplotlib axes, one for each recording that could be simulated.

        Raises:
            ChoiceError: a recording that is not among the result's.
            InsufficientDataError: nothing that could be simulated.
        """
        from vjm.report.figures.signals import plot_recordings

        return plot_recordings(self.experiment.rig, self.recordings, False, recording, ax)

    def plot_residuals(self, recording: Recording | str | None = None, ax: Axes | None = None) -> NDArray[Any]:
        """Plot for each recording its outermost marker's residual [mm], and the noise, against time [s].

        Arguments, axes and errors are those of `plot_fit`.
        """
        from vjm.report.figures.signals import plot_recordings

        return plot_recordings(self.experiment.rig, self.recordings, True, recording, ax)


@dataclass(frozen=True)
class Estimate:
    """One identified (or fixed) parameter.

    Attributes:
        name: `LINK.quantity` or `LINK.quantity_J`, as `beam.bending_stiffness` or `beam.stiffness_2`.
        value: in `unit`.
        std: standard error by the recordings' noise, in `unit`; None for a parameter that was not estimated.
        unit: SI.
        identifiable: whether the data determine it.
        reason: in words, why not; empty where they do.
        remedy: in words, which recording would; empty where they do.
        discretization_shift: what more virtual joints would change of the value, to first order, in `unit`; None where
            that was not measured.
        nonnegative: whether it cannot be below zero, where its interval then ends.
    """

    name: str
    value: float
    std: float | None
    unit: str
    identifiable: bool = True
    reason: str = ""
    remedy: str = ""
    discretization_shift: float | None = None
    nonnegative: bool = False

    def __str__(self) -> str:
        """Return the estimate as a line: `beam.bending_stiffness = 1.9741 ± 0.0005 N m²`."""
        return f"{self.name} = {with_error(self.value, self.error)} {unit(self.unit)}".rstrip()

    @property
    def std_discretisation(self) -> float | None:
        """Error by so few virtual joints, as a standard deviation [unit]; None where it was not measured."""
        return None if self.discretization_shift is None else abs(self.discretization_shift)

    @property
    def error(self) -> float | None:
        """Standard error by noise and discretization together [unit]; None where the parameter was not estimated."""
        return None if self.std is None else math.hypot(self.std, self.discretization_shift or 0.0)

    @property
    def ci95(self) -> tuple[float, float] | None:
        """95 % interval by noise and discretization together [unit]; None where the parameter was not estimated."""
        if self.error is None:
            return None
        lower, upper = self.value - CI95 * self.error, self.value + CI95 * self.error
        return max(lower, 0.0) if self.nonnegative else lower, upper


class ByParameter:
    """Base of the results that hold estimates by their parameters' names, such as `beam.bending_stiffness`."""

    parameters: tuple[Estimate, ...]

    def __getitem__(self, name: str) -> Estimate:
        """Return a parameter's estimate by its name.

        Raises:
            ChoiceError: no parameter of that name; the message lists those there are.
        """
        by_name = {estimate.name: estimate for estimate in self.parameters}
        require_choice("parameter's name", name, by_name)
        return by_name[name]

    def __contains__(self, name: object) -> bool:
        return name in list(self)

    def __iter__(self) -> Iterator[str]:
        return (estimate.name for estimate in self.parameters)


@dataclass(frozen=True, repr=False)
class Simulation(Record):
    """An open-loop trajectory at a recording's instants.

    Attributes:
        time: (T,) [s].
        q, v: (T, nv) joint angles [rad] and rates [rad/s].
        theta: (T, number of active joints) active joint angles [rad].
        markers: (T, k, 2) marker positions, each in its link's `markers_frame` [m].
    """

    time: Array
    q: Array
    v: Array
    theta: Array
    markers: Array

    @property
    def initial_state(self) -> Array:
        """(2 nv,) joint angles [rad] and rates [rad/s] at the first instant."""
        return np.concatenate([self.q[0], self.v[0]])


@dataclass(frozen=True, repr=False)
class SimulatedRecording(Record):
    """A recording beside its open-loop simulation from the most likely initial state.

    Attributes:
        recording: without coordinates that cannot be right.
        simulation: at the recording's instants, as its sensors would show it.
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        status: `converged`, or `not converged` (the remedy is a better model: the state alone cannot follow the data).
    """

    recording: Recording
    simulation: Simulation
    noise: tuple[float, float]
    status: Literal["converged", "not converged"]

    @cached_property
    def marker_residual(self) -> Array:
        """(T, k, 2) measured minus simulated marker coordinates [m]; NaN where none was measured."""
        return self.recording.markers - self.simulation.markers

    @cached_property
    def theta_residual(self) -> Array:
        """(T, n_a) measured minus simulated active joint angles [rad]; NaN where none was measured."""
        return self.recording.theta - self.simulation.theta

    @cached_property
    def marker_rms(self) -> float:
        """RMS of the residuals of all measured marker coordinates [m]; NaN without any."""
        return _rms(self.marker_residual)

    @cached_property
    def theta_rms(self) -> float | None:
        """RMS of the active joints' residuals [rad]; None where no angle was measured."""
        return _rms(self.theta_residual) if np.isfinite(self.theta_residual).any() else None


@dataclass(frozen=True, repr=False)
class RecordingComparison(Record):
    """One recording beside simulations of it by up to three models.

    Attributes:
        recording: without coordinates that cannot be right, and without outliers.
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        simulated: by the model that is judged: the identified one, or the one extended by the causes found; None where
            it cannot be simulated.
        reference: by the model it is compared with: of nominal values, or without causes; None as above.
        alternative: by a third model: what the torque method found, or the next best explanation; None where there is
            none.
        left_out: number of marker coordinates, impossible or outlying, that are not in `recording` any more.
        problem: why the recording cannot be simulated; empty otherwise.
    """

    recording: Recording
    noise: tuple[float, float]
    simulated: SimulatedRecording | None
    reference: SimulatedRecording | None = None
    alternative: SimulatedRecording | None = None
    left_out: int = 0
    problem: str = ""


def _rms(residual: Array) -> float:
    known = residual[np.isfinite(residual)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
