"""An experiment file proposed from the recordings that it shall describe."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from vjm.errors import RecordingError, printable
from vjm.experiment.checks import moves
from vjm.experiment.conventions import FACTORS, Array
from vjm.experiment.load import UNKNOWN, described, parse_document, read_numbers, read_tables

# A steel ruler: with the width, thickness or modulus of any other arm, its own give a bending stiffness in bounds.
_RULER = {
    **{"length": 1.0, "mass": 0.2, "bending_stiffness": 2.0},
    **{"width": 0.03, "thickness": 1e-3, "youngs_modulus": 2e11},
}

_STANDARD = re.compile(r"(?P<link>[A-Za-z0-9_]+)\.(?:theta|tau|m(?P<number>[1-9][0-9]*)\.(?P<axis>[xyz]))")
_COORDINATE = re.compile(r"(?P<marker>.*?)[\s._:-]*(?P<axis>[xyzXYZ])(?P<unit>\W.*)?")
_DRIVE = ("theta", "tau")
_WORDS = {
    "t": re.compile(r"t|time.*|timestamp.*|seconds", re.IGNORECASE),
    "theta": re.compile(r".*(theta|angle|encoder).*", re.IGNORECASE),
    "tau": re.compile(r".*(tau|torque).*", re.IGNORECASE),
}
_UNITS = {  # as they are written in headers
    "length": {"mm": "mm", "cm": "cm", "in": "in", "inch": "in"},
    "angle": {"deg": "deg", "degrees": "deg", "°": "deg"},
    "time": {"ms": "ms", "us": "us", "µs": "us"},
    "torque": {"Nmm": "N mm", "N mm": "N mm", "N*mm": "N mm", "mNm": "N mm"},
}


@dataclass(frozen=True)
class _CsvFile:
    """Numbers of a CSV file, and what its columns seem to be.

    Attributes:
        path: the file.
        header: names of its columns.
        values: (T,) numbers by name of column; NaN for a cell that holds none.
        names: the documentation's names of columns by the file's.
    """

    path: Path
    header: tuple[str, ...]
    values: Mapping[str, Array]
    names: Mapping[str, str]

    def column(self, name: str) -> Array | None:
        """Return the numbers (T,) of a column by its documentation's name; None where there is none."""
        header_name = next((header for header, standard in self.names.items() if standard == name), None)
        return None if header_name is None else self.values[header_name]

    def ending(self, *endings: str) -> dict[str, Array]:
        """Return the numbers (T,) of columns with one of these endings, by their documentation's names."""
        return {name: self.values[header] for header, name in self.names.items() if name.endswith(endings)}

    @property
    def has_markers(self) -> bool:
        """True if there is a column of a marker's coordinate."""
        return any(".m" in name for name in self.names.values())


@dataclass(frozen=True)
class _ProposedRecording:
    """A table [[recording]], and why it says what it says."""

    file: str
    motors_file: str | None
    kind: str
    role: str
    reason: str


