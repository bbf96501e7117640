"""A robot's result replaces the one before as a whole, and leaves no other file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from safedpa.errors import RecordingError
from safedpa.fleet.fleet_diagnosis import RobotResult, read_result, write_result


def result(name: str, number: int, texts: dict[str, str]) -> RobotResult:
    document: dict[str, Any] = {"robot": name, "number": number}
    return RobotResult(name, document, texts)


def held(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}


def test_a_result_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    folder = tmp_path / "robots"
    for number, texts in enumerate(({"a.md": "first", "b.md": "only in the first"}, {"a.md": "second"}, {})):
        write_result(result("r1", number, texts), tmp_path)
        files = held(folder / "r1")
        assert json.loads(files.pop("result.json")) == {"robot": "r1", "number": number}
        assert files == texts
        assert [path.name for path in folder.iterdir()] == ["r1"], "nothing of the former, and no part"
    write_result(result("r2", 7, {}), tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["r1", "r2"]


def test_where_it_cannot_be_written_the_one_before_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_result(result("r1", 1, {"a.md": "first"}), tmp_path)
    before, folder = held(tmp_path / "robots" / "r1"), tmp_path / "robots"

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(RecordingError, match="cannot be written"):
            write_result(result("r1", 2, {"a.md": "second"}), tmp_path)
    assert held(folder / "r1") == before
    assert [path.name for path in folder.iterdir()] == ["r1"]
    assert read_result(folder / "r2") is None
