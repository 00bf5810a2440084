"""Files written whole or not at all, and JSON a person can read."""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vjm.errors import ShapeError


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
