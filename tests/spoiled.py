"""Experiments and models as people, programs and disks spoil them, and the law that every command keeps all the same.

`cases` draws a small experiment that is spoiled in one to three ways, and a command for it; `run` runs the command in
this process and says in what it broke the law: it answers (status 0) or refuses in words that name a file (status 2, or
1 where a simulation diverges), never ends in an internal error, sends the terminal nothing but printable text, writes
nothing unless it answers, and allocates no more than such an experiment needs.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import math
import os
import resource
import signal
import sys
import threading
import unicodedata
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.simulation.integrators import simulate
from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.cli import main
from vjm.effects import BUILTIN
from vjm.records import Link, Recording, Rig
from vjm.report.model_json import model_text
from vjm.simulation.model import Model

Array = NDArray[np.float64]
Draw = st.DrawFn

SECONDS = 120.0  # after which a command counts as one that hangs; most take well below one
MEMORY = 2**30  # bytes that a command may allocate beside what is there
EXPERIMENT, MODEL, OUT = "experiment.toml", "model.json", "out"


@dataclass
class Table:
    """A recording as a CSV file has it; NaN is an empty cell, `junk` the text of others by row and column."""

    columns: list[str]
    values: Array
    junk: dict[tuple[int, int], str] = field(default_factory=dict)

    def text(self) -> str:
        cells = [["" if math.isnan(x) else repr(float(x)) for x in row] for row in self.values]
        for (row, column), text in self.junk.items():
            cells[row % len(cells)][column % len(self.columns)] = text
        return "".join(",".join(line) + "\n" for line in [self.columns, *cells])

    def column(self, *names: str) -> Array:
        """The numbers of a column by one of its names; of the first one where it is not there."""
        return self.values[:, next((k for k, name in enumerate(self.columns) if name in names), 0)]


@dataclass(repr=False)
class Case:
    """A folder of files, and a command.

    Attributes:
        folder: the folder's name.
        toml: lines of the experiment file.
        tables: recordings by the names of their files.
        model: content of model.json.
        contents: bytes that are in some of these files instead.
        places: what stands there instead of some files, a key of `PLACES`.
        command: its name and arguments, in which `{EXPERIMENT}`, `{MODEL}`, `{FOLDER}` and `{OUT}` stand for paths.
    """

    folder: str
    toml: list[str]
    tables: dict[str, Table]
    model: Any
    contents: dict[str, bytes] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)
    command: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"Case({self.command!r} in {self.folder!r} of {', '.join(f'{k}: {v!r}' for k, v in self.files.items())})"

    @property
    def files(self) -> dict[str, bytes | str]:
        """By name, the content of each file or what stands in its place."""
        texts = {EXPERIMENT: "".join(f"{line}\n" for line in self.toml), MODEL: json.dumps(self.model)}
        texts |= {name: table.text() for name, table in self.tables.items()}
        written = {name: text.encode("utf-8", "surrogateescape") for name, text in texts.items()}
        return {**written, **self.contents, **self.places}

    def write(self, parent: Path) -> Path:
        """Write the folder, and return it."""
        folder = parent / self.folder
        try:
            folder.mkdir()
        except OSError:  # a name that only some systems allow
            folder = parent / "rig"
            folder.mkdir()
        for name, content in self.files.items():
            with contextlib.suppress(OSError, ValueError):  # a name that no file can have
                if isinstance(content, bytes):
                    (folder / name).write_bytes(content)
                else:
                    PLACES[content](folder / name)
        return folder


def _loop_of_two(path: Path) -> None:
    other = path.with_name("loop")
    other.symlink_to(path)
    path.symlink_to(other)


PLACES: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: None,
    "directory": lambda path: path.mkdir(),
    "loop": lambda path: path.symlink_to(path),
    "loop of two": _loop_of_two,
    "dangling link": lambda path: path.symlink_to("nowhere"),
    "pipe": os.mkfifo,
    "endless device": lambda path: path.symlink_to("/dev/zero"),
    "empty device": lambda path: path.symlink_to("/dev/null"),
    "not readable": lambda path: path.touch(0),
    "huge file": lambda path: (path.touch(), os.truncate(path, 2**44)),
}


# Sound experiments.

_LINK = """
[[link]]
name = "NAME"
joint = "JOINT"
length = 0.5
mass = 0.2
bending_stiffness = 0.8
payload = 0.0
markers = [0.25, 0.5]
markers_frame = "FRAME"
virtual_joints = 1
"""
_TOML = """\
schema = 1
name = "small arm"
[base]
gravity = [0.0, 0.0]
LINKS
[sensors]
marker_noise = 3e-4
encoder_noise = 1e-4
[[recording]]
file = "a.csv"
kind = "KIND"
role = "train"
repeat = "x"
payload = 0.0
[[recording]]
file = "b.csv"
kind = "KIND"
role = "holdout"
condition = "after"
gravity = [0.0, 0.0]
"""
_CONVENTIONS = """\
[units]
length = "mm"
angle = "deg"
time = "ms"
torque = "N mm"
[camera]
origin = [0.1, -0.02]
rotation = 0.0
axes = ["x", "-z"]
[columns]
t = "Time"
"arm.theta" = "Motor angle"
"arm.m1.x" = "Marker1_X"
"arm.m1.z" = "Marker1_Z"
[[recording]]"""


@cache
def sound(kind: str) -> Case:
    """A small experiment with which nothing is wrong, and a model of its arm.

    It is a beam, `clamped` or on a `hub`, or `two` links; recordings of a `foreign` hub are in other units, axes,
    columns and files.
    """
    hub = kind != "clamped"
    link = Link("arm", "revolute" if hub else "clamped", 0.5, 0.2, 0.8, (0.25, 0.5), virtual_joints=1)
    tip = Link("tip", "clamped", 0.5, 0.2, 0.8, (0.25, 0.5), markers_frame="link", virtual_joints=1)
    rig = Rig("small arm", (link, tip) if kind == "two" else (link,), marker_noise=3e-4, encoder_noise=1e-4)
    links = [
        _LINK.replace("NAME", one.name).replace("JOINT", one.joint).replace("FRAME", one.markers_frame)
        for one in rig.links
    ]
    if hub:
        links[0] += "hub_inertia = 0.0\n"
    toml = _TOML.replace("LINKS", "".join(links)).replace("KIND", "driven" if hub else "decay")
    tables = {"a.csv": _simulated(rig, 0), "b.csv": _simulated(rig, 1)}
    if kind == "foreign":
        toml = toml.replace("[[recording]]", _CONVENTIONS, 1)
        for name in list(tables):
            tables[name], tables[f"motors_{name}"] = _foreign(tables[name])
            toml = toml.replace(f'file = "{name}"', f'file = "{name}"\nmotors_file = "motors_{name}"')
    return Case("rig", toml.splitlines(), tables, json.loads(model_text(_model(rig))))


def _model(rig: Rig) -> Model:
    return Model(nominal_chain(rig, rig_layouts(rig, [2] * len(rig.links))), rig, 3e-4, 1e-4)


def _simulated(rig: Rig, seed: int) -> Table:
    """A recording of a drive, or of a beam that is let go, with noise."""
    random, time, arm = np.random.default_rng(seed), np.arange(48) / 30.0, _model(rig).arm
    hub, count = len(rig.active_links), sum(len(link.markers) for link in rig.links)
    unknown, torque = np.full((time.size, hub), np.nan), 0.05 * np.sin(5.0 * time + seed)[:, None][:, :hub]
    recording = Recording(time, np.full((time.size, count, 2), np.nan), unknown, torque, kind="driven")
    still = np.zeros(arm.chain.size)
    motion = simulate(arm, rig, recording, still if hub else still + 0.1 - 0.03 * seed, still)
    markers = motion.markers.reshape(time.size, -1) + random.normal(0.0, 3e-4, (time.size, 2 * count))
    names = ["t", *(name for link in rig.links for name in link.marker_columns), "arm.theta", "arm.tau"]
    theta = motion.theta + random.normal(0.0, 1e-4, unknown.shape)
    values = np.hstack([time[:, None], markers, theta, torque])
    return Table(names[: values.shape[1]], values)


def _foreign(table: Table) -> tuple[Table, Table]:
    """The same recording as the camera and the motor driver of `_CONVENTIONS` give it."""
    t, x1, y1, x2, y2, theta, tau = table.values.T
    markers = [1e3 * each for each in (x1 - 0.1, -y1 - 0.02, x2 - 0.1, -y2 - 0.02)]
    names = ["Time", "Marker1_X", "Marker1_Z", "arm.m2.x", "arm.m2.z", "Quality"]
    motors = np.column_stack([1e3 * t, np.degrees(theta), 1e3 * tau])
    return Table(names, np.column_stack([1e3 * t, *markers, t])), Table(["t", "Motor angle", "arm.tau"], motors)


# What spoils them.

_NAMES = [
    *("\x1b[31mred", "a\nb", "a\rvjm: b", "\a", "\x7f", "\x9b2J", "\u202egnp", "\u2066x", "\u2028", "\u200b", "\ufeff"),
    *("\0", "\udcff", "'", '"', "../..", "/", "é世\U0001f9be", "x" * 300, "", " ", "\t", "[bold]x[/bold]", "%s{0}"),
]
TEXTS = st.sampled_from(_NAMES) | st.text(max_size=8)
_EXTREMES = [
    *(0.0, -1.0, 1e-300, 1e300, 1e308, 5e-324, -1e300, math.inf, -math.inf, math.nan),
    *(1e9, 1e-9, 1e3, 1e-3, 1e6, 1e-6, 1e15, 1e-15, 2.0**63),
]
_POWERS = st.floats(-30.0, 30.0) | st.floats(-3.0, 3.0)
FACTORS = st.sampled_from(_EXTREMES) | _POWERS.map(lambda power: 10.0**power)
NUMBERS = FACTORS | st.floats() | st.integers(-3, 70)
_ODD_VALUES = [
    *("true", "[]", "{}", "[[]]", "[1, 2]", "[nan, 1]", "[1e300, 2e300]", "1979-05-27", "{a = {b = 1}}", '"\x1b"'),
    *("1" + "0" * 400, "0x" + "f" * 400, "9" * 5000, "9223372036854775808"),
]
_CHOICES = {
    "joint": ["revolute", "clamped"],
    "kind": ["driven", "decay", "static", "quiet"],
    "role": ["train", "holdout"],
    "markers_frame": ["base", "link"],
    "length": ["m", "mm", "cm", "in"],
    "angle": ["rad", "deg"],
    "time": ["s", "ms", "us"],
    "torque": ["N m", "N mm"],
    "condition": ["reference"],
    "repeat": ["x"],
    "file": ["a.csv", "b.csv"],
}
_NEW_KEYS = [
    *("width = 0.03", "thickness = 0.002", "youngs_modulus = 7e10", 'input = "motion"', 'motors_file = "b.csv"'),
    *("hub_inertia = 0.01", '"\\u001b[2J" = 1', '"a\\nb" = 1', "markers = []"),
]


def _quoted(text: str) -> str:
    """A TOML string; of half a surrogate pair, which TOML cannot hold, the character itself."""
    return "".join(c if "\ud800" <= c <= "\udfff" else json.dumps(c)[1:-1] for c in text).join('""')


VALUES = NUMBERS.map(repr) | TEXTS.map(_quoted) | st.sampled_from(_ODD_VALUES)


def _line(draw: Draw, case: Case) -> int:
    return draw(st.integers(0, len(case.toml) - 1))


def _table(draw: Draw, case: Case) -> Table:
    return case.tables[draw(st.sampled_from(list(case.tables)))]


def _chosen_tables(draw: Draw, case: Case) -> list[Table]:
    return [_table(draw, case)] if draw(st.booleans()) else list(case.tables.values())


def value(draw: Draw, case: Case) -> None:
    """A key has another value: another valid one, or anything."""
    at = _line(draw, case)
    key, equals, _ = case.toml[at].partition(" = ")
    if equals:
        valid = st.sampled_from(_CHOICES.get(key, ["x"])).map(_quoted)
        case.toml[at] = f"{key} = {draw(VALUES | valid)}"


def number(draw: Draw, case: Case) -> None:
    """A key's number is in another unit, or far beyond that."""
    at, factor = _line(draw, case), draw(FACTORS)
    key, equals, text = case.toml[at].partition(" = ")
    parts = text.strip("[]").split(", ")
    chosen = draw(st.integers(-1, len(parts) - 1))
    with contextlib.suppress(ValueError):  # no number
        parts = [repr(float(part) * factor) if chosen in (k, -1) else part for k, part in enumerate(parts)]
        case.toml[at] = f"{key}{equals}[{', '.join(parts)}]" if text.startswith("[") else f"{key}{equals}{parts[0]}"


