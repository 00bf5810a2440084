"""Torque errors (eq. 14) of the nominal and of the identified model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.identification.records import TorqueData
from vjm.modes import linearise
from vjm.report.choose import liveliest_window
from vjm.report.figures.style import (
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    NOMINAL_STYLE,
    Row,
    log_ticks,
    panel_title,
    printable,
    sheet,
    styled,
)
from vjm.report.wording import number, short

Array = NDArray[np.float64]

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