@dataclass(frozen=True)
class ExperimentProposal:
    """An experiment file before it is written.

    Attributes:
        folder: that it is written into.
        files: the CSV files with markers, each with that of its motors or None.
        given: values of the rig's keys, as far as they are known; others are to be filled in.
        chosen: units that are known, by quantity; others are guessed.
    """

    folder: Path
    files: tuple[tuple[_CsvFile, _CsvFile | None], ...]
    given: dict[str, Any] = field(default_factory=dict)
    chosen: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The experiment's: that of its folder, if that will do."""
        name = self.folder.resolve().name
        return name if name and printable(name) == name else "experiment"

    @cached_property
    def links(self) -> dict[str, int]:
        """Number of markers by link, from the base outwards."""
        counts: dict[str, int] = {}
        for name in (name for file, _ in self.files for name in file.names.values()):
            match = _STANDARD.fullmatch(name)
            if match:
                counts[match["link"]] = max(counts.get(match["link"], 0), int(match["number"] or 0))
        return {link: count for link, count in counts.items() if count} or {"beam": 0}

    def joint(self, link: str) -> tuple[str, str]:
        """Return the joint at the link's proximal end, and why it is thought to be so."""
        if "joint" in self.given and link == next(iter(self.links)):
            return self.given["joint"], "as given"
        driven = any(file.column(f"{link}.{quantity}") is not None for file in self._all_files for quantity in _DRIVE)
        return (
            ("revolute", "guessed: there is an angle or a torque")
            if driven
            else ("clamped", "guessed: there is no angle and no torque")
        )

    @cached_property
    def _surplus(self) -> set[str]:
        """Angles and torques of joints that are clamped, by their documentation's names."""
        clamped = (link for link in self.links if self.joint(link)[0] == "clamped")
        return {f"{link}.{quantity}" for link in clamped for quantity in _DRIVE}

    @cached_property
    def units(self) -> dict[str, tuple[str, str]]:
        """Unit of each quantity, and why it is thought to be so."""
        return {
            quantity: (self.chosen[quantity], "as chosen") if quantity in self.chosen else self._guess(quantity)
            for quantity in FACTORS
        }

    def _guess(self, quantity: str) -> tuple[str, str]:
        """Return the unit that a header names, else the one in which the numbers are of a usual size."""
        endings = {"length": (".x", ".y", ".z"), "angle": (".theta",), "torque": (".tau",), "time": ("t",)}[quantity]
        for header_name, standard in (pair for file in self._all_files for pair in file.names.items()):
            words = re.split(r"[\[\](),_]+", header_name)
            unit = next((unit for word, unit in _UNITS[quantity].items() if word in map(str.strip, words[1:])), None)
            if unit and standard.endswith(endings):
                return unit, f"the column {header_name!r} says so"
        if quantity == "time":
            return self._guess_time()
        largest = _largest_value(column for file in self._all_files for column in file.ending(*endings).values())
        usual = {"length": 0.5, "angle": np.pi, "torque": 1.0}[quantity]  # m, rad, N m: arms that stand on a table
        choices: tuple[str, ...] = {"length": ("m", "mm"), "angle": ("rad", "deg"), "torque": ("N m", "N mm")}[quantity]
        if largest is None:
            return choices[0], "none was measured"
        if quantity == "length" and isinstance(self.given.get("length"), float):
            usual, choices = self.given["length"], ("m", "mm", "cm", "in")
        if largest == 0.0 or (quantity == "angle" and largest <= 2 * np.pi):
            return choices[0], f"guessed: numbers reach {largest:.4g}"
        unit = min(choices, key=lambda unit: abs(np.log(largest * FACTORS[quantity][unit] / usual)))
        return unit, f"guessed: numbers reach {largest:.4g}"

    def _guess_time(self) -> tuple[str, str]:
        steps = [float(np.median(np.diff(time))) for file, _ in self.files if (time := file.column("t")) is not None]
        step = steps[0] if steps and steps[0] > 0 else 0.01
        unit = min(FACTORS["time"], key=lambda unit: abs(np.log(step * FACTORS["time"][unit] / 0.01)))
        return unit, f"guessed: rows follow every {step:.4g}"

    @property
    def _all_files(self) -> Iterator[_CsvFile]:
        return (file for pair in self.files for file in pair if file is not None)

    @cached_property
    def axes(self) -> tuple[str, str]:
        """Letters of the columns that span the plane of motion: all but the one in which least happens."""
        letters = sorted({name[-1] for file, _ in self.files for name in file.ending(".x", ".y", ".z")})
        if len(letters) < 3:
            return (letters[0], letters[1]) if len(letters) == 2 else ("x", "y")
        spans = {}
        for letter in letters:
            columns = [column for file, _ in self.files for column in file.ending(f".{letter}").values()]
            values = np.concatenate(columns)
            spans[letter] = float(np.nanmax(values) - np.nanmin(values))
        first, second = sorted(sorted(letters, key=lambda letter: spans[letter])[1:])
        return first, second

    @cached_property
    def columns(self) -> dict[str, str]:
        """The files' names of columns by the documentation's, where they differ or some are not used."""
        pairs = [(file.names.get(header_name), header_name) for file in self._all_files for header_name in file.header]
        names = {name: header_name for name, header_name in pairs if name and name not in {header_name, *self._surplus}}
        surplus = any(name is None or name in self._surplus for name, _ in pairs)
        unused = any(name[-1] not in self.axes for file, _ in self.files for name in file.ending(".x", ".y", ".z"))
        names |= dict.fromkeys(self._unrecognized, UNKNOWN)
        return names or ({"t": "t"} if surplus or (unused and self.axes == ("x", "y")) else {})

    @cached_property
    def _unrecognized(self) -> list[str]:
        """Columns that a recording needs and that none of its names looks like, though some look like nothing else."""
        angles = [f"{link}.theta" for link in self.links if self.joint(link)[0] == "revolute"]
        found = []
        for sources in ([source for source in pair if source is not None] for pair in self.files):
            if any(header_name not in source.names for source in sources for header_name in source.header):
                found += ["t"] if any(source.column("t") is None for source in sources) else []
                found += [name for name in angles if all(source.column(name) is None for source in sources)]
        return found

    def arcs(self, link: str) -> tuple[float, ...] | None:
        """Return the median distances of a first link's markers from the camera's origin [m]; None if no arc lengths.

        They are if the camera's origin is the base's and the link bends little; beyond the link's length they are not.
        """
        factor, distances = FACTORS["length"][self.units["length"][0]], []
        for k in range(1, self.links[link] + 1):
            pairs = [[file.column(f"{link}.m{k}.{axis}") for axis in self.axes] for file, _ in self.files]
            radii = [np.hypot(x, y) for x, y in pairs if x is not None and y is not None]
            distances.append(factor * float(np.nanmedian(np.concatenate(radii))) if radii else 0.0)
        length = self.given.get("length", np.inf)
        arcs = tuple(float(f"{distance:.3g}") for distance in distances)
        # the outermost marker is often at the very end
        arcs = tuple(min(arc, length) if arc < 1.05 * length else arc for arc in arcs)
        fits = np.all(np.diff([0.0, *arcs]) > 0) and arcs[-1] <= length
        return arcs if next(iter(self.links)) == link and fits else None

    @cached_property
    def recordings(self) -> tuple[_ProposedRecording, ...]:
        """The recordings: what moved them, and the last moving one held out."""
        kinds = [self._kind(file, motors) for file, motors in self.files]
        moving = [k for k, (kind, _) in enumerate(kinds) if kind in ("driven", "decay")]
        held_out = moving[-1] if len(moving) > 1 else None
        proposed = []
        for k, ((file, motors), (kind, reason)) in enumerate(zip(self.files, kinds, strict=True)):
            names = [_relative(source.path, self.folder) for source in (file, motors) if source is not None]
            role = "holdout" if k == held_out else "train"
            proposed.append(_ProposedRecording(names[0], names[1] if motors else None, kind, role, reason))
        return tuple(proposed)

    def _kind(self, file: _CsvFile, motors: _CsvFile | None) -> tuple[str, str]:
        torques = [source.ending(".tau") for source in (file, motors) if source is not None]
        largest = _largest_value(
            column for columns in torques for name, column in columns.items() if name not in self._surplus
        )
        if largest:
            return "driven", f"guessed: the torque reaches {largest:.4g} {self.units['torque'][0]}"
        factor = FACTORS["length"][self.units["length"][0]]
        if not any(moves(factor * column, None) for column in file.ending(".x", ".y", ".z").values()):
            return "quiet", "guessed: nothing moves beyond the noise"
        return "decay", "guessed: it moves without a torque"

    @property
    def missing(self) -> list[str]:
        """Keys that have to be filled in by hand."""
        lines = [line.partition("#")[0].partition("=") for line in self.text().splitlines()]
        return [key.strip(' "') for key, _, value in lines if f'"{UNKNOWN}"' in value]

    def text(self) -> str:
        """Return the experiment file."""
        environment = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        environment.filters["toml"] = lambda value: printable(json.dumps(value, ensure_ascii=False))
        template = resources.files("vjm.experiment").joinpath("experiment.toml.jinja").read_text(encoding="utf-8")
        return environment.from_string(template).render(proposal=self, given=self.given, unknown=UNKNOWN)

    def check(self, file: Path) -> None:
        """Refuse what the experiment file would be refused for, but for what has to be filled in.

        Of the recordings columns and cells are looked at, if all columns are recognized, not whether their numbers make
        sense.

        Raises:
            ExperimentError, RecordingError: as `load_experiment` does.
        """
        document = parse_document(file, self.text().encode())
        document["link"] = [_filled_in(link) for link in document["link"]]
        columns = document.get("columns", {}).items()
        document["columns"] = {name: header_name for name, header_name in columns if header_name != UNKNOWN}
        rig, conventions, files = described(file, document)
        if not self._unrecognized:
            for sources, table in zip(files, document["recording"], strict=True):
                read_tables(sources, table, rig, conventions, {})