def key(draw: Draw, case: Case) -> None:
    """A key has another name, or there is one more."""
    at = _line(draw, case)
    name, _, text = case.toml[at].partition(" = ")
    if draw(st.booleans()):
        case.toml.insert(at + 1, draw(st.sampled_from(_NEW_KEYS)))
    else:
        case.toml[at] = f"{draw(TEXTS | st.just(name + 's'))} = {text}"


def line(draw: Draw, case: Case) -> None:
    """A line or a table is missing, twice there, elsewhere, or junk."""
    at, other = _line(draw, case), _line(draw, case)
    how = draw(st.sampled_from(["missing", "twice", "moved", "junk", "table"]))
    if how == "table":
        starts = [k for k, text in enumerate(case.toml) if text.startswith("[")] + [len(case.toml)]
        k = draw(st.integers(0, len(starts) - 2)) if len(starts) > 1 else 0
        stop = starts[min(k + 1, len(starts) - 1)]
        case.toml[starts[k] : stop] = case.toml[starts[k] : stop] * draw(st.sampled_from([0, 2, 20]))
    elif how == "junk":
        case.toml.insert(at, draw(TEXTS))
    else:
        text = case.toml[at] if how == "twice" else case.toml.pop(at)
        case.toml[other:other] = [text] * (how != "missing")
    case.toml = case.toml or [""]


