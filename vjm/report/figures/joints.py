"""Torque errors (eq. 14) of the nominal and of the identified model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from vjm.chain.virtual_links import Chain
from vjm.identification.records import TorqueData
from vjm.model.modes import linearise
from vjm.records import Array
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    NOMINAL_STYLE,
    Row,
    log_ticks,
    panel_title,
    printable,
    series,
    sheet,
    styled,
)
from vjm.report.figures.windows import liveliest_window
from vjm.report.text import number, short

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


_MOST_NAMES = 10  # joints whose names fit beside each other


@styled
def torque_error_figure(chain: Chain, data: Sequence[TorqueData]) -> Figure:
    """Torque errors before and after: over time at the joint where they were largest, and each joint's RMS.

    Args:
        chain: the identified chain; names the joints, and says how much torque error the noise makes.
        data: the training recordings, at least one.
    """
    worst, joint = _worst(data)
    before = _rms([each.errors_before[each.derivatives.interior] for each in data])
    after = _rms([each.errors_after[each.derivatives.interior] for each in data])
    noise = _noise_rms(chain, data)
    total = [float(np.sqrt(np.nansum(values**2))) for values in (before, after, noise)]
    title = (
        f"Torque errors of the training recordings: nominal model {_torque(total[0])}, "
        f"identified {_torque(total[1])}, noise alone would give {_torque(total[2])} (RMS, all joints)"
    )
    single = chain.size == 1
    page = sheet(title, [Row(1.9)] if single else [Row(1.9), Row(1.7, gap=0.85)], bottom=0.52 if single else 0.75)
    _draw_trace(page.axes[0][0], chain, worst, joint)
    handles = [
        Line2D([], [], color=NOMINAL, linestyle=NOMINAL_STYLE, marker="s", markerfacecolor="white", label="nominal"),
        Line2D([], [], color=IDENTIFIED, marker="o", label="identified"),
        Line2D([], [], color=MEASURED, linestyle="", marker="_", markersize=12, label="expected from noise"),
    ]
    if not single:
        _draw_joints(page.axes[1][0], chain, before, after, noise)
    page.legend(handles[:2] if single else handles)
    return page.figure


def _torque(value: float) -> str:
    return f"{number(1e3 * value, 2)}\N{NO-BREAK SPACE}mN\N{NO-BREAK SPACE}m"


def _worst(data: Sequence[TorqueData]) -> tuple[TorqueData, int]:
    """Recording and coordinate with the largest error of the nominal model."""
    largest = [np.nan_to_num(_rms([each.errors_before[each.derivatives.interior]])) for each in data]
    at = int(np.argmax([values.max() for values in largest]))
    return data[at], int(np.argmax(largest[at]))


def _rms(errors: Sequence[Array]) -> Array:
    """(nv,) root mean square over all samples; NaN where none was measured."""
    stacked = np.concatenate(errors)
    known = np.isfinite(stacked)
    squares = np.where(known, stacked, 0.0) ** 2
    counts = known.sum(axis=0)
    return np.where(counts > 0, np.sqrt(squares.sum(axis=0) / np.maximum(counts, 1)), np.nan)


def _noise_rms(chain: Chain, data: Sequence[TorqueData]) -> Array:
    """(nv,) torque errors that the noise of angles, rates and accelerations makes, the arm near rest."""
    squares, samples = np.zeros(chain.size), 0
    for each in data:
        M, D, K, _ = linearise(chain, each.recording.payload, each.recording.gravity)
        gains, terms = each.derivatives.gains, (K, D, M)
        covariance = sum(
            gains[i, j] * terms[i] @ each.angles.covariance @ terms[j].T for i in range(3) for j in range(3)
        )
        count = each.derivatives.time.size
        squares += count * np.diag(np.asarray(covariance))
        samples += count
    return np.sqrt(np.maximum(squares, 0.0) / max(samples, 1))


def _draw_trace(axes: Axes, chain: Chain, data: TorqueData, joint: int) -> None:
    before, after = 1e3 * data.errors_before[:, joint], 1e3 * data.errors_after[:, joint]
    time = data.derivatives.time
    start, stop = liveliest_window(time, np.nan_to_num(data.derivatives.value[:, joint]))
    rows = (time >= start) & (time <= stop) & data.derivatives.interior
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    axes.plot(time[rows], before[rows], color=NOMINAL, linestyle=NOMINAL_STYLE)
    axes.plot(time[rows], after[rows], color=IDENTIFIED)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("error [mN m]")
    panel_title(axes, f"{chain.joint_names[joint]}, where the nominal model errs most, in {short(data.recording.file)}")


def _draw_joints(axes: Axes, chain: Chain, before: Array, after: Array, noise: Array) -> None:
    places = np.arange(chain.size)
    axes.plot(places, 1e3 * noise, linestyle="", marker="_", markersize=26, markeredgewidth=2, color=MEASURED)
    axes.plot(
        places - 0.06, 1e3 * before, linestyle="", marker="s", color=NOMINAL, markerfacecolor="white", markersize=6
    )
    axes.plot(places + 0.06, 1e3 * after, linestyle="", marker="o", color=IDENTIFIED, markersize=6)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.2, high * 1.2)
    log_ticks(axes.yaxis)
    axes.set_xticks(places, [str(k + 1) for k in places] if chain.size > _MOST_NAMES else _joint_labels(chain))
    axes.set_xlim(-0.6, chain.size - 0.4)
    axes.grid(False, axis="x")
    axes.set_xlabel("joint, from the base outwards")
    axes.set_ylabel("RMS error [mN m]")
    panel_title(axes, "Every joint, over all training recordings")


def _joint_labels(chain: Chain) -> list[str]:
    labels = []
    for link in chain.links:
        own = ["active"] if link.joint == "revolute" else []
        own += [f"virtual {j}" for j in range(1, link.virtual_joints + 1)]
        labels += [f"{name}\n{printable(short(link.name, 12))}" for name in own]
    return labels
