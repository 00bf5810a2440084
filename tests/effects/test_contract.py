"""What every built-in effect must be."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.effects.setups import PRESENT, RIG, chain_of, draw_from, recording_of, typical_magnitude
from tests.model.chains import contents
from vjm.effects import BUILTIN, Effect, by_id
from vjm.errors import ChoiceError
from vjm.records import Recording

TABLE = Path(__file__).parents[3] / "shared" / "EFFECTS.md"
CHAIN = chain_of(*RIG.links)

every = pytest.mark.parametrize("effect", BUILTIN, ids=lambda effect: effect.id)
every_present = pytest.mark.parametrize("effect", PRESENT, ids=lambda effect: effect.id)


def stored(recording: Recording) -> list[object]:
    return [deepcopy(getattr(recording, field.name)) for field in fields(recording)]


@every
def test_absent_it_changes_nothing_at_all(effect: Effect) -> None:
    recording, draw = recording_of(RIG), draw_from(1)
    time, positions, headings, theta, q = draw((5,)), draw((5, 6, 2)), draw((5, 6)), draw((5, 2)), draw((3, CHAIN.size))
    for absent in (effect, *effect.variants(RIG, [recording])):
        assert absent.is_null
        assert absent.chain(CHAIN) is CHAIN
        assert absent.true_inputs(recording) is recording
        assert absent.force(CHAIN, 0.1) is None
        assert absent.state_rates(CHAIN) is None
        assert absent.rate_independent_update(CHAIN) is None
        assert absent.state_count(CHAIN) == 0
        assert absent.initial_states(CHAIN, q).shape == (3, 0)
        assert absent.max_step == np.inf
        assert absent.camera_instants(time, positions) is time
        assert absent.marker_positions(positions, headings) is positions
        assert absent.encoder_angles(theta) is theta


@every_present
def test_present_it_changes_something_and_leaves_what_it_is_given_alone(effect: Effect) -> None:
    present, recording, draw = typical_magnitude(effect), recording_of(RIG), draw_from(2)
    assert not present.is_null
    given = [draw((5,)), draw((5, 6, 2)), draw((5, 6)), draw((5, 2))]
    time, positions, headings, theta = given
    kept, chain_before, recording_before = deepcopy(given), contents(CHAIN), stored(recording)
    changed = [
        present.chain(CHAIN) is not CHAIN,
        present.true_inputs(recording) is not recording,
        present.force(CHAIN, 0.1) is not None,
        present.camera_instants(time, positions) is not time,
        present.marker_positions(positions, headings) is not positions,
        present.encoder_angles(theta) is not theta,
    ]
    assert any(changed)
    assert not any(changed[3:]) or present.sensor
    assert not any(changed[:3]) or not present.sensor
    for before, now in zip(kept, given, strict=True):
        assert_array_equal(now, before)
    assert contents(CHAIN) == chain_before
    for before, now in zip(recording_before, stored(recording), strict=True):
        assert_array_equal(now, before)


@every_present
@pytest.mark.parametrize("leading", [(), (6,), (3, 6)])
def test_forces_and_rates_take_any_leading_axes(effect: Effect, leading: tuple[int, ...]) -> None:
    present = typical_magnitude(effect)
    chain, draw = present.chain(CHAIN), draw_from(3, 0.1)
    time, q, v = draw(leading), draw((*leading, chain.size)), draw((*leading, chain.size))
    z = present.initial_states(chain, q)
    assert z.shape == (*leading, present.state_count(chain))
    z = z + draw(z.shape)
    motions = ((present.force(chain, 0.1), q.shape), (present.state_rates(chain), z.shape))
    for motion, shape in motions:
        if motion is None:
            continue
        given = deepcopy((time, q, v, z))
        found = motion(time, q, v, z)
        assert found.shape == shape
        assert all((now == before).all() for now, before in zip((time, q, v, z), given, strict=True))
        for index in np.ndindex(leading):
            alone = motion(time[index], q[index], v[index], z[index])
            assert alone == pytest.approx(found[index], rel=1e-12, abs=1e-14)
    told = [each is not None for each in (present.state_rates(chain), present.rate_independent_update(chain))]
    assert sum(told) == (present.state_count(chain) > 0)


@every_present
def test_coordinates_and_values_belong_together(effect: Effect) -> None:
    rng = np.random.default_rng(4)
    for absent in effect.variants(RIG, []):
        assert absent.coordinates[: absent.magnitude_count] == pytest.approx(0)
        assert absent.at(absent.coordinates).is_null
        lower, upper = absent.bounds
        assert lower.shape == upper.shape == absent.coordinates.shape
        assert (lower < upper).all()
        wanted = np.clip(rng.uniform(0.1, 2.0, absent.coordinates.size), lower, upper)
        present = absent.at(wanted)
        assert present.coordinates == pytest.approx(wanted)
        assert (present.link, type(present)) == (absent.link, type(absent))
        again = replace(absent, **present.values)
        assert again == present
        for parameter in present.parameters():
            assert parameter.lower <= present.values[parameter.name] <= parameter.upper


@every_present
def test_coordinate_one_is_an_everyday_size(effect: Effect) -> None:
    present = typical_magnitude(effect)
    for parameter in present.parameters():
        if parameter.shape_parameter:
            assert present.values[parameter.name] == pytest.approx(parameter.grid[-1]) or not parameter.grid[1:]
        elif effect.id != "external_tone":  # whose amplitude has two coordinates
            off = 0.0 if parameter.reciprocal else parameter.null
            assert present.values[parameter.name] - off == pytest.approx(parameter.typical_magnitude)


@every
def test_it_says_what_it_is(effect: Effect) -> None:
    for text in (effect.description, effect.reference, effect.distinguishing_experiment):
        assert len(text) > 20
        assert not text.endswith(".")
    assert effect.description[0].islower()
    with pytest.raises(FrozenInstanceError):
        effect.link = 3  # type: ignore[misc]


def test_those_that_a_urdf_can_carry_are_known() -> None:
    carried = {"tip_payload", "viscous_friction", "coulomb_friction", "clamp_compliance"}
    assert {effect.id for effect in BUILTIN if effect.in_urdf} == carried


def test_each_has_an_id_of_its_own_by_which_it_is_found() -> None:
    assert [by_id(effect.id) for effect in BUILTIN] == list(BUILTIN)
    assert len({effect.id for effect in BUILTIN}) == len({type(effect) for effect in BUILTIN}) == len(BUILTIN) == 28
    with pytest.raises(ChoiceError, match="unknown effect 'ghost'"):
        by_id("ghost")


def published() -> list[tuple[str, str, bool]]:
    """Id, parameters and whether it is a sensor's, of each row of the published tables of mechanics and sensors."""
    rows, sensor = [], False
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## Additions"):  # candidates that are proposed, not built in
            break
        sensor |= line.startswith("## Sensors")
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.split("|")]
            rows.append((cells[1].strip("`"), cells[2], sensor))
    return rows


