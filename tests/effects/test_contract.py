"""What every built-in effect must be."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.effects.setups import LINK, PRESENT, RIG, chain_of, typical_magnitude
from vjm.effects import BUILTIN, Backlash, Effect, GearElasticity, StructuralDamping, TipPayload, magnitude
from vjm.effects.effect import Parameter
from vjm.errors import ShapeError
from vjm.records import Payload, Rig

TABLE = Path(__file__).parents[3] / "shared" / "EFFECTS.md"

every = pytest.mark.parametrize("effect", BUILTIN, ids=lambda effect: effect.id)
every_present = pytest.mark.parametrize("effect", PRESENT, ids=lambda effect: effect.id)


@every_present
def test_coordinate_one_is_a_typical_magnitude(effect: Effect) -> None:
    present = typical_magnitude(effect)
    for parameter in present.parameters:
        if parameter.shape_parameter:
            assert present.values[parameter.name] == pytest.approx(parameter.grid[-1]) or not parameter.grid[1:]
        elif effect.magnitude_count == sum(not other.shape_parameter for other in effect.parameters):
            # The amplitude of a wave has two coordinates.
            off = 0.0 if parameter.reciprocal else parameter.null
            assert present.values[parameter.name] - off == pytest.approx(parameter.typical_magnitude)


@every_present
def test_a_size_at_its_bound_is_told(effect: Effect) -> None:
    present = typical_magnitude(effect)
    assert not any(present.at_bounds)
    for parameter in present.parameters:
        if parameter.shape_parameter or parameter.integer:
            continue
        for value in (parameter.lower, parameter.upper):
            if np.isfinite(value) and value != parameter.null:
                moved = replace(present, **{parameter.name: value})
                sizes = [other.name for other in present.parameters if not (other.shape_parameter or other.integer)]
                assert moved.at_bounds == tuple(name == parameter.name for name in sizes)


POWERS = {  # of length, mass and time
    "": (0, 0, 0),
    "rad": (0, 0, 0),
    "rad/s": (0, 0, -1),
    "per turn": (0, 0, 0),
    "rad/(N m)": (-2, -1, 2),
    "kg": (0, 1, 0),
    "m": (1, 0, 0),
    "1/m": (-1, 0, 0),
    "m^2": (2, 0, 0),
    "1/m^2": (-2, 0, 0),
    "m/s^2": (1, 0, -2),
    "s": (0, 0, 1),
    "1/s": (0, 0, -1),
    "Hz": (0, 0, -1),
    "s/m": (-1, 0, 1),
    "N": (1, 1, -2),
    "N/m": (0, 1, -2),
    "N m": (2, 1, -2),
    "N m/rad": (2, 1, -2),
    "N m s/rad": (2, 1, -1),
    "N s/m^2": (-1, 1, -1),
    "N s^2/m^3": (-2, 1, 0),
}
scales = st.floats(1e-3, 1e3)


def scaled_rig(length: float, mass: float, time: float) -> Rig:
    """RIG in other units."""
    links = [
        replace(
            link,
            length=length * link.length,
            mass=mass * link.mass,
            bending_stiffness=mass * length**3 / time**2 * link.bending_stiffness,
            hub_inertia=mass * length**2 * link.hub_inertia,
            markers=tuple(length * arc for arc in link.markers),
        )
        for link in RIG.links
    ]
    return Rig("scaled", tuple(links))


@settings(max_examples=40)
@given(scales, scales, scales)
def test_typical_magnitudes_scale_with_the_rig(length: float, mass: float, time: float) -> None:
    """Scaling a rig scales all typical magnitudes, bounds and grids by their units, and no coordinate."""
    scaled = scaled_rig(length, mass, time)
    for effect in BUILTIN:
        if effect.id == "in_plane_gravity":  # which is the world's, not the rig's
            continue
        for one, other in zip(effect.variants(RIG, []), effect.variants(scaled, []), strict=True):
            assert other.coordinates == pytest.approx(one.coordinates)
            for before, after in zip(one.parameters, other.parameters, strict=True):
                unit = np.prod(np.power((length, mass, time), POWERS[before.unit]))
                assert after.typical_magnitude == pytest.approx(unit * before.typical_magnitude), (effect.id, before)
                assert (after.lower, after.upper) == pytest.approx((unit * before.lower, unit * before.upper))
                assert after.grid == pytest.approx(unit * np.array(before.grid))


@settings(max_examples=5, deadline=None)
@given(scales, scales, scales, st.booleans())
def test_what_effects_do_scales_with_the_rig(length: float, mass: float, time: float, smooth: bool) -> None:
    """Scaling a rig scales forces, changes of the chain and time steps by their units, with its units and without."""
    torque, rng = mass * length**2 / time**2, np.random.default_rng(1)
    rigs = RIG, scaled_rig(length, mass, time)
    chains = [chain_of(*rig.links, kelvin_voigt=5e-3 * unit) for rig, unit in zip(rigs, (1.0, time), strict=True)]
    for effect, on_rig in product((effect for effect in PRESENT if not effect.sensor), (True, False)):
        present = [replace(typical_magnitude(effect, rig), smooth=smooth) for rig in rigs]
        one, other = present if on_rig else (replace(each, rig_units=None) for each in present)
        before, after = one.chain(chains[0]), other.chain(chains[1])
        q, v = rng.normal(size=(2, before.size)) * [[1.0], [1e-4]]  # rates so low that signs are rounded off
        z = one.initial_states(before, q)
        assert other.initial_states(after, q) == pytest.approx(z)
        angle = np.where(np.arange(before.size) < before.base_size, length, 1.0)  # units of coordinates
        assert after.stiffness == pytest.approx(torque / angle**2 * before.stiffness), effect.id
        assert after.damping == pytest.approx(torque * time / angle**2 * before.damping), effect.id
        assert other.max_step(after) == pytest.approx(time * one.max_step(before)), effect.id
        loads = Payload(0.1, 0.02, 1e-4), Payload(0.1 * mass, 0.02 * length, 1e-4 * mass * length**2)
        for hook, unit in (("force", torque), ("state_rates", 1 / time)):
            functions = [
                getattr(present, hook)(chain, *((payload,) if hook == "force" else ()))
                for present, chain, payload in zip((one, other), (before, after), loads, strict=True)
            ]
            if None not in functions:
                first, second = (f(np.array(0.7 * t), q, v / t, z) for f, t in zip(functions, (1.0, time), strict=True))
                assert second == pytest.approx(unit * first, rel=1e-6, abs=1e-14 * unit), (effect.id, hook)
        first_friction, second_friction = one.dry_friction(before), other.dry_friction(after)
        if first_friction is not None and second_friction is not None:
            joint, largest = first_friction
            assert second_friction[0] == joint
            assert second_friction[1](v[joint] / time) == pytest.approx(torque * largest(v[joint])), effect.id


def test_the_coordinate_of_a_shape_parameter_that_may_be_zero_is_a_power() -> None:
    (absent,) = GearElasticity().variants(Rig("hub", (LINK,)), [])
    damping = absent.parameters[2]
    assert (absent.damping, damping.grid, damping.bounds[0]) == (0.0, (0.0,), 0.0)
    present = absent.at(np.array([0.5, 0.3, 2.0]))
    assert present.damping == 2 * damping.typical_magnitude
    assert present.coordinates == pytest.approx([0.5, 0.3, 2.0])
    assert present.with_softer_joint(2.0).damping == 0.0
    (body,) = TipPayload().variants(Rig("hub", (LINK,)), [])
    radius = body.parameters[1]
    assert (body.radius_of_gyration, radius.bounds[0]) == (0.0, 0.0)
    assert body.at(np.array([0.5, 4.0, 0.0])).radius_of_gyration == pytest.approx(2 * radius.typical_magnitude)
    for offset in (0.6, -0.6):  # an odd power has its sign
        assert body.at(np.array([0.5, 4.0, offset])).offset == pytest.approx(0.05 * offset * LINK.length)
        assert body.at(np.array([0.5, 4.0, offset])).coordinates == pytest.approx([0.5, 4.0, offset])


def test_play_starts_from_hard_and_from_soft_flanks_of_one_damping_ratio() -> None:
    variants = Backlash().variants(Rig("arms", (LINK, replace(LINK, name="other", mass=2 * LINK.mass))), [])
    for link in (0, 1):
        flanks = [(each.flank_stiffness, each.flank_damping) for each in variants if each.link == link]
        stiffness, damping = np.array(flanks).T
        assert stiffness / stiffness[0] == pytest.approx([1.0, 0.1, 0.01])
        assert damping / damping[0] == pytest.approx(np.sqrt(stiffness / stiffness[0]))


def test_coordinates_stay_in_the_rig_s_units() -> None:
    (absent,) = TipPayload().variants(Rig("hub", (LINK,)), [])
    present = absent.at(np.array([2.0, 0.5, 0.0]))
    assert present.mass == pytest.approx(2 * 0.02 * LINK.mass)
    assert present.radius_of_gyration == pytest.approx(0.5**0.5 * 0.05 * LINK.length)
    assert present == TipPayload(present.mass, present.radius_of_gyration, link=0)
    assert present.at(np.array([0.5, 0.0, 0.0])).mass == pytest.approx(0.01 * LINK.mass)
    assert "rig_units" not in repr(present)
    assert TipPayload(0.3).coordinates == pytest.approx(
        [0.3 / 0.02, 0.0, 0.0]
    )  # on no rig: as on one whose units are 1


@dataclass(frozen=True)
class Own(Effect):
    """Whose magnitudes are declared in SI, and in a unit that is none."""

    plain: float = magnitude("N s^7", 0.3, lower=-1.0)
    odd: float = magnitude("furlong", 0.3, in_rig_units=True)


def test_a_user_s_own_magnitude_may_be_plain_and_its_unit_must_be_known() -> None:
    with pytest.raises(ShapeError, match="furlong"):
        _ = Own().variants(RIG, [])[0].parameters
    assert Own().parameters[0].typical_magnitude == 0.3


@pytest.mark.parametrize(
    ("unit", "powers"),
    [
        ("", (0, 0, 0)),
        ("rad", (0, 0, 0)),
        ("1/m^2", (-2, 0, 0)),
        ("N m s^3/rad^3", (2, 1, 1)),
        ("rad/(N m)", (-2, -1, 2)),
        ("N s^2/m^3", (-2, 1, 0)),
    ],
)
def test_units_are_products_of_powers(unit: str, powers: tuple[int, int, int]) -> None:
    """At a rig whose units of length, mass and time are 2 m, 3 kg and 5 s."""
    found = Parameter(unit, 1.0, 0.0, in_rig_units=True).on((2.0, 3.0, 5.0)).typical_magnitude
    assert found == pytest.approx(2.0 ** powers[0] * 3.0 ** powers[1] * 5.0 ** powers[2])


@pytest.mark.parametrize("unit", ["N m^-1", "N m/rad/s", "m^0.5", "N*m", "m^", "N m/", "(N m", "2 m", "per turn"])
def test_a_unit_that_is_written_otherwise_is_refused(unit: str) -> None:
    with pytest.raises(ShapeError, match="unit"):
        _ = Parameter(unit, 1.0, 0.0, in_rig_units=True).on((2.0, 3.0, 5.0))


@every
def test_it_says_what_it_is(effect: Effect) -> None:
    for text in (effect.description, effect.reference, effect.distinguishing_experiment):
        assert len(text) > 20
        assert not text.endswith(".")
    assumed = effect.assumptions.split("; ")
    assert assumed == ["none"] or all(len(each) > 5 and each[-1] not in ".;" for each in assumed)
    assert effect.description[0].islower()
    with pytest.raises(FrozenInstanceError):
        effect.link = 3  # type: ignore[misc]


def test_those_that_a_urdf_can_carry_are_known() -> None:
    of_joints = {"base_compliance", "clamp_compliance", "viscous_friction", "coulomb_friction"}
    carried = {"taper", "tip_payload", "payload_body", "marker_mass", "hub_radius", *of_joints}
    assert {effect.id for effect in BUILTIN if effect.in_urdf} == carried


def test_each_has_an_id_of_its_own() -> None:
    assert len({effect.id for effect in BUILTIN}) == len({type(effect) for effect in BUILTIN}) == len(BUILTIN)


def published() -> dict[str, tuple[str, str]]:
    """Parameters and the table, by id, of each row of the published tables of mechanics, sensors and additions."""
    rows, table = {}, ""
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        table = line.removeprefix("## ") if line.startswith("## ") else table
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.split("|")]
            rows[cells[1].strip("`")] = cells[2], table
    return rows


def described(effect: Effect) -> dict[str, tuple[str, str]]:
    """Unit and null of each parameter, in the published table's words."""
    nulls = {0.0: "0", 1.0: "1", np.inf: "infinite"}
    found = {}
    for parameter in effect.parameters:
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
    rows, built = published(), {effect.id for effect in BUILTIN}
    proposed = {identifier for identifier, (_, table) in rows.items() if table == "Additions"}
    further = {"payload_body", "hub_radius", "camera_tilt", "marker_datum", "marker_mass", "encoder_eccentricity"}
    assert rows.keys() - proposed <= built <= rows.keys() | further
    for effect in (each for each in BUILTIN if each.id in rows):
        parameters, table = rows[effect.id]
        own, listed = described(effect), from_table(parameters)
        assert listed.items() <= own.items(), effect.id
        # What the table takes for granted, such as the motor's share of an inertia, may be a shape parameter.
        assert all(own[name][1] == "" for name in own.keys() - listed.keys()), effect.id
        assert effect.id in proposed or effect.sensor == (table == "Sensors"), effect.id


def test_a_nested_effect_has_no_shape_parameters_that_start_from_zero() -> None:
    payload = TipPayload(mass=0.01, radius_of_gyration=0.05, offset=-0.02).nested()
    assert payload.fixed == ("radius_of_gyration", "offset")
    assert payload.coordinates.size == 1
    moved = payload.at(2 * payload.coordinates)
    assert (moved.mass, moved.radius_of_gyration, moved.offset) == (pytest.approx(0.02), 0.0, 0.0)
    assert moved.fixed == payload.fixed
    assert moved.key == TipPayload().key
    # A spread of losses starts from one, not from none: it stays.
    assert StructuralDamping().nested().fixed == ()
