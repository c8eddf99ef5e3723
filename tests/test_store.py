"""Files are whole or not there; the same value gives the same bytes."""

import json
from pathlib import Path

import numpy as np
import pytest

from netdesign.errors import InputError
from netdesign.files.store import demand_writable, plain, read_json, write_bytes, write_json


def test_json_is_deterministic_and_strict(tmp_path):
    value = {"b": np.array([1.0, np.inf, np.nan, -0.0]), "a": (np.int64(3), None, "ü")}
    write_json(tmp_path / "x.json", "design", value, "0" * 64)
    text = (tmp_path / "x.json").read_text()
    write_json(tmp_path / "x.json", "design", dict(reversed(value.items())), "0" * 64)
    assert (tmp_path / "x.json").read_text() == text
    content = read_json(tmp_path / "x.json", "design")
    assert content["b"] == [1.0, None, None, 0.0]
    assert content["a"] == [3, None, "ü"]
    assert content["format"] == "netdesign/design/1"
    assert list(json.loads(text)) == sorted(json.loads(text))


def test_numbers_survive_exactly():
    numbers = np.random.default_rng(0).normal(size=100)
    assert json.loads(json.dumps(plain(numbers))) == numbers.tolist()


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    write_bytes(path, b"old")
    with pytest.raises(TypeError):
        write_bytes(path, "not bytes")
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(("text", "says"), [("{", "JSON"), ("[]", "format"), ('{"format": "other"}', "other")])
def test_wrong_files(tmp_path, text, says):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match=says):
        read_json(tmp_path / "x.json", "design")


def test_what_cannot_be_written_is_known_beforehand(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    demand_writable(tmp_path / "file")
    demand_writable(tmp_path / "new" / "deep" / "noise.json")
    monkeypatch.chdir(tmp_path)
    demand_writable(Path("noise.json"))
    assert [item.name for item in tmp_path.iterdir()] == ["file"]
    with pytest.raises(IsADirectoryError):
        demand_writable(tmp_path)
    with pytest.raises(NotADirectoryError):
        demand_writable(tmp_path / "file" / "noise.json")
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(PermissionError, match="noise"):
        demand_writable(tmp_path / "noise.json")
