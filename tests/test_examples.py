"""Every example runs as a user would run it, in a folder of its own, and what it prints and writes is right."""

from __future__ import annotations

import re
import runpy
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.model.chains import model_of, write_model
from tests.model.robots import UR5, robot
from tests.model.urdf_contents import springs_from
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.model.modes import modes
from vjm.records import Link

EXAMPLES = Path(__file__).parents[1] / "examples"
CONTROL = (EXAMPLES.parent / "docs" / "how-to" / "control.md").read_text(encoding="utf-8")
PNG = b"\x89PNG"


class Runner:
    """Runs examples in the current folder, and gives what they print."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, name: str, *arguments: str) -> str:
        self.monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return self.capsys.readouterr().out


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Runner:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLES)  # as Python does for a script: some import others
    return Runner(monkeypatch, capsys)


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.\d+(?:e[+-]\d+)?", text)]


def quoted(example: str) -> list[float]:
    """The numbers that the page on control gives as an example's result."""
    (row,) = [line for line in CONTROL.splitlines() if line.startswith(f"| `{example}`")]
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", row.split("|")[3])]


def test_every_example_is_tested() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    assert [path.name for path in EXAMPLES.glob("*.py") if f'run("{path.name}"' not in here] == []


def test_identify_and_plot(run: Runner, tmp_path: Path) -> None:
    said = run("identify_and_plot.py")
    assert said.startswith("stainless steel beam, clamped: converged")
    value, error = numbers(next(line for line in said.splitlines() if "bending_stiffness" in line))
    assert value == pytest.approx(1.973629, rel=0.01)  # the truth behind the demo
    assert 0 < error < 0.02
    assert (tmp_path / "tip.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("joint", ["clamped", "revolute"])
def test_urdf_in_pinocchio(run: Runner, tmp_path: Path, joint: str) -> None:
    link = Link("beam", joint, 1.0, 0.44, 1.9, (1.0,), hub_inertia=0.02 if joint == "revolute" else 0.0)  # type: ignore[arg-type]
    chain = Chain("one beam", (uniform_chain(link, layout(1.0, 4), kelvin_voigt=3e-4),), gravity=(0.0, 0.0))
    (tmp_path / "vjm-out").mkdir()
    write_model(model_of(chain), tmp_path / "vjm-out" / "model.json")
    swinging, linearised = numbers(run("urdf_in_pinocchio.py").splitlines()[-1])
    assert swinging == pytest.approx(linearised, rel=1e-3)
    assert linearised == pytest.approx(modes(chain).frequencies[0], rel=1e-4)
    assert [*springs_from(tmp_path / "arm.urdf").values()] == chain.stiffness[chain.passive].tolist()


def test_two_links(run: Runner, tmp_path: Path) -> None:
    said = run("two_links.py")
    frequencies = numbers(said.splitlines()[0])
    assert len(frequencies) == 4
    assert frequencies == sorted(frequencies)
    assert (tmp_path / "two_links.png").read_bytes().startswith(PNG)


def test_own_experiment(run: Runner, tmp_path: Path) -> None:
    said = run("own_experiment.py", "lab")
    assert "Cause found: unknown mass of 12." in said
    assert "Residual is consistent with noise" in said
    # The example's beam solver is its own; a quarter of a percent allows for discretization and four standard errors.
    # Three of a mass whose centre may be anywhere about the tip are 7 %.
    found = {name: numbers(text)[0] for name, _, text in (line.partition(" = ") for line in said.splitlines()) if text}
    assert found["mass"] == pytest.approx(0.012, rel=0.07)
    assert found["beam.bending_stiffness"] == pytest.approx(1.62, rel=0.0025)
    assert said.rstrip().endswith("vjm diagnose lab/experiment.toml")
    experiment = vjm.load_experiment(tmp_path / "lab" / "experiment.toml")
    assert [each.role for each in experiment.recordings] == ["train", "train", "holdout"]
    recording = experiment.recordings[0]
    frames = recording.markers[np.isfinite(recording.markers[:, 0, 0])]
    assert np.isnan(frames).any(axis=(0, 2)).tolist() == [False, False, True, False]
    assert np.isnan(frames[:, 2, 0]).sum() == 3


def test_hub_arm(run: Runner, tmp_path: Path) -> None:
    value, error = numbers(run("hub_arm.py"))[:2]
    assert value == pytest.approx(2.4, rel=0.01)  # the truth behind it
    assert 0 < error < 0.02
    assert (tmp_path / "hub_arm.png").read_bytes().startswith(PNG)


def test_lqr(run: Runner, tmp_path: Path) -> None:
    """On the identified model it leaves a tenth of the vibration that the rigid model's leaves, on the true arm."""
    pytest.importorskip("control")
    rigid, flexible, less = numbers(run("lqr.py"))
    assert less > 90
    assert less == pytest.approx(100 * (1 - flexible / rigid), abs=0.1)
    assert quoted("lqr.py") == pytest.approx([flexible, rigid, less], rel=0.02)
    assert (tmp_path / "lqr.png").read_bytes().startswith(PNG)


def test_input_shaping(run: Runner, tmp_path: Path) -> None:
    said = run("input_shaping.py")
    plain, slow, shaped, less = numbers("\n".join(said.splitlines()[1:]))
    assert shaped < 0.01 * slow < 0.01 * plain
    assert less > 99.9
    assert quoted("input_shaping.py") == pytest.approx([plain, shaped, slow], rel=0.05, abs=0.011)  # the last digit
    assert (tmp_path / "input_shaping.png").read_bytes().startswith(PNG)


def test_kalman_filter(run: Runner, tmp_path: Path) -> None:
    """Seven runs of it have 93 to 96 % inside and 6.5 to 9.8 of 8: errors of neighbouring steps are correlated."""
    said = run("kalman_filter.py").splitlines()
    assert numbers(said[0])[1] == pytest.approx(95, abs=2.5)
    assert numbers(said[1])[0] == pytest.approx(8, abs=2)
    error = numbers(said[2])[0]
    assert quoted("kalman_filter.py")[:2] == pytest.approx([error, numbers(said[0])[1]], rel=0.02)
    assert (tmp_path / "kalman_filter.png").read_bytes().startswith(PNG)


def test_ur5_slew(run: Runner, tmp_path: Path) -> None:
    plain, shaped = numbers(run("ur5_slew.py", str(robot(UR5))).splitlines()[-1])
    assert shaped < 0.01 * plain
    assert quoted("ur5_slew.py") == pytest.approx([shaped, plain], abs=0.06)
    assert (tmp_path / "ur5_slew.png").read_bytes().startswith(PNG)


def test_ur5_slew_says_what_it_lacks(run: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", absent)
    with pytest.raises(SystemExit, match="needs a URDF of the UR5: pip install example-robot-data"):
        run("ur5_slew.py")


def test_identify_robot(run: Runner, tmp_path: Path) -> None:
    *lines, errors = run("identify_robot.py", str(robot(UR5))).splitlines()
    stiffness, damping = numbers(errors)
    assert stiffness < 1  # %
    assert damping < 7  # three standard errors of the least certain one
    page = (EXAMPLES.parent / "docs" / "how-to" / "identify-robot.md").read_text(encoding="utf-8")
    said = [numbers(line)[0] for line in page.splitlines() if line.startswith("forearm_link.")]
    assert [numbers(line)[0] for line in lines] == pytest.approx(said, rel=1e-2)
    assert (tmp_path / "identify_robot.png").read_bytes().startswith(PNG)


def test_viewer(run: Runner, tmp_path: Path) -> None:
    """Its file holds the animation; no browser is opened."""
    pytest.importorskip("meshcat")
    link = Link("beam", "revolute", 1.0, 0.44, 1.9, (1.0,), hub_inertia=0.02)
    chain = Chain("one beam", (uniform_chain(link, layout(1.0, 4), kelvin_voigt=3e-4),), gravity=(0.0, 0.0))
    (tmp_path / "vjm-out").mkdir()
    write_model(model_of(chain), tmp_path / "vjm-out" / "model.json")
    assert "201 frames" in run("viewer.py")
    page = (tmp_path / "arm.html").read_text(encoding="utf-8")
    assert "</html>" in page
    assert len(page) > 1_000_000  # with the viewer and the motion inside