def file_name(draw: Draw, case: Case) -> None:
    """A recording has another name, on the disk and in the experiment file."""
    old, new = draw(st.sampled_from(list(case.tables))), draw(TEXTS) + ".csv"
    if new not in case.tables:
        case.tables = {new if name == old else name: table for name, table in case.tables.items()}
        case.toml = [text.replace(f'"{old}"', _quoted(new)) for text in case.toml]


def column(draw: Draw, case: Case) -> None:
    """A column is scaled, shifted, constant, empty, noisy, sparse, or has another name."""
    table = _table(draw, case)
    k = draw(st.integers(0, len(table.columns) - 1))
    values = table.values[:, k]
    how = draw(st.sampled_from(["scaled", "shifted", "constant", "empty", "named", "noisy", "sparse"]))
    with np.errstate(all="ignore"):
        if how == "scaled":
            values *= draw(FACTORS)
        elif how == "shifted":
            values += draw(NUMBERS)
        elif how == "constant":
            values[:] = draw(NUMBERS)
        elif how == "empty":
            values[draw(st.integers(0, 20)) :] = np.nan
        elif how == "named":
            table.columns[k] = draw(TEXTS | st.sampled_from(["t", "arm.m3.x", "arm.m1.z", "tip.theta", "arm.tau"]))
        elif how == "noisy":
            values += draw(FACTORS) * np.random.default_rng(0).normal(size=values.size)
        elif how == "sparse":
            values[np.arange(values.size) % draw(st.integers(2, 12)) > 0] = np.nan


