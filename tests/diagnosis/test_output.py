"""Result folders: they are checked before the work, and a failure leaves nothing new and loses nothing."""

from __future__ import annotations

import datetime
import os
from pathlib import Path
from typing import Any

import pytest

from safedpa.compare.output import new_folder, results_folder, writable, writable_file
from safedpa.errors import InputError


def test_a_folder_that_does_not_exist_is_refused_or_made_on_request(tmp_path: Path) -> None:
    assert writable(tmp_path) == tmp_path
    missing = tmp_path / "a" / "b"
    with pytest.raises(InputError, match=rf"^{missing}: got no folder that exists; make it, or choose another place"):
        writable(missing)
    assert not missing.parent.exists()
    assert writable(missing, create=True).is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file: got no folder that exists"):
        writable(tmp_path / "file")


@pytest.mark.parametrize("lacking", [os.W_OK, os.X_OK])
def test_a_folder_without_write_or_search_permission_is_refused(
    lacking: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & lacking)
    with pytest.raises(InputError, match=rf"^{tmp_path}: must not be written to; choose another place with --out"):
        writable(tmp_path)
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & os.R_OK)
    assert writable(tmp_path) == tmp_path


def test_a_file_to_write_is_not_a_folder_and_its_folder_exists(tmp_path: Path) -> None:
    assert writable_file(tmp_path / "a.csv") == tmp_path / "a.csv"
    with pytest.raises(InputError, match=rf"^{tmp_path}: is a folder; name the file to write with --out"):
        writable_file(tmp_path)
    with pytest.raises(InputError, match="got no folder that exists"):
        writable_file(tmp_path / "none" / "a.csv")


@pytest.mark.parametrize("written", [False, True])
@pytest.mark.parametrize(
    ("there", "left"), [("", []), ("a", ["a"]), ("a/b", ["a", "a/b"]), ("a/b/c", ["a", "a/b", "a/b/c"])]
)
def test_a_command_that_fails_removes_the_empty_folders_that_it_made_itself(
    there: str, left: list[str], written: bool, tmp_path: Path
) -> None:
    (tmp_path / there).mkdir(parents=True, exist_ok=True)

    def work() -> None:
        with results_folder(tmp_path / "a" / "b", "compare", "car", (), (), False) as folder:
            assert folder.is_dir()
            if written:
                (folder / "report.json").write_text("{}", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert found == (sorted({*left, "a", "a/b", "a/b/report.json"}) if written else left)


def test_a_new_folder_is_named_by_the_second_and_counted_from_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[Any] = []
    for _ in range(3):
        made.append(new_folder("diagnose", "models/my_car.toml", datetime.datetime(2026, 1, 2, 3, 4, 5)))
        made[-1].mkdir()
    first = "diagnose-my_car-2026-01-02-030405"
    assert [str(path) for path in made] == [first, f"{first}-2", f"{first}-3"]
