"""model.json, and the files it is written with."""

from __future__ import annotations

import json
import math
import os
import stat
import threading
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.chains import HOSTILE, chains, contents, plain_chain, plain_link
from vjm.chain.virtual_links import Chain
from vjm.errors import ModelFileError, ShapeError
from vjm.files import json_text, write_bytes_atomic, write_text_atomic
from vjm.report.model_json import read_model, write_model

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=12,
)


@settings(deadline=None)
@given(chains(names=st.text(max_size=5)), st.dictionaries(st.text(), VALUES, max_size=4))
def test_chain_and_extras_come_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, chain: Chain, extra: dict[str, Any]
) -> None:
    file = tmp_path_factory.mktemp("model") / "model.json"
    write_model(chain, file, extra)
    back, back_extra = read_model(file)
    assert contents(back) == contents(chain)
    assert back_extra == extra
    text = file.read_bytes()
    write_model(back, file, back_extra)
    assert file.read_bytes() == text


def test_the_file_says_what_it_is(tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    write_model(plain_chain(), file)
    content = json.loads(file.read_text(encoding="utf-8"))
    assert list(content) == ["schema", "kind", "vjm", "chain", "extra"]
    assert (content["schema"], content["kind"], content["vjm"]) == (1, "vjm-model", version("vjm"))
    assert content["chain"]["links"][0]["stiffness"] == [8.0, 9.0]
    assert '        "stiffness": [8.0, 9.0],\n' in file.read_text(encoding="utf-8")


def test_extras_may_be_numpys(tmp_path: Path) -> None:
    write_model(
        plain_chain(), tmp_path / "m.json", {"std": np.eye(2), "n": np.int64(3), "x": (np.float64(0.1), np.True_)}
    )
    assert read_model(tmp_path / "m.json")[1] == {"std": [[1.0, 0.0], [0.0, 1.0]], "n": 3, "x": [0.1, True]}


@pytest.mark.parametrize(
    ("extra", "place"),
    [
        ({"a": {"b": [1.0, math.nan]}}, r"extra\.a\.b\[1\]"),
        ({"a": np.array([np.inf])}, r"extra\.a\[0\]"),
        ({"a": {1: 2}}, r"extra\.a: got key 1"),
        ({"a": {3, 4}}, r"extra\.a: got set"),
        ({"a": 1j}, r"extra\.a: got complex"),
    ],
)
def test_what_json_cannot_hold_is_refused_before_writing(tmp_path: Path, extra: dict[str, Any], place: str) -> None:
    with pytest.raises(ShapeError, match=place):
        write_model(plain_chain(), tmp_path / "model.json", extra)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("chain", "place"),
    [
        (Chain("arm", (plain_link(payload=-1.0),)), r"chain\.links\[0\]\.payload: got -1.0; expected .*greater"),
        (Chain("arm", (plain_link(hub_inertia=math.nan),)), r"chain\.links\[0\]\.hub_inertia"),
        (Chain("arm", (plain_link(), plain_link())), "names that differ"),
        (Chain("arm", ()), r"chain\.links"),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, chain: Chain, place: str) -> None:
    with pytest.raises(ShapeError, match=place):
        write_model(chain, tmp_path / "model.json")
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
        (["chain", "gravity"], [0.0], "key 'chain.gravity'"),
        (["chain", "links"], [], "key 'chain.links'"),
        ([*LINK, "stifness"], [1.0], r"key 'chain\.links\[1\]\.stifness': unknown key"),
        ([*LINK, "masses"], ..., r"key 'chain\.links\[1\]\.masses': missing"),
        ([*LINK, "masses"], [1.0, "2", 3.0, 4.0], r"key 'chain\.links\[1\]\.masses\[1\]': got '2'"),
        ([*LINK, "masses"], [1.0, True, 3.0, 4.0], r"masses\[1\]': got True"),
        ([*LINK, "masses"], [1.0], r"key 'chain': fore\.masses: shape \(1,\); expected shape \(4,\)"),
        ([*LINK, "lengths"], [1.0, 1.0, 0.0, 1.0], r"fore\.lengths"),
        ([*LINK, "damping"], [1.0, -1.0, 0.0], r"fore\.damping"),
        ([*LINK, "payload"], -0.1, r"payload': got -0.1"),
        ([*LINK, "joint"], "prismatic", r"joint': got 'prismatic'; expected 'revolute' or 'clamped'"),
        ([*LINK, "width"], 0.0, r"width'"),
        ([*LINK, "name"], "beam", "names that differ"),
        (["extra"], None, "key 'extra'"),
    ],
)
def test_faults_name_the_file_and_the_key(tmp_path: Path, keys: list[Any], value: Any, fault: str) -> None:
    file = tmp_path / "model.json"
    write_model(plain_chain(), file)
    content = json.loads(file.read_text(encoding="utf-8"))
    change(content, keys, value)
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ModelFileError, match=fault) as caught:
        read_model(file)
    assert caught.value.file == file
    assert str(caught.value).startswith(f"{file}: ")


