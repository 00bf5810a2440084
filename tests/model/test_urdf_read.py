"""Reading URDF back: exactly, or with an error that names the file and the fault."""

from __future__ import annotations

from pathlib import Path

import pytest
import yourdfpy
from hypothesis import given, settings

from tests.model.chains import HOSTILE, chains, contents, extended_chain, plain_chain, plain_link
from vjm.chain.virtual_links import Chain
from vjm.errors import ModelFileError
from vjm.model.urdf import chain_to_urdf
from vjm.model.urdf_reader import chain_from_urdf, check_urdf, friction_from_urdf


def one_link() -> str:
    return chain_to_urdf(Chain("arm", (plain_link(),), (0.0, -9.81)))


def saved(folder: Path, text: str) -> Path:
    file = folder / "arm.urdf"
    file.write_text(text, encoding="utf-8")
    return file


@settings(deadline=None)
@given(chains())
def test_a_chain_comes_back_to_the_last_bit(chain: Chain) -> None:
    assert contents(chain_from_urdf(chain_to_urdf(chain))) == contents(chain)


def test_a_file_is_read_by_path_or_by_name(tmp_path: Path) -> None:
    file = saved(tmp_path, chain_to_urdf(plain_chain()))
    assert contents(chain_from_urdf(file)) == contents(plain_chain())
    assert contents(chain_from_urdf(str(file))) == contents(plain_chain())


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_other_encodings_of_the_file_are_understood(tmp_path: Path, encoding: str) -> None:
    text = chain_to_urdf(Chain(HOSTILE, (plain_link(HOSTILE),)))
    file = tmp_path / "arm.urdf"
    file.write_bytes(text.replace('"UTF-8"', f'"{encoding.removesuffix("-sig")}"').encode(encoding))
    assert chain_from_urdf(file).links[0].name == HOSTILE


def test_edits_in_standard_elements_count() -> None:
    text = one_link().replace('<mass value="0.15"/>', '<mass value="0.5"/>').replace('damping="0.002"', 'damping="9"')
    link = chain_from_urdf(text).links[0]
    assert link.masses.tolist() == [0.1, 0.5, 0.19]
    assert link.damping.tolist() == [9.0, 0.003]


def test_damping_and_friction_at_an_active_joint_count() -> None:
    dynamics = '<dynamics damping="0.3" friction="0.02"/>'
    text = one_link().replace('<axis xyz="0 0 1"/>', f'<axis xyz="0 0 1"/>{dynamics}', 1)
    assert chain_from_urdf(text).links[0].joint_damping == 0.3
    assert friction_from_urdf(text) == {"beam": 0.02}
    assert friction_from_urdf(one_link()) == {}


def test_friction_comes_back_beside_the_chain() -> None:
    two = Chain("arm", (*extended_chain().links, plain_link("hand")))
    for friction in ({"beam": 0.1 + 0.2, "hand": 1e-3}, {"hand": 1e-3}, {"beam": 0.0}, {}):
        text = chain_to_urdf(two, friction)
        assert friction_from_urdf(text) == {name: value for name, value in friction.items() if value}
        assert contents(chain_from_urdf(text)) == contents(two)


HUB = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.02"/>'


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('rest_curvature="-0.2"', 'rest_curvature="-0.3"', "'beam_virtual_1' is off the line or turned"),
        ('rpy="0 0 -0.066"', 'rpy="0 0 0"', "'beam_virtual_1' is off the line or turned by 0.0; .*-0.066"),
        ('rpy="0 0 -0.066"', 'rpy="0 0.1 -0.066"', "off the line or turned"),
        ('rest_curvature="-0.2"', 'rest_curvature="inf"', "a finite number"),
        ('root_inertia="0.004"', 'root_inertia="0.005"', "first_inertia [+] root_inertia"),
        ('joint_stiffness="0.05"', 'joint_stiffness="-0.05"', "zero or a positive number"),
        (HUB, HUB.replace("0.02", "0.03"), "izz of 'beam_hub' is 0.03; expected hub_inertia"),
        ('root_joint name="beam_root"', 'root_joint name="beam_tip_mount"', "'beam_root'"),
        ('root_joint name="beam_root"', 'root_joint name="other"', "no joint 'other'"),
        ('stiffness="60.0"/>', 'stiffness="60.0" damping="1"/>', "unknown attribute damping"),
        ('<joint name="beam_root" type="revolute">', '<joint name="beam_root" type="fixed">', "expected revolute"),
        ('<vjm:root_joint name="beam_root" stiffness="60.0"/>', "", "first_inertia [+] hub_inertia"),
        ('damping="0.07" friction="0"', 'damping="0.07" friction="0.1"', "'beam_root' has friction"),
    ],
)
def test_faults_at_extended_chains_are_found(tmp_path: Path, old: str, new: str, fault: str) -> None:
    text = chain_to_urdf(extended_chain())
    assert text.count(old) == 1
    with pytest.raises(ModelFileError, match=fault):
        chain_from_urdf(saved(tmp_path, text.replace(old, new)))