def columns(draw: Draw, case: Case) -> None:
    """A column is missing, there twice, or exchanged for another."""
    table = _table(draw, case)
    order = list(range(len(table.columns)))
    k, other = draw(st.sampled_from(order)), draw(st.sampled_from(order))
    how = draw(st.sampled_from(["missing", "added", "exchanged"]))
    if how == "missing" and len(order) > 1:
        order.remove(k)
    elif how == "added":
        order.append(k)
    table.values, table.columns = table.values[:, order], [table.columns[k] for k in order]
    if how == "added":
        table.columns[-1] = draw(TEXTS | st.sampled_from(table.columns))
    elif how == "exchanged":
        table.columns[k], table.columns[other] = table.columns[other], table.columns[k]


def unit(draw: Draw, case: Case) -> None:
    """All coordinates, all angles, all torques or all numbers are in another unit, or far beyond that."""
    factor, quantity = draw(FACTORS), draw(st.sampled_from(["", "m", "theta", "tau"]))
    for table in _chosen_tables(draw, case):
        for k, name in enumerate(table.columns):
            with np.errstate(all="ignore"):
                if name.lower().split(".")[-2 if quantity == "m" else -1 :][0].startswith(quantity):
                    table.values[:, k] *= factor


def time(draw: Draw, case: Case) -> None:
    """Times are scaled, shifted, far away, equal, reversed, at random, or have a pause."""
    how = draw(st.sampled_from(["scaled", "shifted", "far", "pause", "equal", "reversed", "squeezed", "random"]))
    row, amount = draw(st.integers(0, 47)), draw(FACTORS)
    for table in _chosen_tables(draw, case):
        t = table.column("t", "Time")
        at = min(row, t.size - 1)
        with np.errstate(all="ignore"):
            if how == "scaled":
                t *= amount
            elif how == "shifted":
                t += amount
            elif how == "far":
                t[at] = amount
            elif how == "pause":
                t[at:] += amount
            elif how == "equal":
                t[at:] = t[at]
            elif how == "reversed":
                t[:] = t[::-1].copy()
            elif how == "squeezed":
                t[at:] = t[at] + amount * (t[at:] - t[at])
            elif how == "random":
                t += amount * np.random.default_rng(0).random(t.size)


