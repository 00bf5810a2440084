"""The shape of the package: which module may know which, and how big anything may grow."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest

from vjm.effects import BUILTIN

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "vjm"
FRONT = PACKAGE / "__init__.py"  # the public names of all stages up to the report, imported when first used

# The way data flows. A stage may import stages of earlier lines and itself; never one of its own line or a later one.
ORDER = (
    ("errors",),
    ("text",),
    ("files",),
    ("threads",),
    ("experiment",),
    ("records",),
    ("chain",),
    ("markers",),
    ("model",),
    ("effects",),
    ("simulation",),
    ("identification",),
    ("diagnosis",),
    ("report",),
    ("cli",),
    ("__main__",),
)
LEVEL = {stage: level for level, line in enumerate(ORDER) for stage in line}

# The only classes whose methods may import the report: results present themselves, and import it when asked to.
PRESENTED = {("records", "Result"), ("records", "SimulatedResult")}

# What the report may use of the stages that simulate and fit: records, and functions that only read them.
REPORT_READS = {
    "vjm.simulation.model.Model",
    "vjm.simulation.measurement.MarkerArcs",
    "vjm.identification.check.Check",
    "vjm.identification.comparison.Comparison",
    "vjm.identification.check.RecordingOverview",
    "vjm.identification.training_data.PreparedRecording",
}

# Where each heavy library may be imported; a folder stands for all that is in it.
HOMES = {
    "pinocchio": ("model/dynamics.py", "model/flexible.py"),
    "matplotlib": ("report/figures",),
    "pandas": ("experiment",),
    "jinja2": ("experiment", "model", "report"),
    "rich": ("cli", "report/page.py"),
}

LONGEST_MODULE = 600
LONGEST_FUNCTION = 80

MODULES = sorted(PACKAGE.rglob("*.py"))
T = TypeVar("T", bound=ast.AST)
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Import(NamedTuple):
    """One imported name, dotted, whether it is imported for type checking only, and in which class's method if any."""

    name: str
    line: int
    for_types: bool
    method_of: str = ""


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def nodes(kind: type[T]) -> Iterator[tuple[Path, T]]:
    """Every syntax node of one kind in the package."""
    for path in MODULES:
        for node in all_nodes(path):
            if isinstance(node, kind):
                yield path, node


@cache
def all_nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree_of(path)))


def place(path: Path, node: ast.stmt | ast.expr) -> str:
    return f"{path.relative_to(ROOT)}:{node.lineno}"


@cache
def imports(path: Path) -> tuple[Import, ...]:
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[Import]:
    tree = tree_of(path)
    for_types = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test).endswith("TYPE_CHECKING")
        for node in ast.walk(block)
    }
    owners = {
        id(node): owner.name
        for owner in ast.walk(tree)
        if isinstance(owner, ast.ClassDef)
        for method in owner.body
        if isinstance(method, Function)
        for node in ast.walk(method)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno, id(node) in for_types, owners.get(id(node), ""))
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield Import(name, node.lineno, id(node) in for_types, owners.get(id(node), ""))


def turning_back(path: Path, package: Path = PACKAGE) -> list[str]:
    """Imports of a module that do not follow the order."""
    here = path.relative_to(package).with_suffix("").parts[0]
    found = []
    for each in imports(path):
        parts = each.name.split(".")
        if parts[1:2] == ["report"] and (here, each.method_of) in PRESENTED:
            continue
        stage = parts[1] if parts[1:] else "report"  # the last one whose names the front has
        if parts[0] == "vjm" and parts[1:2] != [here] and LEVEL[stage] >= LEVEL[here]:
            found.append(f"{path.relative_to(package)}:{each.line} imports {each.name}")
    return found


def test_every_class_has_a_name_of_its_own() -> None:
    """Two records of one name are two words for one thing, or one word for two."""
    public = [node.name for _, node in nodes(ast.ClassDef) if not node.name.startswith("_")]
    assert sorted({name for name in public if public.count(name) > 1}) == []


def test_every_stage_has_its_place() -> None:
    parts = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in MODULES} - {"__init__"}
    assert parts == set(LEVEL)


def test_imports_follow_the_data() -> None:
    assert [fault for path in MODULES if path != FRONT for fault in turning_back(path)] == []