def test_elements_of_other_programs_are_passed_over() -> None:
    text = one_link().replace("</robot>", "<gazebo/><transmission name='x'/><!-- by hand --></robot>")
    assert contents(chain_from_urdf(text)) == contents(Chain("arm", (plain_link(),), (0.0, -9.81)))


GRIPPER = '<joint name="g" type="fixed"><parent link="beam_tip"/><child link="gripper"/></joint><link name="gripper"/>'
ACTIVE = '<joint name="beam_joint" type="continuous">\n    <origin xyz="0.0 0 0"'
INERTIA = 'ixx="1" iyy="1" izz="1"'


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("</robot>", "", "no well-formed XML"),
        ('encoding="UTF-8"', 'encoding="UTF-77"', "no well-formed XML"),
        ("robot", "sdf", "root element is <sdf>"),
        ('<robot name="arm">', "<robot>", "<robot> has no name"),
        ("urn:vjm:urdf", "urn:else", "0 elements <vjm:model>"),
        ('schema="1"', 'schema="2"', "schema 2; expected schema 1"),
        ('gravity="0.0 -9.81"', 'gravity="0.0"', "2 finite numbers"),
        ('gravity="0.0 -9.81"', 'gravity="0.0 nan"', "2 finite numbers"),
        ('stiffness="8.0"', "", "'beam_virtual_1' has no stiffness"),
        ('stiffness="8.0"', 'stiffness="stiff"', "'beam_virtual_1': stiffness is 'stiff'; expected a finite number"),
        ('stiffness="8.0"', 'stiffness="inf"', "stiffness is 'inf'"),
        ('stiffness="8.0"', 'stiffness="-1"', "zero or a positive number"),
        ('cell="0.33"', 'cell="0"', "beam.cells"),
        (' width="0.035"', ' widht="0.035"', "unknown attribute widht"),
        ('distal="free"', 'distal="loose"', "free or joined"),
        ('hub_inertia="0.02"', 'hub_inertia="0.03"', "first_inertia [+] hub_inertia"),
        ('<mass value="0.1"/>', "", "0 elements <mass>"),
        ('<mass value="0.1"/>', '<mass value="-0.1"/>', "zero or a positive number"),
        ('xyz="0.3 0 0"', 'xyz="-0.3 0 0"', "beam.lengths"),
        ('xyz="0.3 0 0"', 'xyz="0.3 0.1 0"', "off the line"),
        ('xyz="0.3 0 0" rpy="0 0 0"', 'xyz="0.3 0 0" rpy="0 1 0"', "off the line"),
        ('xyz="0.3 0 0"', 'xyz="0.3 0"', "3 finite numbers"),
        ('type="continuous"', 'type="prismatic"', "continuous or fixed"),
        ('type="revolute"', 'type="prismatic"', "beam_virtual_1.*expected revolute"),
        ('axis xyz="0 0 1"', 'axis xyz="0 1 0"', "another axis"),
        (ACTIVE, ACTIVE.replace("0.0", "0.1"), "'beam_joint' is at x = 0.1; expected x = 0.0"),
        ('friction="0"', 'friction="0.1"', "has friction"),
        ('<link name="beam_virtual_1_link">', '<link name="other">', "no link 'beam_virtual_1_link'"),
        ('<joint name="beam_virtual_2"', '<joint name="beam_virtual_1"', "two elements <joint> 'beam_virtual_1'"),
        ('<parent link="beam_virtual_1_link"/>', '<parent link="base"/>', "beam_virtual_2.*beam_virtual_1_link"),
        ("</robot>", GRIPPER + "</robot>", "'g' is not part of the chain"),
        ("</robot>", '<link name="lone"/></robot>', "'lone' is not part of the chain"),
        ('<link name="beam_tip"/>', '<link name="beam_tip"><inertial/></link>', "has or lacks inertia"),
        ('<link name="beam_tip"/>', "", "no link 'beam_tip'"),
        ('ixx="0.0" ixy="0" ixz="0" iyy="0.0" iyz="0" izz="0.0"', INERTIA, "no point mass"),
        ('<vjm:virtual_joint name="beam_virtual_2"', '<vjm:virtual_joint name="other"', "no joint 'other'"),
        ('<child link="beam_tip"/>', '<child link="beam_tip"/><dynamics damping="1"/>', "'beam_tip_mount' is damped"),
    ],
)
def test_what_makes_no_chain_is_refused(tmp_path: Path, old: str, new: str, fault: str) -> None:
    text = one_link()
    assert old in text
    many = old in ("robot",)
    file = saved(tmp_path, text.replace(old, new) if many else text.replace(old, new, 1))
    with pytest.raises(ModelFileError, match=fault) as caught:
        chain_from_urdf(file)
    assert caught.value.file == file
    assert str(caught.value).startswith(f"{file}: ")