def _relative(path: Path, folder: Path) -> str:
    """Return a file's path from a folder, either of which may be reached by symbolic links."""
    return Path(os.path.relpath(path.parent.resolve() / path.name, folder.resolve())).as_posix()


def _filled_in(link: Mapping[str, Any]) -> dict[str, Any]:
    """Return a link's table with numbers that contradict no other in place of those that have to be filled in."""
    table: dict[str, Any] = {key: _RULER[key] if value == UNKNOWN else value for key, value in link.items()}
    count = len(table["markers"])
    if UNKNOWN in table["markers"]:
        table["markers"] = [table["length"] * k / count for k in range(1, count + 1)]
    elif link["length"] == UNKNOWN:
        table["length"] = table["markers"][-1]
    return table


def _largest_value(columns: Iterable[Array]) -> float | None:
    """Return the largest absolute number of some columns (T,); None where there are none."""
    return max((float(np.nanmax(np.abs(column))) for column in columns), default=None)


def _read_csv(path: Path) -> _CsvFile:
    """Read a CSV file of numbers with a header, and guess what its columns are.

    Raises:
        RecordingError: it cannot be read, or holds no numbers.
    """
    header, numbers = read_numbers(path)
    values = {name: column for name, column in zip(header, numbers.T, strict=True) if np.isfinite(column).any()}
    if not values:
        raise RecordingError(path, None, None, "there is no column of numbers", "a header line, then rows of numbers")
    return _CsvFile(path, header, values, _recognized(values))