def test_an_import_that_turns_back_is_found(tmp_path: Path) -> None:
    module = tmp_path / "chain" / "layout.py"
    module.parent.mkdir()
    module.write_text("def f():\n    from vjm import model\n    from vjm.errors import ShapeError\n    import vjm\n")
    assert turning_back(module, tmp_path) == ["chain/layout.py:2 imports vjm.model", "chain/layout.py:4 imports vjm"]


def test_only_methods_of_results_import_the_report(tmp_path: Path) -> None:
    line = "from vjm.report.output import result_page\n"
    texts = [f"class {owner}:\n    def f(self):\n        {line}" for owner in ("Result", "Other")]
    for k, text in enumerate([*texts, line, f"def f():\n    {line}"]):
        module = tmp_path / str(k) / "records.py"
        module.parent.mkdir()
        module.write_text(text)
        assert len(turning_back(module, module.parent)) == (k > 0)


def simulating(path: Path, package: Path = PACKAGE) -> list[str]:
    """Imports and calls of a module of the report that simulate or fit."""
    stages = ("vjm.simulation.", "vjm.identification.", "vjm.diagnosis.")
    records = ("vjm.identification.records.", "vjm.diagnosis.records.", "vjm.diagnosis.symptoms.")
    faults = [
        f"{path.relative_to(package)}:{each.line} imports {each.name}"
        for each in imports(path)
        if each.name.startswith(stages) and not each.name.startswith(records) and each.name not in REPORT_READS
    ]
    calls = [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)]
    methods = [call.func for call in calls if isinstance(call.func, ast.Attribute)]
    forbidden = ("replay", "replays", "simulate", "least_squares", "minimize", "curve_fit")
    called = [method for method in methods if method.attr in forbidden]
    return faults + [f"{path.relative_to(package)}:{method.lineno} calls {method.attr}" for method in called]


def test_the_report_neither_simulates_nor_fits() -> None:
    assert [fault for path in sorted((PACKAGE / "report").rglob("*.py")) for fault in simulating(path)] == []


def test_a_simulation_in_the_report_is_found(tmp_path: Path) -> None:
    module = tmp_path / "page.py"
    name = "simulate_runs"
    module.write_text(f"from vjm.simulation.run import {name}\ndef f(model, recording):\n    model.replay(recording)\n")
    assert simulating(module, tmp_path) == [f"page.py:1 imports vjm.simulation.run.{name}", "page.py:3 calls replay"]


def named_effects(path: Path, package: Path = PACKAGE) -> list[str]:
    """Imports of single effects: all that vjm.effects has beside what every effect is made of."""
    common = {"BUILTIN", "Effect", "effect", "contact"}
    return [
        f"{path.relative_to(package)}:{each.line} imports {each.name}"
        for each in imports(path)
        if each.name.startswith("vjm.effects.") and each.name.split(".")[2] not in common
    ]


def test_no_later_stage_knows_an_effect_by_name() -> None:
    outside = [path for path in MODULES if path != FRONT and PACKAGE / "effects" not in path.parents]
    assert [fault for path in outside for fault in named_effects(path)] == []


def test_an_import_of_a_single_effect_is_found(tmp_path: Path) -> None:
    module = tmp_path / "screen.py"
    module.write_text("from vjm.effects import BUILTIN, TimeOffset\nfrom vjm.effects.loads import TipPayload\n")
    faults = ["screen.py:1 imports vjm.effects.TimeOffset", "screen.py:2 imports vjm.effects.loads.TipPayload"]
    assert named_effects(module, tmp_path) == faults


def test_no_stage_after_the_simulation_names_an_effect_by_its_id() -> None:
    ids = {effect.id for effect in BUILTIN}
    named = [
        f"{place(path, node)}: {node.value}"
        for path, node in nodes(ast.Constant)
        if node.value in ids and LEVEL.get(path.relative_to(PACKAGE).parts[0], 0) > LEVEL["simulation"]
    ]
    assert named == []


@pytest.mark.parametrize("library", HOMES)
def test_libraries_stay_where_they_are_wrapped(library: str) -> None:
    homes = [PACKAGE / home for home in HOMES[library]]
    strangers = [
        f"{path.relative_to(ROOT)}:{each.line}"
        for path in MODULES
        for each in imports(path)
        if each.name.split(".")[0] == library
        and not each.for_types
        and not any(path == home or home in path.parents for home in homes)
    ]
    assert strangers == []


