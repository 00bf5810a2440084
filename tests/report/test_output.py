"""A folder is written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.model.urdf_contents import robot_from
from tests.report.fits import demo_fit, pictures_of
from tests.report.schema import IdentifyResult, SimulateResult
from vjm.errors import ShapeError
from vjm.files import FolderError, write_folder
from vjm.identification.comparison import Comparison, compare
from vjm.report import output
from vjm.report.model_json import load_model, read_model
from vjm.report.output import save


@pytest.fixture(autouse=True)
def _drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "identification_pictures", pictures_of)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_folder_holds_everything(tmp_path: Path) -> None:
    fit = demo_fit()
    folder = save(fit, tmp_path / "out")
    names = {path.name for path in folder.iterdir()}
    assert names == {"result.json", "model.json", "model.urdf", "report.html", "figures"}
    IdentifyResult.model_validate_json((folder / "result.json").read_bytes())
    model = load_model(folder / "model.json")
    assert model.chain.stiffness.tolist() == fit.model.chain.stiffness.tolist()
    assert model.rig == fit.model.rig
    assert tuple(robot_from(folder / "model.urdf").actuated_joint_names) == fit.model.chain.joint_names
    assert {path.stem for path in (folder / "figures").iterdir()} == {picture.name for picture in pictures_of(fit)}


def test_what_is_no_result_and_no_path_is_refused(tmp_path: Path) -> None:
    fit = demo_fit()
    for result in (None, fit.experiment, fit.model):
        with pytest.raises(ShapeError, match=r"expected what vjm\.identify"):
            save(result, tmp_path / "out")  # type: ignore[arg-type]
    with pytest.raises(FolderError, match="None: this is no path"):
        save(fit, None)  # type: ignore[arg-type]
    with pytest.raises(FolderError, match="3: this is no path"):
        fit.model.to_urdf(3)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_saved_model_comes_back_with_its_errors(tmp_path: Path) -> None:
    fit = demo_fit()
    model, covariance = read_model(save(fit, tmp_path / "out") / "model.json", fit.experiment)
    assert model.estimates == fit.parameters
    assert covariance.tolist() == fit.covariance.tolist()
    quiet = [each for each in fit.experiment.recordings if each.kind == "quiet"]
    experiment = type(fit.experiment)(fit.experiment.rig, tuple(quiet))
    steps: list[tuple[str, int, int]] = []
    comparison = compare(experiment, model, covariance, lambda *step: steps.append(step))
    folder = save(comparison, tmp_path / "again")
    SimulateResult.model_validate_json((folder / "result.json").read_bytes())
    assert read_model(folder / "model.json")[1].tolist() == covariance.tolist()
    assert steps
    assert isinstance(comparison, Comparison)


def test_other_files_stay_and_old_figures_go(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    for name in ("notes.txt", "figures/mine.png", "figures/tip_4.png", "result.json"):
        (tmp_path / name).write_text("old")
    save(demo_fit(), tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "old"
    assert (tmp_path / "figures" / "mine.png").read_text() == "old"
    assert not (tmp_path / "figures" / "tip_4.png").exists()
    assert json.loads((tmp_path / "result.json").read_text())["schema"] == 1


def failing_replace(at: int, error: BaseException) -> Callable[[Path, Path], None]:
    """`os.replace` that fails at one call, and works again when the steps before are taken back."""
    calls = 0
    real = os.replace

    def replace(source: Path, target: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == at:
            raise error
        real(source, target)

    return replace


@pytest.mark.parametrize("at", range(1, 14))
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_in_the_middle_leaves_the_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int, error: BaseException
) -> None:
    old = {"result.json": b"old", "figures/tip_4.png": b"older", "figures/mine.png": b"mine", "report.html": b"page"}
    (tmp_path / "figures").mkdir()
    for name, data in old.items():
        (tmp_path / name).write_bytes(data)

    names = ("result.json", "report.html", "model.json", "figures/tip_1.png", "figures/fit.png")
    files = dict.fromkeys(names, b"new")
    monkeypatch.setattr("vjm.files.os.replace", failing_replace(at, error))
    expected = FolderError if isinstance(error, OSError) else KeyboardInterrupt
    if at <= 8:  # one stale figure and two old files are set aside, five new ones put in place
        with pytest.raises(expected):
            write_folder(tmp_path, files, ["figures/tip_4.png"])
        assert contents(tmp_path) == old
    else:
        write_folder(tmp_path, files, ["figures/tip_4.png"])
        assert (tmp_path / "report.html").read_text() == "new"
    assert not list(tmp_path.glob(".vjm-*"))


def test_a_failure_while_writing_makes_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("the disk is on fire")

    monkeypatch.setattr(output, "model_text", broken)
    with pytest.raises(RuntimeError, match="on fire"):
        save(demo_fit(), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_failure_while_drawing_touches_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(output, "identification_pictures", broken)
    with pytest.raises(KeyboardInterrupt):
        save(demo_fit(), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_unusable_folders(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for place, words in [(file, "no folder"), (tmp_path / "a" / "b", "does not exist"), (file / "x", "is no folder")]:
        with pytest.raises(FolderError, match=words):
            save(demo_fit(), place)
    (tmp_path / "out" / "result.json").mkdir(parents=True)
    (tmp_path / "out" / "result.json" / "keep").write_text("mine")
    with pytest.raises(FolderError, match="a folder, not a file"):
        save(demo_fit(), tmp_path / "out")
    assert contents(tmp_path / "out") == {"result.json/keep": b"mine"}
