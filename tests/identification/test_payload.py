"""A known body on the tip of a continuous beam: its mass alone does not say how the beam moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

import vjm
from tests.hidden.rigs import write_hidden
from tests.hidden.settings import setting_of
from tests.hidden.severities import Planted
from vjm.records import Experiment

MASS, RADIUS, OFFSET, SEED = 0.05, 0.03, 0.01, 2
BODY = {"payload": MASS, "payload_offset": OFFSET, "payload_inertia": MASS * RADIUS**2}


@cache
def loaded() -> Experiment:
    """Three recordings of a beam with the body on its tip, which the rig lacks."""
    planted = Planted("tip_payload", {"mass": MASS, "radius_of_gyration": RADIUS, "offset": OFFSET})
    with TemporaryDirectory() as folder:
        write_hidden(Path(folder), "hub", [planted], SEED)
        experiment = vjm.load_experiment(Path(folder) / "experiment.toml")
    bare = [each for each in experiment.recordings if each.kind == "driven" and not each.payload]
    (link,) = experiment.rig.links
    rig = replace(experiment.rig, links=(replace(link, virtual_joints=24),))  # no discretization error that shows
    return Experiment(rig, tuple(bare[:3]))


def on_the_link(body: dict[str, float]) -> Experiment:
    """The body is the link's, as that of every recording."""
    (link,) = loaded().rig.links
    return Experiment(replace(loaded().rig, links=(replace(link, **body),)), loaded().recordings)


def in_each_recording(body: dict[str, float]) -> Experiment:
    return Experiment(loaded().rig, tuple(replace(each, **body) for each in loaded().recordings))


@pytest.mark.parametrize("place", [on_the_link, in_each_recording])
def test_a_known_body_is_taken_into_account(place: Callable[[dict[str, float]], Experiment]) -> None:
    """With its mass alone the model leaves more than noise, and the stiffness is thirteen standard errors off."""
    truth = setting_of("hub", SEED).beam.bending_stiffness
    whole, point = (vjm.identify(place(body), baselines=False) for body in (BODY, {"payload": MASS}))
    off = []
    for fit in (whole, point):
        stiffness = fit["beam.bending_stiffness"]
        assert stiffness.error is not None
        off.append(abs(stiffness.value - truth) / stiffness.error)
    assert off[0] < 3
    assert off[1] > 5
    assert whole.trajectory is not None
    assert point.trajectory is not None
    assert whole.trajectory.chi2 < whole.trajectory.point.noise_limit < 0.8 * point.trajectory.chi2


def test_a_body_without_mass_is_refused() -> None:
    for record, changes in (
        (loaded().rig.links[0], {"payload_offset": 0.01}),
        (loaded().recordings[0], {"payload_inertia": 1e-5}),
    ):
        with pytest.raises(vjm.VjmError, match="given without a payload"):
            replace(record, **changes)
    with pytest.raises(vjm.VjmError, match="payload_inertia"):
        replace(loaded().recordings[0], payload=0.1, payload_inertia=-1e-5)