def test_only_the_command_line_prints() -> None:
    calls = [(path, call) for path, call in nodes(ast.Call) if PACKAGE / "cli" not in path.parents]
    assert [place(path, call) for path, call in calls if ast.unparse(call.func) == "print"] == []


def test_recordings_are_cleaned_in_one_place() -> None:
    """Whoever fits or compares models takes `Experiment.cleaned_recordings`."""
    calls = [path for path, call in nodes(ast.Call) if ast.unparse(call.func).split(".")[-1] == "cleaned"]
    assert [path.relative_to(PACKAGE).as_posix() for path in calls] == ["experiment/records.py"]


def test_records_are_frozen() -> None:
    thawed = [
        place(path, node)
        for path, node in nodes(ast.ClassDef)
        for decorator in map(ast.unparse, node.decorator_list)
        if decorator.startswith("dataclass") and "frozen=True" not in decorator
    ]
    assert thawed == []


def test_what_is_public_says_what_it_is() -> None:
    silent = [str(path.relative_to(ROOT)) for path in MODULES if not ast.get_docstring(tree_of(path))]
    for path in MODULES:
        owners: list[ast.Module | ast.ClassDef] = [tree_of(path)]
        for owner in owners:  # grows: public classes are looked into as well
            for node in owner.body:
                if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
                    owners += [node] if isinstance(node, ast.ClassDef) else []
                    silent += [] if ast.get_docstring(node) else [place(path, node)]
    assert silent == []


FRAGMENT = re.compile(r"(Of|The same|What|Where|With|Whether|By|How|As|That|Those|Why|When|So)\b")
NO_VERB = re.compile(r"(The|A|An|In|On|At|For|From|To|All|Each|Every|One|Its?)\b|[(`\d]")


def faulty_docstrings(path: Path) -> list[str]:
    """Docstrings that cannot be read alone, and those of public functions that do not open with a verb."""
    faults = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, Function | ast.ClassDef | ast.Module):
            text = ast.get_docstring(node) or ""
            public = isinstance(node, Function) and not node.name.startswith("_")
            attribute = public and any("property" in ast.unparse(each) for each in node.decorator_list)
            if FRAGMENT.match(text) or (public and not attribute and NO_VERB.match(text)):
                faults.append(f"{path}:{getattr(node, 'lineno', 1)} {text.splitlines()[0]}")
    return faults


def test_docstrings_can_be_read_alone() -> None:
    assert [fault for path in MODULES for fault in faulty_docstrings(path)] == []


def test_a_fragment_is_found(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text(
        '"""Of a module."""\n\ndef area(x):\n    """The square."""\n\ndef _area(x):\n    """Square of x."""\n'
    )
    assert [fault.partition(" ")[2] for fault in faulty_docstrings(module)] == ["Of a module.", "The square."]


def test_nothing_grows_too_long() -> None:
    lines = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    assert {name: count for name, count in lines.items() if count > LONGEST_MODULE} == {}
    for path, node in nodes(ast.FunctionDef):
        assert node.end_lineno is not None
        assert node.end_lineno - node.lineno < LONGEST_FUNCTION, f"{node.name}, {place(path, node)}"


@pytest.mark.parametrize(
    "code",
    [
        "import vjm",
        "from vjm.cli.arguments import parse; parse(['demo'])",
        "import vjm.errors, vjm.records",
    ],
)
def test_heavy_libraries_wait_until_they_are_used(code: str) -> None:
    heavy = {"pinocchio", "scipy", "matplotlib", "pandas", "pydantic", "jinja2", "rich"}
    command = f"import sys\n{code}\nprint(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


# What the verdict of a diagnosis may know: records, none of which simulates or fits.
VERDICT_READS = {"vjm.records", "vjm.effects", "vjm.errors", "vjm.text", "vjm.diagnosis.records"}


def test_the_verdict_reads_fits_and_runs_none() -> None:
    for path in (PACKAGE / "diagnosis" / "verdict.py", PACKAGE / "diagnosis" / "records.py"):
        known = {each.name.rpartition(".")[0] for each in imports(path) if not each.for_types}
        own = {name for name in known if name.split(".")[0] == "vjm"}
        assert own - VERDICT_READS - {"vjm.effects.effect"} == set(), path.name
