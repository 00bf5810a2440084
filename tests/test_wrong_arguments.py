"""Whatever is given for an argument of the public interface, an error of vjm's names the argument."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import vjm
from tests.model.robots import box_beam
from tests.report.diagnoses import nothing
from tests.report.fits import demo_fit
from vjm.errors import VjmError

WRONG: dict[str, Any] = {"None": None, "text": "nonsense", "number": 3, "list": [None], "object": object()}
# Words of an annotation that say that a value of some kind is right.
TAKES = {
    "None": r"\bNone\b|\bAny\b|_Optional|_Gravity",
    "text": r"\bstr\b|\bCoordinates\b|\bAny\b",
    "number": r"\b(int|float|ArrayLike|Any)\b|_Metres|_Payload|_Optional",
    "list": r"\bAny\b",
    "object": r"\bAny\b",
}
# What vjm makes and users only read; errors take any text.
MADE = {"Check", "Comparison", "Diagnosis", "Identification", "Model", "RobotIdentification", "VjmError", "InputError"}
# What is given beside a wrong argument although it need not be.
BESIDE = {
    **{"Link": ("bending_stiffness",), "simulate": ("duration",)},
    "flexify": ("link", "joints", "bending_stiffness", "joint", "stiffness", "rotor_inertia"),
}


@cache
def values() -> dict[str, Any]:
    """Return right values of arguments, by their names; by `OWNER.NAME` where one name has several meanings."""
    fit = demo_fit()
    model, rig, recording = fit.model, fit.model.rig, fit.experiment.recordings[0]
    flexible, link = model.flexible_model(), fit.model.rig.links[0]
    zero = np.zeros(flexible.model.nv)
    time = 0.01 * np.arange(60)
    columns = {"t": time, **{f"{link.name}.m{k}.{axis}": time for k in range(1, 6) for axis in "xy"}}
    return {
        **{"experiment": fit.experiment, "model": model, "fit": fit, "result": fit, "effect": vjm.effects.TipPayload()},
        **{"rig": rig, "links": (link,), "recordings": fit.experiment.recordings, "recording": recording},
        **{"path": "absent", "directory": "absent", "name": fit.parameters[0].name, "simulator": "mujoco"},
        **{"urdf": box_beam(1.0, 1.0, 0.1, 0.1), "link": "bar", "joints": 1, "bending_stiffness": 1.0},
        **dict.fromkeys(("q", "v", "a", "torque", "displacements"), zero),
        **{
            "loads": {flexible.names[0]: np.zeros(3)},
            "frame": flexible.names[0],
            "coordinates": "all",
            "role": "train",
            "kind": "quiet",
        },
        **{"joint": "clamped", "length": 1.0, "mass": 1.0, "time": time, "duration": 0.1, "initial": None},
        **{"Recording.markers": np.zeros((60, 5, 2)), "Rig.name": "rig", "Link.name": "link"},
        **{"Recording.frame": pd.DataFrame(columns), "Link.joint": "clamped", "Experiment.links": (link,)},
        **{"FlexibleModel.model": flexible.model, "FlexibleModel.stiffness": 1.0, "FlexibleModel.joints": None},
        **{
            "Model.simulate.recording": None,
            "flexify.joint": "motor",
            "rotor_inertia": 1.0,
            "stiffness": 1.0,
            "from_urdf.urdf": model.arm.urdf(),
        },
        **{"identify_stiffness.model": flexible, "q_active": np.zeros((60, 0)), "torques": None, "rates": None},
        **{"accelerations": None, "marker_positions_3d": np.zeros((60, 1, 3))},
        **{"identify_stiffness.markers": [(flexible.names[-1], np.zeros(3))]},
    }


def right(owner: str, function: str, name: str) -> Any:
    known = values()
    keys = f"{owner}.{function}.{name}", f"{function}.{name}", f"{owner}.{name}", name
    key = next((key for key in keys if key in known), None)
    assert key is not None, f"give `values` a right value of {owner}.{function}'s argument {name!r}"
    return known[key]


OWNERS = (vjm.Identification, vjm.Diagnosis, vjm.Comparison, vjm.Check, vjm.RobotIdentification, vjm.Model)
OWNERS = (*OWNERS, vjm.FlexibleModel, vjm.Experiment, vjm.Recording, vjm.Rig, vjm.Link)


@cache
def owner_of(kind: type) -> Any:
    """Return an object of a class whose methods users call."""
    fit = demo_fit()
    none = np.empty(0)
    given = {vjm.Diagnosis: nothing, vjm.FlexibleModel: fit.model.flexible_model}
    made: dict[type, Any] = {
        **{vjm.Identification: fit, vjm.Model: fit.model, vjm.Experiment: fit.experiment, vjm.Rig: fit.model.rig},
        **{vjm.Link: fit.model.rig.links[0], vjm.Recording: fit.experiment.recordings[0]},
        vjm.RobotIdentification: vjm.RobotIdentification(
            fit.model.flexible_model(), fit.parameters, fit.covariance, 1.0, none, none, none, none, none, 0.0, 0.0
        ),
        vjm.Comparison: vjm.Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, fit.recordings, ()),
    }
    return given[kind]() if kind in given else made[kind]


def public() -> Iterator[tuple[str, type | None, str]]:
    """Yield the name of every public function or method, its class if it is a method, and an argument."""
    for name in vjm.__all__:
        if callable(getattr(vjm, name)) and name not in MADE:
            yield from ((name, None, argument) for argument in arguments(getattr(vjm, name)))
    for owner in OWNERS:
        for name, method in inspect.getmembers(owner, lambda member: inspect.isroutine(member)):
            if (not name.startswith("_") or name == "__getitem__") and "vjm" in (
                getattr(method, "__module__", "") or ""
            ):
                bound = inspect.ismethod(method)  # a class method
                yield from ((name, owner, argument) for argument in arguments(method)[not bound :])


def arguments(function: Callable[..., Any]) -> list[str]:
    variable = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
    parameters = inspect.signature(function).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind not in variable]


CASES = sorted(public(), key=str)


@pytest.mark.parametrize(("name", "owner", "argument"), CASES, ids=lambda part: getattr(part, "__name__", str(part)))
def test_a_wrong_argument_is_named(
    name: str, owner: type | None, argument: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    place = name if owner is None else owner.__name__
    static = getattr(vjm if owner is None else owner, name)
    function = static if owner is None or inspect.ismethod(static) else getattr(owner_of(owner), name)
    parameters = inspect.signature(function).parameters
    annotation, default = str(parameters[argument].annotation), parameters[argument].default
    needed = [each for each in arguments(function) if parameters[each].default is inspect.Parameter.empty]
    also = {each: right(place, name, each) for each in (*needed, *BESIDE.get(name, ())) if each != argument}
    for kind, wrong in WRONG.items():
        if re.search(TAKES[kind], annotation) or (wrong is None and default is None):
            continue
        with pytest.raises(VjmError, match=rf"\b{argument}\b"):
            function(**also, **{argument: wrong}) if name != "__getitem__" else function(wrong)
    assert not list(tmp_path.iterdir())
