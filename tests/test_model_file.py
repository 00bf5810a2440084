"""model.json, and the files it is written with."""

from __future__ import annotations

import json
import math
import os
import stat
import threading
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vjm
from tests.model.chains import HOSTILE, chains, contents, model_of, plain_chain, plain_link, write_model
from vjm.chain.virtual_links import Chain
from vjm.errors import ModelFileError, ShapeError
from vjm.files import FolderError, json_text, write_text
from vjm.records import Estimate
from vjm.report.model_json import load_model, read_model


@settings(deadline=None)
@given(
    chains(names=st.from_regex("[A-Za-z0-9_]{1,5}", fullmatch=True)),
    st.floats(1e-300, 1e300),
    st.floats(allow_nan=False, allow_infinity=False),
)
def test_every_number_comes_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, chain: Chain, noise: float, value: float
) -> None:
    file = tmp_path_factory.mktemp("model") / "model.json"
    estimates = (Estimate("a.b", value, noise, "N m^2", False, "why", "how"), Estimate("a.c", noise, None, ""))
    model = replace(model_of(chain), marker_noise=noise, estimates=estimates)
    write_model(model, file, np.array([[value]]))
    back, covariance = read_model(file)
    assert contents(back.chain) == contents(chain)
    for field in fields(model):
        if field.name != "chain":
            assert getattr(back, field.name) == getattr(model, field.name)
    assert covariance.tolist() == [[value]]
    text = file.read_bytes()
    write_model(back, file, covariance)
    assert file.read_bytes() == text


def test_the_file_says_what_it_is(tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    write_model(model_of(plain_chain()), file)
    content = json.loads(file.read_text(encoding="utf-8"))
    assert (content["schema"], content["kind"], content["vjm"]) == (1, "vjm-model", version("vjm"))
    assert content["chain"]["links"][0]["stiffness"] == [8.0, 9.0]
    assert '        "stiffness": [8.0, 9.0],\n' in file.read_text(encoding="utf-8")
    assert isinstance(vjm.load_model(file), vjm.Model)


@pytest.mark.parametrize(
    ("chain", "place"),
    [
        (Chain("arm", (plain_link(payload=-1.0),)), r"links\[0\]\.payload: got -1.0; expected greater"),
        (Chain("arm", (plain_link(hub_inertia=math.nan),)), r"links\[0\]\.hub_inertia"),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, chain: Chain, place: str) -> None:
    with pytest.raises(ShapeError, match=place):
        write_model(model_of(chain), tmp_path / "model.json")
    assert list(tmp_path.iterdir()) == []


def change(content: dict[str, Any], keys: list[Any], value: Any) -> None:
    """Set, or for `...` delete, what `keys` lead to."""
    for key in keys[:-1]:
        content = content[key]
    if value is ...:
        del content[keys[-1]]
    else:
        content[keys[-1]] = value


LINK = ["chain", "links", 1]


@pytest.mark.parametrize(
    ("keys", "value", "fault"),
    [
        (["schema"], 2, "key 'schema': got 2; expected 1"),
        (["kind"], "urdf", "key 'kind'"),
        (["vjm"], ..., "key 'vjm': missing"),
        (["more"], 1, "key 'more': unknown key"),
        (["chain", "more"], 1, "key 'chain.more': unknown key"),
        (["chain"], [], "key 'chain'"),
        (["chain", "gravity"], [0.0], "key 'chain.gravity"),
        (["chain", "links"], [], "key 'chain.links'"),
        ([*LINK, "stifness"], [1.0], r"key 'chain\.links\[1\]\.stifness': unknown key"),
        ([*LINK, "masses"], ..., r"key 'chain\.links\[1\]\.masses': missing"),
        ([*LINK, "masses"], [1.0, "2", 3.0, 4.0], r"key 'chain\.links\[1\]\.masses\[1\]': got '2'"),
        ([*LINK, "masses"], [1.0, True, 3.0, 4.0], r"masses\[1\]': got True"),
        ([*LINK, "masses"], [1.0], r"key 'fore\.masses': shape \(1,\); expected shape \(4,\)"),
        ([*LINK, "lengths"], [1.0, 1.0, 0.0, 1.0], r"fore\.lengths"),
        ([*LINK, "damping"], [1.0, -1.0, 0.0], r"fore\.damping"),
        ([*LINK, "payload"], -0.1, r"payload': got -0.1"),
        ([*LINK, "joint"], "prismatic", r"joint': got 'prismatic'; expected 'revolute' or 'clamped'"),
        ([*LINK, "width"], 0.0, r"width'"),
        ([*LINK, "name"], "beam", "names that differ"),
        (["rig", "links", 0, "length"], "long", r"key 'rig\.links\[0\]\.length': got 'long'"),
        (["rig", "links", 0, "name"], "\x1b", "expected a name of letters, digits and underscores"),
        (["rig", "links", 0, "markers"], [1e300], r"got 1e\+300; expected a list of finite positive numbers"),
        (["rig", "links", 0, "lenght"], 1.0, r"key 'rig\.links\[0\]\.lenght': unknown key"),
        (["rig", "links", 0, "name"], "other", r"key 'rig\.links': .*other"),
        (["marker_noise"], 0.0, "key 'marker_noise': got 0.0"),
        (["estimates"], [{"name": "x"}], r"key 'estimates\[0\]\.value': missing"),
        (["covariance"], [[1.0]], r"key 'covariance': rows of \[1\]; expected 0 rows"),
        (["covariance"], [[1.0], [1.0, 2.0]], r"key 'covariance': rows of \[1, 2\]"),
        (["effects"], {}, "key 'effects'"),
    ],
)
def test_faults_name_the_file_and_the_key(tmp_path: Path, keys: list[Any], value: Any, fault: str) -> None:
    file = tmp_path / "model.json"
    write_model(model_of(plain_chain()), file)
    content = json.loads(file.read_text(encoding="utf-8"))
    change(content, keys, value)
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ModelFileError, match=fault) as caught:
        load_model(file)
    assert caught.value.file == file
    assert str(caught.value).startswith(f"{file}: ")


def test_long_values_are_cut_short_in_messages(tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    for content in (json.dumps({"schema": "x" * 10_000}), "[" * 100_000):
        file.write_text(content, encoding="utf-8")
        with pytest.raises(ModelFileError) as caught:
            load_model(file)
        assert len(str(caught.value)) < len(str(file)) + 200


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "no usable JSON"),
        (b"{", "no usable JSON"),
        (b"[]", "got"),
        (b"\xff\xfe\xfd", "no usable JSON"),
        (b'{"marker_noise": NaN, "schema": 1}', "key"),
        (b"[" * 100_000, "no usable JSON"),
    ],
)
def test_what_is_no_model_is_refused(tmp_path: Path, content: bytes, fault: str) -> None:
    file = tmp_path / "model.json"
    file.write_bytes(content)
    with pytest.raises(ModelFileError, match=fault):
        load_model(file)


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "1e999"])
def test_what_is_not_finite_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "model.json"
    write_model(model_of(plain_chain()), file)
    file.write_text(file.read_text().replace('"hub_inertia": 0.02', f'"hub_inertia": {text}', 1))
    with pytest.raises(ModelFileError, match=r"hub_inertia': got .*; expected a finite number"):
        load_model(file)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for place in (tmp_path / "absent.json", tmp_path):
        with pytest.raises(ModelFileError, match=str(place)):
            load_model(place)
    with pytest.raises(ShapeError, match=r"path: got None; expected the path of a model\.json"):
        load_model(None)  # type: ignore[arg-type]


