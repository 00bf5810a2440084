"""A folder of files that are written all together or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path

from vjm.errors import InputError


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