def rows(draw: Draw, case: Case) -> None:
    """Rows are missing; all but a few may be."""
    table = _table(draw, case)
    first, last = sorted((draw(st.integers(0, 47)), draw(st.integers(0, 47))))
    order = np.arange(len(table.values))
    inside = (order >= first) & (order <= last)
    kept = inside if draw(st.booleans()) else ~inside
    table.values = table.values[kept if kept.any() else ~kept]


def cell(draw: Draw, case: Case) -> None:
    """Cells hold anything."""
    table = _table(draw, case)
    odd = st.sampled_from(["1e999", "1,5", "0x10", "1_000", "NULL", "nan", '"1"', '"', "1e308", "-1e308", "١", "1e"])
    for _ in range(draw(st.integers(1, 3))):
        where = draw(st.integers(0, 47)), draw(st.integers(0, 10))
        table.junk[where] = draw(TEXTS | NUMBERS.map(repr) | odd)


def content(draw: Draw, case: Case) -> None:
    """A file's bytes are others."""
    files = {name: data for name, data in case.files.items() if isinstance(data, bytes)}
    name = draw(st.sampled_from(list(files)))
    data = files[name]
    at = draw(st.integers(0, len(data)))
    text = data.decode("utf-8", "replace")
    inserted = [b"\0", b"\xff", b"\x1b[31m", b'"', b"\xef\xbb\xbf", b"\r", b"1,2\n"]
    replaced = [(b",", b";"), (b",", b"\t"), (b".", b","), (b"\n", b"\r\n"), (b"\n", b"\r"), (b",", b", "), (b'"', b"")]
    case.contents[name] = draw(
        st.sampled_from([b"", b"\n", b" \n\n", b"\0" * 1000, b"[" * 100_000, b'{"a":' * 5000, b"\x89PNG\r\n\x1a\n"])
        | st.sampled_from([data[:at], data[at:], data * 2, b"# by hand\n" + data, b"{" + data, b"PK\x03\x04" + data])
        | st.sampled_from([b"\xef\xbb\xbf" + data, *(text.encode(code, "replace") for code in ("utf-16", "utf-16-le"))])
        | st.sampled_from(inserted).map(lambda more: data[:at] + more + data[at:])
        | st.sampled_from(replaced).map(lambda pair: data.replace(*pair))
    )


def place(draw: Draw, case: Case) -> None:
    """Something else stands where a file should, or where results should go."""
    name = draw(st.sampled_from([*case.files, OUT]))
    case.places[name] = draw(st.sampled_from([how for how in PLACES if (name, how) != (OUT, "pipe")]))  # is waited for


def folder(draw: Draw, case: Case) -> None:
    """The folder has another name."""
    name = draw(TEXTS)
    if 0 < len(name.encode("utf-8", "surrogateescape")) < 100 and not {"/", "\0"} & {*name} and name.strip("."):
        case.folder = name


