"""A folder of files that are written all together or not at all."""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from vjm.errors import InputError, ShapeError


def write_text_atomic(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8, all of it or none; see `write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode("utf-8"))


def write_bytes_atomic(path: Path | str, data: bytes) -> None:
    """Write `data` so that nobody ever sees half a file, and a failure leaves what was there before.

    Args:
        path: the file; its directory exists. A symbolic link is followed, an existing file's permissions are kept,
            and what is no regular file (a terminal, a pipe) is written straight to.
        data: the whole content.

    Raises:
        OSError: the file cannot be written.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        target.write_bytes(data)
        return
    target = Path(os.path.realpath(target))
    # Opened by hand, for the usual permissions: files from `tempfile` are their owner's alone.
    temporary = target.with_name(f".vjm-{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def json_text(value: object) -> str:
    """JSON, indented by two, with each list of plain values on one line; ends with a newline.

    Args:
        value: mappings with text keys, lists, tuples, NumPy arrays and scalars, text, numbers, booleans, None.
            Keys keep their order.

    Raises:
        ShapeError: a number that is not finite, or a value JSON has no word for; names the place.
    """
    return _dumped(_plain(value, ""), "\n") + "\n"


def _plain(value: object, place: str) -> object:
    """`value` in JSON's own types."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {_key(key, place): _plain(item, f"{place}.{key}" if place else str(key)) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, f"{place}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ShapeError(place or "value", value, "a finite number")
    if value is not None and not isinstance(value, str | bool | int | float):
        raise ShapeError(place or "value", type(value).__name__, "a value that JSON can hold")
    return value


def _key(key: object, place: str) -> str:
    if not isinstance(key, str):
        raise ShapeError(place or "value", f"key {key!r}", "text as keys")
    return key


def _dumped(value: object, newline: str) -> str:
    inner = newline + "  "
    if isinstance(value, dict) and value:
        rows = [f"{_scalar(key)}: {_dumped(item, inner)}" for key, item in value.items()]
        return "{" + inner + f",{inner}".join(rows) + newline + "}"
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return "[" + inner + f",{inner}".join(_dumped(item, inner) for item in value) + newline + "]"
    if isinstance(value, list):
        return "[" + ", ".join(_scalar(item) for item in value) + "]"
    return _scalar(value)


def _scalar(value: object) -> str:
    # Half a surrogate pair (from an undecodable file name) has no UTF-8; JSON can escape it.
    broken = isinstance(value, str) and any("\ud800" <= character <= "\udfff" for character in value)
    return json.dumps(value, ensure_ascii=broken, allow_nan=False)


class FolderError(InputError):
    """A folder or file that cannot be written.

    Attributes:
        path: where it should have gone.
        problem: why it cannot.
        remedy: what to do.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str) -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}; {remedy}")


def check_folder(directory: Path | str) -> Path:
    """Make sure, before any long computation, that a folder can be made or written to.

    Raises:
        FolderError: it cannot.
    """
    folder = Path(directory)
    if folder.is_dir():
        if not os.access(folder, os.W_OK | os.X_OK):
            raise FolderError(folder, "this folder cannot be written to", "choose another with -o DIR")
        return folder
    if folder.exists() or folder.is_symlink():
        raise FolderError(folder, "this is no folder", "choose a folder with -o DIR")
    check_parent(folder)
    return folder


def check_parent(path: Path) -> None:
    """Make sure that a file or folder can be made where it should go.

    Raises:
        FolderError: its parent is missing, is no folder, or cannot be written to.
    """
    parent = path.parent
    if not parent.is_dir():
        problem = "is no folder" if parent.exists() else "does not exist"
        raise FolderError(path, f"the folder {parent} {problem}", "make it first, or choose another place with -o")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise FolderError(path, f"the folder {parent} cannot be written to", "choose another place with -o")


def write_together(directory: Path | str, fill: Callable[[Path], None], stale: Iterable[str] = ()) -> Path:
    """Write several files into a folder; when anything fails, the folder is as it was before.

    Args:
        directory: made if it does not exist; files in it that are not written anew stay.
        fill: writes all files into the empty folder that it is given.
        stale: files of an earlier run, relative to the directory, to be removed unless written anew.

    Raises:
        FolderError: the folder cannot be written to.
    """
    folder = check_folder(directory)
    existed = folder.exists()
    try:
        folder.mkdir(exist_ok=True)
        stage = folder / f".vjm-{secrets.token_hex(8)}.tmp"
        try:
            (stage / "new").mkdir(parents=True)
            fill(stage / "new")
            _swap(folder, stage, stale)
        finally:
            shutil.rmtree(stage, ignore_errors=True)
    except BaseException as error:
        if not existed:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            problem = f"cannot be written ({error.strerror or error})"
            raise FolderError(folder, problem, "choose another with -o DIR") from error
        raise
    return folder


def _swap(folder: Path, stage: Path, stale: Iterable[str]) -> None:
    """Put the new files in place, setting the old ones aside; put those back when anything fails."""
    new, old = stage / "new", stage / "old"
    names = sorted(str(path.relative_to(new)) for path in new.rglob("*") if path.is_file())
    # What describes the others comes last.
    names.sort(key=lambda name: name == "result.json")
    outdated = [name for name in stale if name not in names and (folder / name).is_file()]
    blocked = [name for name in names if (folder / name).is_dir()]
    if blocked:
        raise FolderError(folder / blocked[0], "this is a folder, not a file", "remove it, or choose another -o DIR")
    undo: list[Callable[[], object]] = []
    try:
        for name in (*outdated, *names):
            _replace(folder / name, new / name, old / name, undo)
    except BaseException:
        for step in reversed(undo):
            with suppress(OSError):
                step()
        raise


def _replace(target: Path, new: Path, old: Path, undo: list[Callable[[], object]]) -> None:
    """Set an old file aside and put the new one, if there is one, in its place; note how to take each step back."""
    if not target.parent.exists():
        target.parent.mkdir()
        undo.append(target.parent.rmdir)
    if target.exists() or target.is_symlink():
        old.parent.mkdir(parents=True, exist_ok=True)
        os.replace(target, old)
        undo.append(partial(os.replace, old, target))
    if new.exists():
        os.replace(new, target)
        undo.append(target.unlink)
