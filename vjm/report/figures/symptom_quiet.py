"""What the sensors show while nothing moves."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vjm.report.figures.style import IDENTIFIED, MEASURED, NOMINAL, Row, log_ticks, panel_title, styled
from vjm.report.figures.symptom_motion import titled
from vjm.report.wording import number, short
from vjm.symptoms import Symptoms
from vjm.symptoms.tones import Quiet, Spectrum

_MOST_PANELS = 4
_DASHES = (0, (4, 2))
_KINDS = ("tone", "quiet_size", "quiet_colour")


def shown(found: Symptoms) -> list[tuple[Quiet, Spectrum]]:
    """Sensors at rest whose spectrum can be drawn, at most four."""
    pairs = [(quiet, quiet.spectrum) for each in found.recordings for quiet in each.quiet]
    return [(quiet, spectrum) for quiet, spectrum in pairs if spectrum is not None][:_MOST_PANELS]


@styled
def quiet(found: Symptoms) -> Figure:
    """Amplitude spectra of the sensors at rest, beside the noise that was supposed.

    Args:
        found: with at least one quiet recording.
    """
    panels = shown(found)
    files = {found.recordings[each.recording].followed.recording.file for each, _ in panels}
    largest = next((s for s in found.significant if s.kind in _KINDS and s.recording in files), None)
    nothing = "At rest, the sensors show white noise of the size that was supposed"
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    title = nothing if largest is None else largest.sentence.removesuffix(".")
    page = titled(title, [Row(1.9, columns, gap=0.8) for _ in range(rows)])
    every = [axes for row in page.axes for axes in row]
    for unused in every[len(panels) :]:
        unused.remove()
    for axes, (each, spectrum) in zip(every, panels, strict=False):
        _draw(axes, each, spectrum)
        file = found.recordings[each.recording].followed.recording.file
        panel_title(axes, f"{short(file, 18)}, {each.channels.sensor}: {_words(each)}")
    page.legend(
        [
            Line2D([], [], color=IDENTIFIED, label="residual at rest"),
            Line2D([], [], color=MEASURED, linewidth=1.6, label="white noise as supposed"),
            Line2D([], [], color=MEASURED, linestyle=_DASHES, label="its limit (99.9 %)"),
            Line2D([], [], linestyle="", marker="v", color=NOMINAL, label="a tone"),
        ]
    )
    return page.figure


def _words(each: Quiet) -> str:
    size = f"{number(1 + each.size.value, 3)} times the noise"
    return size if each.tone is None else f"{size}, tone at {number(each.tone.frequency.value, 3)} Hz"


def _draw(axes: Axes, each: Quiet, spectrum: Spectrum) -> None:
    scale, unit = (1e6, "µm") if each.channels.unit == "m" else (1e6, "µrad")
    axes.plot(spectrum.frequency, scale * spectrum.amplitude, color=IDENTIFIED, linewidth=0.8)
    axes.axhline(scale * spectrum.white, color=MEASURED, linewidth=1.6)
    axes.axhline(scale * spectrum.limit, color=MEASURED, linestyle=_DASHES, linewidth=1.1)
    if each.tone is not None:
        at = int(np.argmin(np.abs(spectrum.frequency - each.tone.frequency.value)))
        height = 1.25 * scale * float(spectrum.amplitude[at])
        axes.plot([each.tone.frequency.value], [height], marker="v", color=NOMINAL)
    axes.set_yscale("log")
    low = 0.8 * float(np.quantile(spectrum.amplitude, 0.02))
    axes.set_ylim(scale * low, 1.6 * scale * max(spectrum.limit, float(spectrum.amplitude.max())))
    axes.set_xlim(0.0, float(spectrum.frequency[-1]))
    log_ticks(axes.yaxis)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"amplitude [{unit}]")
