"""`import vjm` is light, and gives every public name."""

from __future__ import annotations

import subprocess
import sys

import pytest

import vjm


def python(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_import_is_light() -> None:
    loaded = python("import sys, vjm; print(sorted({'numpy', 'scipy', 'pinocchio', 'matplotlib'} & set(sys.modules)))")
    assert loaded.strip() == "[]"


def test_every_name_is_there() -> None:
    for name in vjm.__all__:
        assert getattr(vjm, name) is not None
        assert name in dir(vjm)
    assert vjm.__version__
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        _ = vjm.colour


def test_functions_stay_functions_whatever_was_imported_first() -> None:
    code = "import vjm.report.output, vjm.identification.check, vjm.cli.commands; import vjm; "
    code += "print(all(callable(getattr(vjm, name)) for name in vjm.__all__ if name != 'effects'))"
    assert python(code).strip() == "True"
