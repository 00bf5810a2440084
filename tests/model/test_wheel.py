"""The templates must be where an installed vjm looks for them."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.model.chains import model_of, plain_chain, write_model
from vjm.model.urdf import chain_to_urdf

REPOSITORY = Path(__file__).parents[2]
WRITE = """
import sys, vjm
from vjm.model.urdf import _environment, chain_to_urdf
print(vjm.__file__, _environment().get_template("chain.urdf.jinja").filename)
open(sys.argv[2], "w", encoding="utf-8").write(chain_to_urdf(vjm.load_model(sys.argv[1]).chain))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    isolation = ["--no-isolation"] if find_spec("hatchling") else []
    run(sys.executable, "-m", "build", "--wheel", *isolation, "--outdir", folder, REPOSITORY, cwd=folder)
    return next(folder.glob("*.whl"))


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    result = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=os.environ | environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_wheel_holds_every_template(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    templates = {f"vjm/urdf_templates/{file.name}" for file in (REPOSITORY / "urdf_templates").iterdir()}
    assert "vjm/urdf_templates/chain.urdf.jinja" in templates
    assert templates <= names
    report = {f"vjm/report/{name}" for name in ("report.html.jinja", "report.css", "report.js")}
    assert report | {f"vjm/report/uplot/{name}" for name in ("uPlot.iife.min.js", "uPlot.min.css", "LICENSE")} <= names


def test_installed_wheel_writes_urdf_with_its_own_templates(wheel: Path, tmp_path: Path) -> None:
    site, model, urdf = tmp_path / "site", tmp_path / "model.json", tmp_path / "model.urdf"
    run(sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", site, wheel, cwd=tmp_path)
    write_model(model_of(plain_chain()), model)
    places = run(sys.executable, "-c", WRITE, model, urdf, cwd=tmp_path, PYTHONPATH=str(site)).split()
    assert places == [str(site / "vjm" / "__init__.py"), str(site / "vjm" / "urdf_templates" / "chain.urdf.jinja")]
    assert urdf.read_text(encoding="utf-8") == chain_to_urdf(plain_chain())
