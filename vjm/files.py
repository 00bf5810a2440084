"""Files and folders that are written whole or not at all, and JSON that people can read."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import stat
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vjm.errors import InputError, printable, shown

_LARGEST = 2**31  # bytes of a file that is read: a hundred million numbers, days of a fast camera


class FolderError(InputError):
    """A folder or file that cannot be written.

    Attributes:
        path: where it should have gone.
        problem: why it cannot.
        remedy: what to do.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str) -> None:
        self.path, self.problem, self.remedy = Path(path), problem, remedy
        super().__init__(f"{path}: {problem}; {remedy}")


def read_file(path: Path) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: it cannot be read; `strerror` says why, in words.
    """
    check_file(path)
    return path.read_bytes()


def check_file(path: Path) -> None:
    """Check that a path leads to a file: to no directory, nor a pipe or a device, which may never end.

    Raises:
        OSError: it does not, or the file is too large; `strerror` says why, in words.
    """
    try:
        status = path.stat()
    except ValueError as error:  # a NUL in its name
        raise OSError(errno.EINVAL, str(error)) from error
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "this is a directory")
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "this is a pipe or a device, not a file")
    if status.st_size > _LARGEST:
        raise OSError(errno.EFBIG, f"larger than {_LARGEST / 2**30:g} GiB")


def json_text(value: object) -> str:
    """Return dictionaries, lists, tuples, text, finite numbers, booleans and None as JSON.

    It is indented by two, each list of plain values on one line.
    """
    return _indented(value, "\n") + "\n"


def _indented(value: object, newline: str) -> str:
    inner = newline + "  "
    if isinstance(value, dict) and value:
        rows = [f"{_json(key)}: {_indented(item, inner)}" for key, item in value.items()]
        return "{" + inner + f",{inner}".join(rows) + newline + "}"
    if isinstance(value, list | tuple) and any(isinstance(item, dict | list | tuple) for item in value):
        return "[" + inner + f",{inner}".join(_indented(item, inner) for item in value) + newline + "]"
    return _json(value)


def _json(value: object) -> str:
    return printable(json.dumps(value, ensure_ascii=False, allow_nan=False))


def plain(value: Any, finite: bool = True) -> Any:
    """Return a value in JSON's own types; arrays become lists, and numbers that are not `finite`, if so asked, None."""
    if isinstance(value, Mapping):
        return {key: plain(item, finite) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, finite) for item in value]
    if hasattr(value, "tolist"):  # an array, or a scalar of NumPy's
        return plain(value.tolist(), finite)
    return None if finite and isinstance(value, float) and not math.isfinite(value) else value


def _encoded(content: str | bytes) -> bytes:
    """Return text as UTF-8; of half a surrogate pair (from an undecodable file name), its JSON escape."""
    return content if isinstance(content, bytes) else content.encode("utf-8", "backslashreplace")


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8 so that nobody ever sees half a file and a failure leaves what was there before.

    A symbolic link is followed, an existing file's permissions are kept, and what is no regular file (a terminal, a
    pipe) is written straight to.

    Raises:
        FolderError: the file cannot be written.
    """
    target = check_no_folder(path)
    try:
        if target.exists() and not target.is_file():
            target.write_bytes(_encoded(text))
            return
        target = Path(os.path.realpath(target))
        _check_parent(target)
        # A file made in a temporary folder has the usual permissions, which one from NamedTemporaryFile has not.
        with TemporaryDirectory(prefix=".vjm-", dir=target.parent) as stage:
            temporary = Path(stage) / target.name
            temporary.write_bytes(_encoded(text))
            if target.exists():
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
    except OSError as error:
        raise _unwritable(target, error) from error


def check_no_folder(path: Path | str) -> Path:
    """Return where a file shall stand as a path.

    Raises:
        FolderError: it is a folder, or no path.
    """
    file = _as_path(path)
    if os.path.isdir(file):
        raise FolderError(file, "this is a folder", "name a file, such as one in it")
    return file


def _as_path(value: Path | str) -> Path:
    try:
        return Path(value)
    except TypeError as error:
        raise FolderError(shown(value), "this is no path", "give the name of a file or folder") from error


def check_folder(directory: Path | str) -> Path:
    """Return the folder as a path if results can be written into it or it can be made; nothing is made yet.

    Raises:
        FolderError: it is no folder or path, its parent does not exist, or it cannot be written to.
    """
    folder = _as_path(directory)
    try:
        is_folder = stat.S_ISDIR(folder.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        _check_parent(folder)
        return folder
    except OSError as error:
        raise _unwritable(folder, error) from error
    if not is_folder:
        raise FolderError(folder, "this is no folder", "choose another folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise FolderError(folder, "this folder cannot be written to", "choose another folder")
    return folder


def _check_parent(path: Path) -> None:
    """Raise a FolderError if a file or folder cannot be made where it shall stand."""
    parent = path.parent
    if not parent.is_dir():
        problem = "is no folder" if parent.exists() else "does not exist"
        raise FolderError(path, f"the folder {parent} {problem}", "make it first, or choose another place")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise FolderError(path, f"the folder {parent} cannot be written to", "choose another place")


def _unwritable(path: Path, error: OSError) -> FolderError:
    return FolderError(path, f"cannot be written ({error.strerror or error})", "choose another place")


def write_folder(directory: Path | str, files: Mapping[str, str | bytes], outdated: Iterable[str] = ()) -> Path:
    """Write several files into a folder and return it; if anything fails, the folder is as it was before.

    Args:
        directory: made if it does not exist; files in it that are not written anew stay.
        files: content by name, relative to the directory, put in place in this order.
        outdated: names of an earlier run's files, removed unless written anew.

    Raises:
        FolderError: the folder cannot be written to.
    """
    folder = check_folder(directory)
    blocked = [name for name in files if (folder / name).is_dir()]
    if blocked:
        raise FolderError(folder / blocked[0], "this is a folder, not a file", "remove it, or choose another folder")
    removed = [name for name in outdated if name not in files and (folder / name).is_file()]
    try:
        with ExitStack() as undo:
            _make(folder, undo)
            with TemporaryDirectory(prefix=".vjm-", dir=folder) as stage:
                _replace(folder, Path(stage), files, removed)
            undo.pop_all()
    except OSError as error:
        raise _unwritable(folder, error) from error
    return folder


def _replace(folder: Path, stage: Path, files: Mapping[str, str | bytes], removed: Iterable[str]) -> None:
    """Write the new files into `stage`, then swap them with the old ones; take every step back if one fails."""
    for name, content in files.items():
        (stage / "new" / name).parent.mkdir(parents=True, exist_ok=True)
        (stage / "new" / name).write_bytes(_encoded(content))
    with ExitStack() as undo:
        for name in (*removed, *files):
            target, backup = folder / name, stage / "old" / name
            _make(target.parent, undo)
            if target.exists() or target.is_symlink():
                backup.parent.mkdir(parents=True, exist_ok=True)
                undo.callback(_put_back, backup, target)
                os.replace(target, backup)
            else:
                undo.callback(target.unlink, missing_ok=True)
            if name in files:
                os.replace(stage / "new" / name, target)
        undo.pop_all()


def _make(folder: Path, undo: ExitStack) -> None:
    if not folder.exists():
        folder.mkdir()
        undo.callback(folder.rmdir)


def _put_back(backup: Path, target: Path) -> None:
    if backup.exists() or backup.is_symlink():
        os.replace(backup, target)