@pytest.mark.parametrize(
    "doctype",
    [
        '<!DOCTYPE robot SYSTEM "http://localhost/evil.dtd">',
        '<!DOCTYPE robot [<!ENTITY secret SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>',
        "<!DOCTYPE robot>",
    ],
)
def test_doctypes_and_entities_are_refused(tmp_path: Path, doctype: str) -> None:
    file = saved(tmp_path, one_link().replace("<robot", f"{doctype}<robot", 1))
    for read in (chain_from_urdf, check_urdf):
        with pytest.raises(ModelFileError, match="refused for safety") as caught:
            read(file)
        assert caught.value.file == file


@pytest.mark.parametrize("content", [b"", b"\x00\xff", b"not XML", b"<robot", b"<a>" * 100_000])
def test_what_is_no_xml_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "arm.urdf"
    file.write_bytes(content)
    with pytest.raises(ModelFileError, match="no well-formed XML"):
        chain_from_urdf(file)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for place in (tmp_path / "absent.urdf", tmp_path, "nul\0"):
        with pytest.raises(ModelFileError, match="cannot be read"):
            chain_from_urdf(place)
    with pytest.raises(ModelFileError, match="URDF text"):
        chain_from_urdf("<robot name='\ud800'/>")


@settings(max_examples=30, deadline=None)
@given(chains())
def test_yourdfpy_agrees(tmp_path_factory: pytest.TempPathFactory, chain: Chain) -> None:
    file = saved(tmp_path_factory.mktemp("urdf"), chain_to_urdf(chain))
    assert contents(check_urdf(file)) == contents(chain)


def test_a_parser_that_disagrees_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = plain_chain()
    heavier = Chain("arm", (plain_link(payload=1.0, distal="joined"), other.links[1]))
    longer = Chain("arm", (plain_link(lengths=[0.3, 0.35, 0.5], distal="joined"), other.links[1]))
    renamed = Chain("arm", (plain_link("boom", distal="joined"), other.links[1]))
    file = saved(tmp_path, chain_to_urdf(other))
    load = yourdfpy.URDF.load
    for chain, fault in ((heavier, "mass is"), (longer, "puts 'beam_tip'"), (renamed, "joints are")):
        seen = load(saved(tmp_path, chain_to_urdf(chain)).as_posix())
        saved(tmp_path, chain_to_urdf(other))
        monkeypatch.setattr(yourdfpy.URDF, "load", lambda *_, seen=seen, **__: seen)
        with pytest.raises(ModelFileError, match=fault):
            check_urdf(file)
