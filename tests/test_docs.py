"""README.md and the documentation are true: code runs, commands and files exist, numbers are those of the demo."""

from __future__ import annotations

import ast
import math
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

import vjm
from tests.fine_beam.make_demo import NOMINAL_STIFFNESS, TRUE_BEAM
from tests.model.robots import UR5, robot
from vjm.cli import main
from vjm.cli.arguments import parse
from vjm.errors import RecordingError
from vjm.identification import identify

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
YOUR_DATA = (ROOT / "docs" / "how-to" / "your-data.md").read_text(encoding="utf-8")
FLEXIFY = (ROOT / "docs" / "how-to" / "flexify.md").read_text(encoding="utf-8")
OTHER_TOOLS = (ROOT / "docs" / "how-to" / "other-tools.md").read_text(encoding="utf-8")
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
    header, rows = (DEMO / "first_mode.csv").read_text(encoding="utf-8").split("\n", 1)
    rows = rows.replace(",", ";").replace(".", ",")
    export = f"Länge;mm\n\nKamera;1\n{header.replace(',', ';')}\n{rows}"
    (tmp_path / "export.txt").write_text(export, encoding="latin-1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(vjm, "identify", lambda experiment: _identified())
    return tmp_path


@cache
def _identified() -> vjm.Identification:
    return identify(vjm.load_experiment(DEMO / "experiment.toml"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_python_code_of_the_documentation_runs(page: Path, demo_folder: Path) -> None:
    names: dict[str, object] = {}
    if blocks("python", page.read_text(encoding="utf-8")) and "ur5_robot.urdf" in page.read_text(encoding="utf-8"):
        shutil.copy(robot(UR5), demo_folder)
    for block in blocks("python", page.read_text(encoding="utf-8")):
        exec(compile(block, str(page), "exec"), names)


def test_code_of_the_page_on_robots_runs(demo_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its arrays are those of the example that the page quotes, two seconds of them."""
    text = (ROOT / "docs" / "how-to" / "identify-robot.md").read_text(encoding="utf-8")
    shutil.copy(robot(UR5), demo_folder)
    monkeypatch.syspath_prepend(ROOT / "examples")
    recorded = runpy.run_path(str(ROOT / "examples" / "identify_robot.py"))["recorded"]
    time, encoders, positions = recorded("ur5_robot.urdf", 2.0)
    names: dict[str, object] = {"time": time, "q_active": encoders, "positions": positions, "torques": None}
    for block in blocks("py(?:thon)?", text):
        exec(compile(block, "identify-robot.md", "exec"), names)
    fit = names["fit"]
    assert isinstance(fit, vjm.RobotIdentification)
    assert fit["forearm_link.bending_stiffness_x"].value == pytest.approx(400.0, rel=0.02)


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
        r"nominal values give ([\d.]+) N m²": NOMINAL_STIFFNESS,
        r"([\d.]+) ± [\d.]+ N m²": stiffness.value,
        r"± ([\d.]+) N m²": stiffness.error,
        r"mm \(nominal model\) to ([\d.]+) mm": 1e3 * held_out.simulated.marker_rms,
        r"falls from ([\d.]+) mm \(nominal": 1e3 * held_out.reference.marker_rms,
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


def test_tables_for_own_recordings_are_valid(tmp_path: Path) -> None:
    """The page's tables, with the tutorial's rig, read a recording in those units, axes, names and files."""
    (rig,), (own,) = blocks("toml", TUTORIAL), blocks("toml", YOUR_DATA)
    table = tomllib.loads(rig)
    count = len(table["link"][0]["markers"])
    names = {f"beam.m{k}.{axis}": f"beam.m{k}.{axis}" for k in range(1, count + 1) for axis in "xz"}
    names |= {"t": "Time", "beam.m1.x": "Marker1_X", "beam.m1.z": "Marker1_Z"}
    angle = [0.02 * row for row in range(12)]
    place = [[1e3 * 0.1 * k * math.cos(a), -1e3 * 0.1 * k * math.sin(a)] for k in range(1, count + 1) for a in angle]
    rows = [",".join(names[name] for name in ("t", *(n for n in names if n != "t")))]
    for row in range(12):
        cells = [10.0 * row, *(value for k in range(count) for value in place[12 * k + row])]
        rows.append(",".join(map(repr, cells)))
    (tmp_path / "drive_1.csv").write_text("\n".join(rows) + "\n")
    motors = [f"{10.0 * row + 5},{math.degrees(a)},{100.0 * row}" for row, a in enumerate(angle)]
    (tmp_path / "drive_1_motors.csv").write_text("Time,Motor angle,Torque\n" + "\n".join(motors) + "\n")
    file = tmp_path / "experiment.toml"
    file.write_text(rig[: rig.index("[[recording]]")] + own, encoding="utf-8")
    (recording,) = vjm.load_experiment(file).recordings
    assert recording.time.size == 24
    assert recording.markers[0, 0] == pytest.approx([0.1 + 0.10, -0.02])
    assert recording.tau[3, 0] == pytest.approx(0.1)
    assert recording.theta[3, 0] == pytest.approx(0.02)


def test_a_file_of_another_format_is_converted(demo_folder: Path) -> None:
    test_python_code_of_the_documentation_runs(ROOT / "docs" / "how-to" / "your-data.md", demo_folder)
    file = demo_folder / "my_beam" / "experiment.toml"
    first = vjm.load_experiment(file).recordings
    file.write_text(file.read_text(encoding="utf-8").replace("first_mode.csv", "export.csv"), encoding="utf-8")
    converted = vjm.load_experiment(file).recordings
    assert [each.file for each in converted] != [each.file for each in first]
    assert [each.markers.tolist() for each in converted] == [each.markers.tolist() for each in first]


def test_every_vjm_command_is_one_that_vjm_takes() -> None:
    found = [*commands(), *commands(TUTORIAL), *commands(YOUR_DATA), *commands(FLEXIFY), *commands(OTHER_TOOLS)]
    lines = [part for line in found for part in line.split(" && ") if part.startswith("vjm ")]
    assert {shlex.split(line)[1] for line in lines} == {
        *("demo", "init", "check", "identify", "diagnose", "simulate", "urdf", "flexify")
    }
    for line in lines:
        parse(shlex.split(line)[1:])


def test_commands_that_make_a_robot_flexible_run(demo_folder: Path) -> None:
    shutil.copy(robot(UR5), demo_folder)
    for line in commands(FLEXIFY):
        assert main(shlex.split(line)[1:]) == 0, line


def test_commands_for_other_tools_run(demo_folder: Path) -> None:
    for line in commands(OTHER_TOOLS):
        assert main(shlex.split(line)[1:]) == 0, line
    for name in ("beam.urdf", "beam.xml", "beam.sdf"):
        assert (demo_folder / name).stat().st_size > 0
    assert (
        "t = 1.0 s: tip at x = "
        in subprocess.run([sys.executable, "beam.py"], check=True, capture_output=True, text=True).stdout
    )


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


# Wordings that engineers do not use, each with the one that took its place.
REPLACED = {
    r"gives? way": "is compliant",
    r"lags? [^.]*behind (its|their) time stamps": "frames are late",
    r"what the model leaves|the model misses": "residual",
    r"times the noise, and no noise": "and correlated",
    r"times (the|its|their) noise\b": "× noise",
    r"noise alone makes any candidate look": "false-alarm probability",
    r"before any cause is named": "symptoms",
    r"by itself, linearised|, by itself\b": "added alone",
    r"would be seen": "detection limit",
    r"[Ll]ikewise in": "also in",
    r"wanders slowly": "low-frequency residual",
    r"would tell both": "would separate the two",
    r"is as right as": "is only as accurate as",
    r"over its whole": "over all",
    r"worst of train": "worst training recording",
    r"hand on the link": "start after release",
    r"[Ee]xternal tone": "sinusoidal disturbance",
    r"\b1 joints\b": "1 joint",
    r"made if need be": "created if missing",
    r"too small for these modes": "frequencies of modes 1 to 3 accurate to 2 % only",
    r"fitted recording repeats": "no two training recordings repeat each other",
    r"[Ss]omething is missing|[Nn]othing is missing": "the model is incomplete",
}


def shown_text(path: Path) -> str:
    """Text of a page, or the strings of a Python file that a user may see: all but docstrings."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return text
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    owners = [node for node in nodes if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
    docstrings = {id(node.body[0].value) for node in owners if node.body and isinstance(node.body[0], ast.Expr)}
    strings = [node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return "\n".join(str(node.value) for node in strings if id(node) not in docstrings)


@pytest.mark.parametrize("folder", ["vjm", "docs", "examples", "README.md"])
def test_terms_are_those_of_engineers(folder: str) -> None:
    place = ROOT / folder
    files = (
        [place] if place.is_file() else [each for kind in ("py", "md", "jinja") for each in place.rglob(f"*.{kind}")]
    )
    texts = {path: " ".join(shown_text(path).split()) for path in files}
    found = [(path.name, words) for path, text in texts.items() for words in REPLACED if re.search(words, text)]
    assert found == []


def test_a_replaced_term_is_found(tmp_path: Path) -> None:
    file = tmp_path / "text.py"
    file.write_text('"""A clamp that gives way."""\nwords = f"a clamp {1} that gives\\nway"\n')
    assert shown_text(file).split() == ["a", "clamp", "that", "gives", "way"]