def _recognized(values: Mapping[str, Array]) -> dict[str, str]:
    """Return the documentation's names of the columns that are recognized, by the file's own."""
    if any(_STANDARD.fullmatch(name) for name in values):
        names = {name: name for name in values if _STANDARD.fullmatch(name) or name == "t"}
    else:
        names = _recognized_markers([name for name in values if not _matches(name, "t", "theta", "tau")])
    for quantity in ("t", "theta", "tau"):
        standard = "t" if quantity == "t" else f"beam.{quantity}"
        header_name = next((name for name in values if name not in names and _matches(name, quantity)), None)
        if header_name is not None and not any(
            present == "t" or present.endswith(quantity) for present in names.values() if present == standard
        ):
            names[header_name] = standard
    return names


def _matches(name: str, *quantities: str) -> bool:
    return any(_WORDS[quantity].fullmatch(name) for quantity in quantities)


def _recognized_markers(columns: Sequence[str]) -> dict[str, str]:
    """Return names of markers' coordinates, numbered in the order in which the file has them."""
    groups: dict[str, dict[str, str]] = {}
    for name in columns:
        match = _COORDINATE.fullmatch(name)
        if match:
            groups.setdefault(match["marker"], {})[match["axis"].lower()] = name
    complete = [axes for axes in groups.values() if len(axes) >= 2]
    return {name: f"beam.m{k}.{axis}" for k, axes in enumerate(complete, start=1) for axis, name in axes.items()}


def propose(folder: Path, paths: Sequence[Path]) -> ExperimentProposal:
    """Propose an experiment file for some CSV files.

    Args:
        folder: that it is written into.
        paths: of the CSV files. One without markers holds the angles and torques of the file whose name its own name
            begins with.

    Raises:
        RecordingError: a file cannot be read, has no markers, or belongs to none that has.
    """
    for path in paths:
        if re.search("[\ud800-\udfff]", str(path)):
            raise RecordingError(path, None, None, "its name is not UTF-8", "a name that an experiment file can hold")
    files = [_read_csv(path) for path in paths]
    markers = [file for file in files if file.has_markers]
    motors: dict[Path, _CsvFile] = {}
    for file in files:
        if file.has_markers:
            continue
        stems = [candidate for candidate in markers if file.path.stem.startswith(candidate.path.stem)]
        if not stems or not file.names:
            expected = (
                "names such as beam.m1.x and beam.m1.y, or Marker1_X and Marker1_Y; for others write [columns] by hand"
            )
            raise RecordingError(file.path, 1, None, "no column looks like a marker's coordinate", expected)
        motors[max(stems, key=lambda candidate: len(candidate.path.stem)).path] = file
    return ExperimentProposal(folder, tuple((file, motors.get(file.path)) for file in markers))