def described(effect: Effect) -> dict[str, tuple[str, str]]:
    """Unit and null of each parameter, in the published table's words."""
    nulls = {0.0: "0", 1.0: "1", np.inf: "infinite"}
    found = {}
    for parameter in effect.parameters():
        unit = "index" if parameter.integer else parameter.unit or "-"
        found[parameter.name] = (unit, "" if parameter.shape_parameter else nulls[parameter.null])
    return found


def from_table(text: str) -> dict[str, tuple[str, str]]:
    """The same from a cell as `gx, gy (m/s^2; 0)` or `ratio (-; 0), time_constant (s)`."""
    found: dict[str, tuple[str, str]] = {}
    names: list[str] = []
    rest = text if text != "-" else ""
    while rest:
        head, _, tail = rest.partition(" (")
        names = [name.strip() for name in head.strip(", ").split(",")]
        depth, stop = 1, 0
        while depth:
            depth += {"(": 1, ")": -1}.get(tail[stop], 0)
            stop += 1
        unit, _, null = tail[: stop - 1].partition(";")
        found |= {name: (unit.strip(), null.strip()) for name in names}
        rest = tail[stop:]
    return found


@pytest.mark.skipif(not TABLE.exists(), reason="the published table is not here")
def test_ids_parameters_units_and_nulls_are_the_published_ones() -> None:
    rows = published()
    assert [identifier for identifier, _, _ in rows] == [effect.id for effect in BUILTIN]
    for (_, parameters, sensor), effect in zip(rows, BUILTIN, strict=True):
        assert described(effect) == from_table(parameters), effect.id
        assert effect.sensor == sensor, effect.id
