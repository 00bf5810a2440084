"""The shape of the package: which module may know which, and how big anything may grow."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "vjm"

# The way data flows. A stage may import stages of earlier lines and itself; never one of its own line or a later one.
ORDER = (
    ("errors", "parameters"),
    ("files",),
    ("experiment",),
    ("chain", "shape", "derivatives", "noise", "spectrum"),
    ("angles",),
    ("urdf", "model_file", "dynamics"),
    ("modes", "torque"),
    ("simulate",),
    ("model",),
    ("identification",),
    ("checking",),
    ("result+report",),
    ("cli",),
    ("__main__",),
)
# One stage in two places: what is written as JSON and what is written for people.
JOINED = {"result": "result+report", "report": "result+report"}
LEVEL = {stage: level for level, line in enumerate(ORDER) for stage in line}

# Where each heavy library may be imported; a folder stands for all that is in it.
HOMES = {
    "pinocchio": ("dynamics.py",),
    "matplotlib": ("report/figures",),
    "pandas": ("experiment",),
    "jinja2": ("urdf", "report"),
    "yourdfpy": ("urdf",),
    "rich": ("cli",),
}

LONGEST_MODULE = 300
LONGEST_FUNCTION = 60

MODULES = sorted(PACKAGE.rglob("*.py"))
NAMES = [str(path.relative_to(PACKAGE)) for path in MODULES]
each_module = pytest.mark.parametrize("path", MODULES, ids=NAMES)


class Import(NamedTuple):
    """One imported module, dotted, and whether it is imported for type checking only."""

    module: str
    line: int
    for_types: bool


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imports(path: Path) -> Iterator[Import]:
    tree = tree_of(path)
    for_types = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test).endswith("TYPE_CHECKING")
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno, id(node) in for_types)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            for alias in node.names:
                yield Import(f"{node.module}.{alias.name}", node.lineno, id(node) in for_types)


def stage_of(part: str) -> str:
    return JOINED.get(part, part)


def own_stage(path: Path) -> str:
    return stage_of(path.relative_to(PACKAGE).with_suffix("").parts[0])


def turning_back(path: Path) -> list[str]:
    """Imports of a module that do not follow the order."""
    here, found = own_stage(path), []
    for each in imports(path):
        parts = each.module.split(".")
        if parts[0] == "vjm" and stage_of(parts[1]) != here and LEVEL[stage_of(parts[1])] >= LEVEL[here]:
            found.append(f"line {each.line}: {here} imports {each.module}")
    return found


def test_every_stage_has_its_place() -> None:
    parts = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in MODULES} - {"__init__"}
    assert {stage_of(part) for part in parts} == set(LEVEL)


@pytest.mark.parametrize("path", [path for path in MODULES if path.parent != PACKAGE or path.name != "__init__.py"])
def test_imports_follow_the_data(path: Path) -> None:
    assert turning_back(path) == []


def test_an_import_that_turns_back_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    folder = tmp_path / "chain"
    folder.mkdir()
    module = folder / "layout.py"
    module.write_text("def f():\n    from vjm import dynamics\n    from vjm.errors import ShapeError\n")
    assert turning_back(module) == ["line 2: chain imports vjm.dynamics"]


@pytest.mark.parametrize("library", HOMES)
def test_libraries_stay_where_they_are_wrapped(library: str) -> None:
    homes = [PACKAGE / home for home in HOMES[library]]
    strangers = [
        f"{path.relative_to(PACKAGE)}:{each.line}"
        for path in MODULES
        for each in imports(path)
        if each.module.split(".")[0] == library
        and not each.for_types
        and not any(path == home or home in path.parents for home in homes)
    ]
    assert strangers == []


@each_module
def test_only_the_command_line_prints(path: Path) -> None:
    calls = [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)]
    printing = [call.lineno for call in calls if isinstance(call.func, ast.Name) and call.func.id == "print"]
    assert not printing or own_stage(path) == "cli", f"lines {printing}"


@each_module
def test_records_are_frozen(path: Path) -> None:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ClassDef):
            decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
            for decorator in decorators:
                assert not decorator.startswith("dataclass") or "frozen=True" in decorator, node.name


@each_module
def test_what_is_public_says_what_it_is(path: Path) -> None:
    tree = tree_of(path)
    assert ast.get_docstring(tree), "the module"
    owners: list[ast.Module | ast.ClassDef] = [tree]
    for owner in owners:
        for node in owner.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{node.name}, line {node.lineno}"
                owners += [node] if isinstance(node, ast.ClassDef) else []


@each_module
def test_nothing_grows_too_long(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST_MODULE
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno is not None
            length = node.end_lineno - node.lineno + 1
            assert length <= LONGEST_FUNCTION, f"{node.name} has {length} lines"


@pytest.mark.parametrize(
    "code",
    [
        "import vjm",
        "import vjm.cli; vjm.cli.parse(['demo'])",
        "import vjm.errors, vjm.parameters, vjm.experiment.records",
    ],
)
def test_heavy_libraries_wait_until_they_are_used(code: str) -> None:
    heavy = {"pinocchio", "scipy", "matplotlib", "pandas", "pydantic", "jinja2", "yourdfpy", "rich"}
    command = f"import sys\n{code}\nprint(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
