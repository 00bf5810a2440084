"""README.md and the documentation are true: code runs, commands and files exist, numbers are those of the demo."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import tomllib
from functools import cache
from pathlib import Path

import pytest

import vjm
from tests.fine_beam.make_demo import NOMINAL_STIFFNESS, TRUE_BEAM
from vjm.cli import _parse
from vjm.errors import RecordingError
from vjm.identification import identify

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PAGES = sorted((ROOT / "docs").rglob("*.md"))
MOST_WORDS = 900
DEMO = Path(vjm.__file__).parent / "demo"


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def commands(text: str = README) -> list[str]:
    return [line for block in blocks("sh", text) for line in block.splitlines()]


@pytest.fixture
def demo_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder holds the demo as `my_beam`, which is identified once."""
    shutil.copytree(DEMO, tmp_path / "my_beam")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(vjm, "identify", lambda experiment: _identified())
    return tmp_path


@cache
def _identified() -> vjm.Identification:
    return identify(vjm.load_experiment(DEMO / "experiment.toml"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_python_code_of_the_documentation_runs(page: Path, demo_folder: Path) -> None:
    names: dict[str, object] = {}
    for block in blocks("python", page.read_text(encoding="utf-8")):
        exec(compile(block, str(page), "exec"), names)


def test_python_code_runs_and_the_demo_gives_the_numbers_quoted(demo_folder: Path) -> None:
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    for name in ("arm.urdf", "out/report.html", "out/result.json", "out/model.json", "out/model.urdf"):
        assert (demo_folder / name).stat().st_size > 0

    fit = names["fit"]
    assert isinstance(fit, vjm.Identification)
    stiffness, held_out = fit.parameters[0], fit.recordings[-1]
    assert held_out.simulated is not None
    assert held_out.reference is not None
    assert stiffness.error is not None
    quoted = {
        r"bending stiffness is ([\d.]+) N m²": TRUE_BEAM.bending_stiffness,
        r"not the ([\d.]+) N m² that the nominal": NOMINAL_STIFFNESS,
        r"([\d.]+) ± [\d.]+ N m²": stiffness.value,
        r"± ([\d.]+) N m²": stiffness.error,
        r"open loop, to ([\d.]+) mm RMS": 1e3 * held_out.simulated.marker_rms,
        r"misses it by ([\d.]+) mm": 1e3 * held_out.reference.marker_rms,
    }
    for pattern, value in quoted.items():
        (said,) = re.findall(pattern, README.replace("\n", " "))
        digit = 10.0 ** -len(said.partition(".")[2])
        assert float(said) == pytest.approx(value, abs=digit), pattern


def test_experiment_file_and_recording_are_valid(tmp_path: Path) -> None:
    (toml,), (csv,) = blocks("toml", TUTORIAL), blocks("csv", TUTORIAL)
    file = tmp_path / "experiment.toml"
    file.write_text(toml, encoding="utf-8")
    for recording in tomllib.loads(toml)["recording"]:
        (tmp_path / recording["file"]).write_text(csv, encoding="utf-8")
    with pytest.raises(RecordingError, match="1 usable frame; expected at least 10"):  # all else is in order
        vjm.load_experiment(file)


def test_every_vjm_command_is_one_that_vjm_takes() -> None:
    found = [*commands(), *commands(TUTORIAL)]
    lines = [part for line in found for part in line.split(" && ") if part.startswith("vjm ")]
    assert {shlex.split(line)[1] for line in lines} == {"demo", "check", "identify", "diagnose", "simulate", "urdf"}
    for line in lines:
        _parse(shlex.split(line)[1:])


def test_installing_takes_one_line_and_testing_another() -> None:
    lines = [line for line in commands() if "pip install" in line]
    assert lines == [
        "python -m pip install . && vjm demo",
        'python -m pip install ".[test]" && python -m pytest -n auto',
    ]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "test" in project["optional-dependencies"]
    assert project["requires-python"] == ">=3.11"


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES], ids=lambda page: page.stem)
def test_what_it_links_to_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = [page.parent / target for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text) if "://" not in target]
    targets += [ROOT / name for name in re.findall(r"`((?:examples|tests|docs|benchmarks|vjm|\.ci)/[\w./]*)`", text)]
    assert [str(target) for target in targets if not target.exists()] == []


def test_modules_that_the_method_names_are_there() -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    folders = {path.name for path in (ROOT / "vjm").iterdir() if path.is_dir()}
    named = {name for name in re.findall(r"`(\w+/\w*)`", text) if name.split("/")[0] in folders}
    assert len(named) > 10
    there = [name for name in named if (ROOT / "vjm" / f"{name}.py").exists() or (ROOT / "vjm" / name).is_dir()]
    assert named == set(there)


def test_readme_is_short_and_names_every_example() -> None:
    assert len(README.split()) <= MOST_WORDS
    assert [path.name for path in (ROOT / "examples").glob("*.py") if path.name not in README] == []


def test_the_list_of_effects_is_the_one_built_in() -> None:
    written = runpy.run_path(str(ROOT / "docs" / "make_effects.py"))["page"]()
    assert (ROOT / "docs" / "effects.md").read_text(encoding="utf-8") == written, "run python docs/make_effects.py"


def test_the_layout_names_every_module() -> None:
    rows = re.findall(r"^\| (`[^|]+`) \| [^|]+ \|$", CONTRIBUTING, flags=re.MULTILINE)
    named = {name.rstrip("/") for row in rows for name in re.findall(r"`([\w/]+)`", row)}
    package = ROOT / "vjm"
    there = {path.stem for path in package.iterdir() if path.suffix == ".py" and path.stem != "__init__"}
    there |= {path.name for path in package.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert named == there