def test_names_stay_readable(tmp_path: Path) -> None:
    write_model(model_of(replace(plain_chain(), name=HOSTILE)), tmp_path / "model.json")
    assert "é世" in (tmp_path / "model.json").read_text(encoding="utf-8")


def test_json_is_laid_out_for_reading(tmp_path: Path) -> None:
    value = {"a": [1, 2.5, None], "b": {"c": [], "d": {}}, "e": [{"f": True}, [0]], "g": "\ud800é"}
    expected = """{
  "a": [1, 2.5, null],
  "b": {
    "c": [],
    "d": {}
  },
  "e": [
    {
      "f": true
    },
    [0]
  ],
  "g": "\\ud800é"
}
"""
    write_text(tmp_path / "value.json", json_text(value))
    assert (tmp_path / "value.json").read_text(encoding="utf-8") == expected
    assert json.loads(expected) == value


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "model.json"
    file.write_text("old")

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    for name in ("shutil.copymode", "os.replace"):
        with monkeypatch.context() as broken:
            broken.setattr(f"vjm.files.{name}", fail)
            with pytest.raises(KeyboardInterrupt):
                write_text(file, "new")
        assert file.read_text() == "old"
        assert list(tmp_path.iterdir()) == [file]
    write_text(file, "né")
    assert file.read_bytes() == "né".encode()
    assert list(tmp_path.iterdir()) == [file]


def test_permissions_are_those_of_any_file_and_are_kept(tmp_path: Path) -> None:
    ordinary, file = tmp_path / "ordinary", tmp_path / "model.json"
    ordinary.touch()
    write_text(file, "")
    assert file.stat().st_mode == ordinary.stat().st_mode
    file.chmod(0o600)
    write_text(file, "new")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_links_are_followed_and_pipes_written_to(tmp_path: Path) -> None:
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    file.write_text("old")
    link.symlink_to(file)
    write_text(link, "new")
    assert link.is_symlink()
    assert file.read_text() == "new"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    write_text(pipe, "through")
    reader.join(10)
    assert received == ["through"]


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    for place, words in ((tmp_path / "absent" / "model.json", "does not exist"), (tmp_path, "this is a folder")):
        with pytest.raises(FolderError, match=words):
            write_text(place, "")
