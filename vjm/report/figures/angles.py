"""Virtual joint angles with their rates and accelerations, and how much of them is noise."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from vjm.chain.records import Chain
from vjm.identification.records import TorqueData
from vjm.report.choose import liveliest_window
from vjm.report.figures.style import BAND, Row, panel_title, series, sheet, styled
from vjm.report.wording import short

Array = NDArray[np.float64]

_MOST_LINKS = 3
_MOST_JOINTS = 4
_DRAWN_POINTS = 800
_QUANTITIES = ("angle [rad]", "rate [rad/s]", "acceleration [rad/s²]")


@styled
def joint_angles(chain: Chain, data: TorqueData) -> Figure:
    """phi, phi' and phi'' of each link's virtual joints over the liveliest part of a recording, with 2-sigma bands.

    Args:
        chain: says which coordinates are virtual joints.
        data: one recording as the torque method saw it.
    """
    links = list(range(len(chain.links)))[:_MOST_LINKS]
    noise = data.derivatives.noise(np.sqrt(np.diag(data.angles.covariance)))
    title = f"Virtual joint angles of {short(data.recording.file)}: {_finding(chain, data, noise)}"
    page = sheet(title, [Row(1.5, len(links), gap=0.2)] * 3)
    start, stop = _window(chain, data)
    for column, i in enumerate(links):
        chosen = _shown(chain, i)
        for kind in range(3):
            axes = page.axes[kind][column]
            _draw(axes, data, kind, chosen, noise, (start, stop))
            axes.set_ylabel(_QUANTITIES[kind])
            axes.set_xlim(start, stop)
            axes.tick_params(labelbottom=kind == 2)
        panel_title(page.axes[0][column], f"{chain.links[i].name}: {_numbers(chain, i, chosen)}")
        page.axes[2][column].set_xlabel("time [s]")
    page.legend(_handles(chain, links))
    return page.figure


def _shown(chain: Chain, i: int) -> list[int]:
    """Coordinates of link i's joints that are drawn: all of a few, else some from base to tip."""
    part = chain.passive_slices[i]
    joints = np.arange(part.start, part.stop)
    picked = np.unique(np.linspace(0, joints.size - 1, min(_MOST_JOINTS, joints.size)).round().astype(int))
    chosen: list[int] = joints[picked].tolist()
    return chosen


def _numbers(chain: Chain, i: int, chosen: list[int]) -> str:
    count = chain.links[i].virtual_joints
    first = chain.passive_slices[i].start
    if count == len(chosen):
        return "the virtual joint" if count == 1 else f"all {count} virtual joints"
    return f"virtual joints {', '.join(str(c - first + 1) for c in chosen)} of {count}"


def _finding(chain: Chain, data: TorqueData, noise: Array) -> str:
    """How far each derivative stands above its noise, at the joint where it is clearest."""
    signals = (data.derivatives.value, data.derivatives.rate, data.derivatives.acceleration)
    ratios = []
    for kind, values in enumerate(signals):
        spread = np.std(values[data.derivatives.interior][:, chain.passive], axis=0)
        ratios.append(float(np.max(spread / np.maximum(noise[kind][chain.passive], 1e-300))))
    shown = [f"{ratio:.0f}" if ratio >= 2 else f"{ratio:.1f}" for ratio in ratios]
    return f"angle, rate and acceleration stand {shown[0]}, {shown[1]} and {shown[2]} times above their noise"


def _window(chain: Chain, data: TorqueData) -> tuple[float, float]:
    inside = data.derivatives.interior  # the bands hold there
    values = data.derivatives.value[inside][:, chain.passive]
    loudest = int(np.argmax(np.std(values, axis=0)))
    return liveliest_window(data.derivatives.time[inside], values[:, loudest])


def _draw(
    axes: Axes, data: TorqueData, kind: int, chosen: list[int], noise: Array, window: tuple[float, float]
) -> None:
    time = np.linspace(*window, _DRAWN_POINTS)
    drawn = _between_frames(data, kind)(time)
    for coordinate, (color, style) in zip(chosen, series(len(chosen)), strict=True):
        values, sigma = drawn[:, coordinate], noise[kind, coordinate]
        axes.fill_between(time, values - 2 * sigma, values + 2 * sigma, color=BAND, linewidth=0)
        axes.plot(time, values, color=color, linestyle=style, linewidth=1.2)
        if kind == 0:
            frames = (data.angles.time >= window[0]) & (data.angles.time <= window[1])
            axes.plot(
                data.angles.time[frames],
                data.angles.q[frames, coordinate],
                color=color,
                linestyle="",
                marker=".",
                markersize=4,
            )


def _between_frames(data: TorqueData, kind: int) -> CubicHermiteSpline:
    """The signal as a smooth line: a camera may take no more than four frames a period."""
    d = data.derivatives
    if kind == 2:
        return CubicSpline(d.time, d.acceleration)
    return CubicHermiteSpline(d.time, *((d.value, d.rate) if kind == 0 else (d.rate, d.acceleration)))


def _handles(chain: Chain, links: list[int]) -> list[Line2D | Patch]:
    numbers = [[str(c - chain.passive_slices[i].start + 1) for c in _shown(chain, i)] for i in links]
    most = max(numbers, key=len)
    if any(each != most[: len(each)] for each in numbers):  # the links number their joints differently
        most = ["innermost", *(["between"] * (len(most) - 2)), "outermost"]
    lines = [
        Line2D([], [], color=color, linestyle=style, label=f"joint {name}" if name.isdigit() else name)
        for name, (color, style) in zip(most, series(len(most)), strict=True)
    ]
    dots = Line2D([], [], color="black", linestyle="", marker=".", markersize=4, label="read off a frame")
    return [*lines, dots, Patch(color=BAND, label="±2σ noise")]
