"""The figures of a report, drawn, named and captioned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from matplotlib.figure import Figure

from vjm.identification.records import Identification
from vjm.records import Experiment, RecordingComparison
from vjm.report.figures.joints import joint_angles, torque_error_figure
from vjm.report.figures.motion import (
    MOST_RECORDINGS,
    fit_of_recordings,
    link_shapes,
    most_recordings,
    raw_markers,
    tip_motion,
)
from vjm.report.figures.residuals import MOST_ROWS, correlation_map, residual_map, residual_spectra
from vjm.report.figures.style import Picture, png
from vjm.report.figures.windows import liveliest, spread_over, tips
from vjm.report.text import listed, short
from vjm.simulation.model import Model

MOST_TIPS = 4
# Every file name that a report may have under `figures/`: what an earlier run left of them is out of date.
NAMES = (
    "fit",
    *(f"tip_{k + 1}" for k in range(MOST_TIPS)),
    "residual_map",
    "residual_spectra",
    "correlations",
    "shapes",
    "angles",
    "torque_errors",
    "markers",
)


def identification_pictures(fit: Identification) -> list[Picture]:
    """All figures of an identification."""
    return [
        *_fit_pictures(fit.recordings, fit.model, fit.nominal, "identified"),
        *(_residual_pictures(fit) if fit.trajectory is not None else ()),
        *_correlation_pictures(fit),
        *_data_pictures(fit),
    ]


def replay_pictures(fits: Sequence[RecordingComparison], model: Model, nominal: Model) -> list[Picture]:
    """The figures of a comparison of a model with recordings."""
    return list(_fit_pictures(fits, model, nominal, "given"))


def _fit_pictures(fits: Sequence[RecordingComparison], model: Model, nominal: Model, name: str) -> Iterator[Picture]:
    more = f" The first {MOST_RECORDINGS} recordings of {len(fits)}." if len(fits) > MOST_RECORDINGS else ""
    caption = (
        "Open-loop simulation of each whole recording: only its initial state is estimated from it. "
        f"A model that misses nothing lies on the noise mark.{more}"
    )
    yield _picture("fit", caption, fit_of_recordings(fits, name))
    chosen = tips(model.rig, fits, MOST_TIPS)
    for k, fit in enumerate(chosen):
        of = "" if k or len(chosen) == len(fits) else f" Shown for {len(chosen)} of {len(fits)} recordings."
        caption = f"Tip marker in {short(fit.recording.file)}, measured and simulated; residual underneath.{of}"
        yield _picture(f"tip_{k + 1}", caption, tip_motion(fit, model, nominal, name))


def _residual_pictures(fit: Identification) -> Iterator[Picture]:
    replayed = [each for each in fit.recordings if each.simulated is not None and each.recording.frames.size]
    if not replayed:
        return
    more = f" The first {MOST_ROWS} recordings of {len(replayed)}." if len(replayed) > MOST_ROWS else ""
    caption = (
        "What is left of each marker coordinate, RMS over the whole recording in units of the camera's noise. Pale "
        "throughout: nothing is missing; a dark column: a marker that is not where the file says, or a mode that only "
        f"it shows; a dark row: something that happens in that recording only.{more}"
    )
    yield _picture("residual_map", caption, residual_map(fit.model, replayed))
    spectra = residual_spectra(fit.model, fit.recordings)
    if spectra is not None:
        caption = (
            "Amplitude of what is left, root mean square over all marker coordinates. A peak above the dashed line at "
            "a natural frequency: its frequency or damping is off; elsewhere: something that is not in the model."
        )
        yield _picture("residual_spectra", caption, spectra)


def _correlation_pictures(fit: Identification) -> Iterator[Picture]:
    figure = correlation_map(fit.parameters, fit.covariance)
    if figure is not None:
        caption = (
            "Correlation of the estimates' errors. Near +1 or −1 the recordings determine only one combination of the "
            "two parameters, however small the noise."
        )
        yield _picture("correlations", caption, figure)


def _data_pictures(fit: Identification) -> Iterator[Picture]:
    lively = liveliest(fit.model.rig, fit.torque_data, 2)
    if lively:
        names = listed([short(data.recording.file) for data in lively])
        caption = f"Shape function, virtual links and joints at several instants of {names}; lateral scale magnified."
        yield _picture("shapes", caption, link_shapes(fit.model.rig, fit.model.chain, lively))
        caption = f"Angles read off the markers of {short(lively[0].recording.file)}, with rates and accelerations."
        yield _picture("angles", caption, joint_angles(fit.model.chain, lively[0]))
        caption = (
            "What the equation of motion leaves unexplained, joint by joint (eq. 14); an identified model that misses "
            "nothing comes down to what the noise of the accelerations explains."
        )
        yield _picture("torque_errors", caption, torque_error_figure(fit.model.chain, fit.torque_data))
    yield from _raw_pictures(fit.experiment)


def _raw_pictures(experiment: Experiment) -> Iterator[Picture]:
    shown = spread_over(experiment.recordings, most_recordings(experiment.rig))
    if shown:
        part = "" if len(shown) == len(experiment.recordings) else f" ({len(shown)} of {len(experiment.recordings)})"
        caption = f"What the camera saw in the recordings{part}, where it moves most."
        yield _picture("markers", caption, raw_markers(experiment.rig, shown))


def _picture(name: str, caption: str, figure: Figure) -> Picture:
    return Picture(name, caption, figure.texts[0].get_text().replace("\n", " ").replace(r"\$", "$"), png(figure))
