"""Where results may be written: asked before the work, and nothing is left or lost where the work fails."""

from __future__ import annotations

import datetime
import os
from pathlib import Path
from typing import Any

import pytest

from safedpa.compare.output import new_folder, results_folder, writable, writable_file
from safedpa.errors import InputError


def test_a_folder_that_is_there_is_taken_and_one_that_is_not_is_named(tmp_path: Path) -> None:
    assert writable(tmp_path) == tmp_path
    missing = tmp_path / "a" / "b"
    with pytest.raises(InputError, match=f"^{missing}: got no folder that exists; make it, or choose another place"):
        writable(missing)
    assert not missing.parent.exists()
    assert writable(missing, create=True).is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file: got no folder that exists"):
        writable(tmp_path / "file")


@pytest.mark.parametrize("lacking", [os.W_OK, os.X_OK])
def test_a_folder_into_which_nobody_may_write_is_refused(
    lacking: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To write a file into a folder one must be let into it as well."""
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & lacking)
    with pytest.raises(InputError, match=f"^{tmp_path}: must not be written to; choose another place with --out"):
        writable(tmp_path)
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & os.R_OK)
    assert writable(tmp_path) == tmp_path


def test_a_file_to_write_is_no_folder_and_its_folder_is_there(tmp_path: Path) -> None:
    assert writable_file(tmp_path / "a.csv") == tmp_path / "a.csv"
    with pytest.raises(InputError, match=f"^{tmp_path}: is a folder; name the file to write with --out"):
        writable_file(tmp_path)
    with pytest.raises(InputError, match="got no folder that exists"):
        writable_file(tmp_path / "none" / "a.csv")


@pytest.mark.parametrize(
    ("there", "out", "left"),
    [
        ("", "a/b", []),
        ("a", "a/b", ["a"]),
        ("a/b", "a/b", ["a", "a/b"]),
        ("a/b/c", "a/b", ["a", "a/b", "a/b/c"]),
    ],
)
def test_of_the_folders_of_a_command_that_fails_those_stay_that_were_there(
    there: str, out: str, left: list[str], tmp_path: Path
) -> None:
    """An empty folder that somebody made is not taken away."""
    if there:
        (tmp_path / there).mkdir(parents=True)

    def work() -> None:
        with results_folder(tmp_path / out, "compare", "car", (), (), False) as folder:
            assert folder.is_dir()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == left


def test_what_was_written_before_a_failure_stays(tmp_path: Path) -> None:
    def work() -> None:
        with results_folder(tmp_path / "a", "compare", "car", (), (), False) as out:
            (out / "report.json").write_text("{}", encoding="utf-8")
            raise ValueError("late")

    with pytest.raises(ValueError, match="late"):
        work()
    assert (tmp_path / "a" / "report.json").exists()


def test_a_new_folder_is_named_by_the_second_and_counted_from_two_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[Any] = []
    for _ in range(3):
        made.append(new_folder("diagnose", "models/my_car.toml", datetime.datetime(2026, 1, 2, 3, 4, 5)))
        made[-1].mkdir()
    first = "diagnose-my_car-2026-01-02-030405"
    assert [str(path) for path in made] == [first, f"{first}-2", f"{first}-3"]