def test_long_values_are_cut_short_in_messages(tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    file.write_text(json.dumps({"schema": "x" * 10_000}), encoding="utf-8")
    with pytest.raises(ModelFileError) as caught:
        read_model(file)
    assert len(str(caught.value)) < len(str(file)) + 200


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "no usable JSON"),
        (b"{", "no usable JSON"),
        (b"[]", "got"),
        (b"\xff\xfe\xfd", "no usable JSON"),
        (b'{"schema": 1, "schema": 1}', "'schema' occurs twice"),
        (b'{"extra": {"x": NaN}}', "NaN is not finite"),
        (b'{"extra": {"x": -Infinity}}', "-Infinity is not finite"),
        (b'{"extra": {"x": 1e999}}', "1e999 is not finite"),
        (b'{"extra": ' + b"1" * 5000 + b"}", "no usable JSON"),
        (b"[" * 100_000, "no usable JSON"),
    ],
)
def test_what_is_no_json_is_refused(tmp_path: Path, content: bytes, fault: str) -> None:
    file = tmp_path / "model.json"
    file.write_bytes(content)
    with pytest.raises(ModelFileError, match=fault):
        read_model(file)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for place in (tmp_path / "absent.json", tmp_path):
        with pytest.raises(ModelFileError, match=str(place)):
            read_model(place)


def test_names_stay_readable(tmp_path: Path) -> None:
    write_model(replace(plain_chain(), name=HOSTILE), tmp_path / "model.json")
    assert "é世" in (tmp_path / "model.json").read_text(encoding="utf-8")


def test_json_is_laid_out_for_reading() -> None:
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
  "g": "\\ud800\\u00e9"
}
"""
    assert json_text(value) == expected


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "model.json"
    file.write_text("old")

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    for name in ("fsync", "replace"):
        with monkeypatch.context() as broken:
            broken.setattr(os, name, fail)
            with pytest.raises(KeyboardInterrupt):
                write_text_atomic(file, "new")
        assert file.read_text() == "old"
        assert list(tmp_path.iterdir()) == [file]
    write_text_atomic(file, "né")
    assert file.read_bytes() == "né".encode()
    assert list(tmp_path.iterdir()) == [file]


def test_permissions_are_those_of_any_file_and_are_kept(tmp_path: Path) -> None:
    ordinary, file = tmp_path / "ordinary", tmp_path / "model.json"
    ordinary.touch()
    write_bytes_atomic(file, b"")
    assert file.stat().st_mode == ordinary.stat().st_mode
    file.chmod(0o600)
    write_bytes_atomic(file, b"new")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_links_are_followed_and_pipes_written_to(tmp_path: Path) -> None:
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    file.write_text("old")
    link.symlink_to(file)
    write_text_atomic(link, "new")
    assert link.is_symlink()
    assert file.read_text() == "new"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    write_text_atomic(pipe, "through")
    reader.join(10)
    assert received == ["through"]


def test_a_directory_that_is_missing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_text_atomic(tmp_path / "absent" / "model.json", "")
    with pytest.raises(IsADirectoryError):
        write_text_atomic(tmp_path, "")
