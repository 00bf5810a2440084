"""Write recordings as CSV and the rig as experiment.toml, in the documented format."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam.beam import Body
from tests.fine_beam.sensors import Frames

Array = NDArray[np.float64]
Value: TypeAlias = str | int | float | Sequence[float]

_TICK = 1e-9  # s; samples of two sensors closer than this share a row


@dataclass(frozen=True)
class RecordingEntry:
    """One [[recording]] table; what is None is left out."""

    file: str
    kind: str
    role: str
    repeat: str | None = None
    condition: str | None = None
    payload: float | None = None
    gravity: tuple[float, float] | None = None
    payload_offset: float | None = None
    payload_inertia: float | None = None

    @property
    def body(self) -> Body:
        """What is on the tip."""
        return Body(self.payload or 0.0, self.payload_offset or 0.0, self.payload_inertia or 0.0)


@dataclass(frozen=True)
class LinkRecord:
    """What one recording holds of one link.

    Attributes:
        link: the link's name, the columns' prefix.
        frames: time (f,) in s and markers (f, k, 2) in m.
        encoder: time (e,) in s and joint angle (e,) in rad; column left out when None.
        torque: time (e,) in s and hub torque (e,) in N m; column left out when None.
    """

    link: str
    frames: Frames
    encoder: tuple[Array, Array] | None = None
    torque: tuple[Array, Array] | None = None


def write_recording(
    path: Path,
    link: str,
    frames: Frames,
    encoder: tuple[Array, Array] | None = None,
    torque: tuple[Array, Array] | None = None,
    decimals: int = 6,
) -> None:
    """Write one CSV of an arm of one link; see `LinkRecord` and `write_arm_recording`."""
    write_arm_recording(path, [LinkRecord(link, frames, encoder, torque)], decimals)


def write_arm_recording(path: Path, records: Sequence[LinkRecord], decimals: int = 6) -> None:
    """Write one CSV.

    Args:
        path: the file.
        records: of the links from the base outwards.
        decimals: digits after the point of a marker coordinate, in m.
    """
    columns = [column for record in records for column in _link_columns(record, decimals)]
    ticks = np.unique(np.round(np.concatenate([time for _, (time, _), _ in columns]) / _TICK).astype(np.int64))
    cells = [[_number(tick * _TICK, ".9g") for tick in ticks]]
    cells += [_column(ticks, *series, form) for _, series, form in columns]
    header = ",".join(["t", *(name for name, _, _ in columns)])
    rows = [header, *(",".join(row) for row in zip(*cells, strict=True))]
    _write_text(path, "\n".join(rows) + "\n")


def _link_columns(record: LinkRecord, decimals: int) -> list[tuple[str, tuple[Array, Array], str]]:
    """Name, time (n,) and values (n,), and number format of a link's columns."""
    link, frames = record.link, record.frames
    sensors = [(f"{link}.theta", record.encoder, ".7f"), (f"{link}.tau", record.torque, ".12g")]
    columns = [(name, series, form) for name, series, form in sensors if series is not None]
    axes = [f"{link}.m{marker + 1}.{axis}" for marker in range(frames.markers.shape[1]) for axis in "xy"]
    coordinates = frames.markers.reshape(len(frames.time), -1).T
    markers = zip(axes, coordinates, strict=True)
    return columns + [(name, (frames.time, values), f".{decimals}f") for name, values in markers]


def _column(ticks: NDArray[np.int64], time: Array, values: Array, form: str) -> list[str]:
    """Cells of one column, empty at the instants when nothing was measured."""
    cells = [""] * len(ticks)
    for row, value in zip(np.searchsorted(ticks, np.round(time / _TICK)), values, strict=True):
        cells[row] = "" if np.isnan(value) else _number(value, form)
    return cells


def _number(value: float, form: str) -> str:
    """A formatted number; never a negative zero."""
    text = format(value, form)
    return text.removeprefix("-") if float(text) == 0.0 else text


def write_experiment(
    path: Path,
    name: str,
    link: Mapping[str, Value] | Sequence[Mapping[str, Value]],
    sensors: Mapping[str, Value],
    recordings: Sequence[RecordingEntry],
    gravity: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Write experiment.toml: `link` and `sensors` hold the keys of their tables, in the order they are to appear.

    Several links come as a list, from the base outwards.
    """
    links = [link] if isinstance(link, Mapping) else link
    tables: list[tuple[str, Mapping[str, Value]]] = [("[base]", {"gravity": list(gravity)})]
    tables += [("[[link]]", table) for table in links]
    if sensors:
        tables.append(("[sensors]", sensors))
    for entry in recordings:
        tables.append(("[[recording]]", {key: value for key, value in asdict(entry).items() if value is not None}))
    blocks = [_pairs({"schema": 1, "name": name}), *(f"{heading}\n{_pairs(table)}" for heading, table in tables)]
    _write_text(path, "\n".join(blocks))


def _pairs(table: Mapping[str, Value]) -> str:
    """`key = value` lines."""
    return "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())


def _toml(value: Value) -> str:
    """A TOML literal."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        text = format(value, ".12e" if abs(value) >= 1e9 else ".12g")
        if "e" in text:
            mantissa, exponent = text.split("e")
            return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"
        return text if "." in text else text + ".0"
    return "[" + ", ".join(_toml(float(item)) for item in value) + "]"


def _write_text(path: Path, text: str) -> None:
    """Write the same bytes on every system."""
    path.write_bytes(text.encode("utf-8"))