def _nodes(content: Any) -> Iterator[tuple[Any, Any]]:
    """Yield all dictionaries and lists of a JSON value, each with each of its keys."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for name, item in items:
        yield content, name
        yield from _nodes(item)


def model(draw: Draw, case: Case) -> None:
    """Something in the model is scaled, anything else, missing, or there is one thing more."""
    nodes = list(_nodes(case.model))
    parent, name = draw(st.sampled_from(nodes)) if nodes else ({"": case.model}, "")
    old, how = parent[name], draw(st.sampled_from(["scaled", "scaled", "other", "text", "missing", "added"]))
    numbers = old if isinstance(old, list) else [old]
    if how == "scaled" and numbers and all(isinstance(each, float) for each in numbers):
        factor = draw(FACTORS)
        scaled = [each * factor for each in numbers]
        parent[name] = scaled if isinstance(old, list) else scaled[0]
    elif how == "missing":
        del parent[name]
    elif how == "added" and isinstance(parent, dict):
        parent[draw(TEXTS)] = copy.deepcopy(old)
    elif how == "text":
        parent[name] = draw(TEXTS)
    else:
        odd = st.sampled_from([None, True, {}, "1", 10**400])
        parent[name] = draw(NUMBERS | odd | st.sampled_from([[], [1.0], [None], [[1e300]]]).map(copy.deepcopy))


def effect(draw: Draw, case: Case) -> None:
    """The model has an effect, or an estimate, of any size."""
    chosen = draw(st.sampled_from(BUILTIN))
    values = {}
    for one in chosen.parameters:
        size = draw(st.sampled_from([one.null, chosen.values[one.name]]) | NUMBERS)
        values[one.name] = None if math.isinf(size) else size
    where = draw(st.sampled_from(["arm", None]))
    entry = {"effect": chosen.id, "link": where, "parameters": values, "in_reference": draw(st.booleans())}
    estimate = {
        **{"name": draw(TEXTS | st.just("arm.bending_stiffness")), "unit": draw(TEXTS | st.just("m")), "remedy": ""},
        **{"value": draw(NUMBERS), "std": draw(NUMBERS | st.none()), "discretization_shift": None},
        **{"identifiable": True, "reason": draw(TEXTS)},
    }
    for name, item in (("effects", entry), ("estimates", estimate)):
        if isinstance(case.model, dict) and isinstance(case.model.get(name), list) and draw(st.booleans()):
            case.model[name].append(item)


Spoiler = Callable[[Draw, Case], None]
_OF_FILES: list[Spoiler] = [content, place, folder]
_OF_EXPERIMENTS: list[Spoiler] = [
    *(value, value, number, number, number, key, line, file_name),
    *(column, column, columns, unit, unit, time, time, time, rows, cell),
]
_OF_MODELS: list[Spoiler] = [model, model, model, effect]
_OUT = ["-o", "{OUT}"]
_COMMANDS: dict[str, tuple[list[str], list[Spoiler]]] = {
    "check": (["check", "{EXPERIMENT}"], _OF_EXPERIMENTS),
    "check -o": (["check", "{EXPERIMENT}", *_OUT], _OF_EXPERIMENTS),
    "init": (["init", "{FOLDER}", *_OUT], _OF_EXPERIMENTS),
    "init with all": (
        ["init", "{FOLDER}", "--length", "0.5", "--mass", "0.2", "--bending-stiffness", "0.8", "-q"],
        _OF_EXPERIMENTS,
    ),
    "urdf of experiment": (["urdf", "{EXPERIMENT}", *_OUT], _OF_EXPERIMENTS),
    "urdf": (["urdf", "{MODEL}"], _OF_MODELS),
    "urdf -o": (["urdf", "{MODEL}", *_OUT], _OF_MODELS),
    "simulate": (["simulate", "{EXPERIMENT}", "{MODEL}", *_OUT], [*_OF_EXPERIMENTS, *3 * _OF_MODELS]),
}
_SLOW_COMMANDS = {  # where they answer, they take ten times as long as others
    "identify": (["identify", "{EXPERIMENT}", *_OUT], _OF_EXPERIMENTS),
    "identify by torques": (["identify", "{EXPERIMENT}", *_OUT, "--method", "torque+frequency"], _OF_EXPERIMENTS),
    "diagnose": (["diagnose", "{EXPERIMENT}", *_OUT, "--budget", "1"], _OF_EXPERIMENTS),
}


@st.composite
def cases(draw: Draw, slow: bool = True) -> Case:
    """Draw an experiment that is spoiled in one to three ways, and a command for it, now and then a slow one."""
    case = copy.deepcopy(sound(draw(st.sampled_from([*3 * ["clamped"], *3 * ["hub"], *3 * ["foreign"], "two"]))))
    choices = [*12 * [*_COMMANDS.values()], *_SLOW_COMMANDS.values()] if slow else [*_COMMANDS.values()]
    command, spoilers = draw(st.sampled_from(choices))
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 2, 3]))):
        draw(st.sampled_from([*spoilers, *_OF_FILES]))(draw, case)
    case.command = [*command, *["--json"] * (draw(st.integers(0, 9)) == 0)]
    if command[0] == "init":
        case.places.setdefault(EXPERIMENT, "nothing")
    return case


# The law.


@dataclass(frozen=True)
class Outcome:
    """What a command did, and in what it broke the law."""

    status: int | None  # None: it did not end
    stdout: str
    stderr: str
    seconds: float
    faults: tuple[str, ...]


class _HangsError(BaseException):
    """A command takes too long."""


def run(case: Case, parent: Path) -> Outcome:
    """Write a case, run its command in this process, and judge what it does."""
    folder = case.write(parent)
    places = {"FOLDER": folder, "EXPERIMENT": folder / EXPERIMENT, "MODEL": folder / MODEL, "OUT": folder / OUT}
    before, began, status = _listing(folder), monotonic(), None
    with _streams() as (stdout, stderr), _limits(), contextlib.suppress(_HangsError):
        status = main([argument.format(**places) for argument in case.command])
    seconds, written = monotonic() - began, _listing(folder) ^ before
    out, err = (stream.getvalue().decode("utf-8", "surrogateescape") for stream in (stdout, stderr))
    return Outcome(status, out, err, seconds, tuple(_faults(case, status, out, err, {name for name, _ in written})))


def _faults(case: Case, status: int | None, out: str, err: str, written: set[str]) -> Iterator[str]:
    if status not in (0, 1, 2):
        yield "it hangs" if status is None else f"status {status}"
    if any(word in err for word in ("internal error", "memory", "Traceback", "Warning")):
        yield "internal error"
    raw = sorted({character for character in out + err if character != "\n" and not _shown(character)})
    if raw:
        yield f"sends the terminal {raw!a}"
    if status == 0 and err:
        yield "an answer with a message on stderr"
    if status != 0:
        named = [json.dumps(name, ensure_ascii=False)[1:-1].encode("ascii", "backslashreplace") for name in case.files]
        if not err.startswith("vjm: ") or "; " not in err + ";":
            yield "no message"
        if not any(
            name and name in err.encode("ascii", "backslashreplace") for name in [*named, b"/out", b".csv", b"/rig: "]
        ):
            yield "names no file"
        if "not valid TOML" in err and case.command[0] == "init":
            yield "proposes a file that cannot be read"
        # A check draws what it refuses, and what init proposes is there to be corrected.
        allowed = {"check": {OUT, f"{OUT}/check.png"}, "init": {EXPERIMENT, OUT, f"{OUT}/check.png"}}
        if written - allowed.get(case.command[0], set()):
            yield f"refuses, and writes {sorted(written)}"


def _shown(character: str) -> bool:
    """Whether a terminal shows a character, rather than obeys it."""
    turning = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    return (
        unicodedata.category(character) not in ("Cc", "Cs", "Zl", "Zp")
        and unicodedata.bidirectional(character) not in turning
        and character not in "\u200b\u200e\u200f\u061c\ufeff"
    )


def _listing(folder: Path) -> set[tuple[str, tuple[int, ...]]]:
    found = set()
    for path in folder.rglob("*"):
        info = path.lstat()
        found.add((path.relative_to(folder).as_posix(), (info.st_mode, info.st_size, info.st_mtime_ns)))
    return found


@contextlib.contextmanager
def _streams() -> Iterator[tuple[io.BytesIO, io.BytesIO]]:
    """Give what is sent to stdout and stderr, as bytes."""
    kept, streams = (sys.stdout, sys.stderr), (io.BytesIO(), io.BytesIO())
    sys.stdout, sys.stderr = (io.TextIOWrapper(stream, encoding="utf-8", write_through=True) for stream in streams)
    try:
        yield streams
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.detach()  # type: ignore[union-attr]
        sys.stdout, sys.stderr = kept


@contextlib.contextmanager
def _limits() -> Iterator[None]:
    """Interrupt what takes too long, also where it waits for a pipe, and let allocations fail that are too large."""

    def stop(*_: object) -> None:
        raise _HangsError

    before = signal.signal(signal.SIGUSR1, stop)
    watchdog = threading.Timer(SECONDS, os.kill, (os.getpid(), signal.SIGUSR1))
    watchdog.start()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    usage = Path("/proc/self/statm")  # of Linux, where the limit is kept
    if usage.exists():
        used = int(usage.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        watchdog.cancel()
        signal.signal(signal.SIGUSR1, before)
