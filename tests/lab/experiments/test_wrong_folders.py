"""A folder that cannot be made, or that a user names and that is not there, is told before hours of work."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa_lab.commands.experiment import command


def told(*words: str) -> str:
    found = CliRunner().invoke(command, list(words))
    assert isinstance(found.exception, InputError), found.output
    return str(found.exception)


@pytest.mark.parametrize("name", ["point", "point-heat-map", "point-relinearised", "point-story", "pendulum"])
def test_an_out_that_cannot_be_made_is_refused_before_anything_is_driven(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safedpa_services.progress.progress", lambda *_: pytest.fail("work was begun"))
    monkeypatch.setattr("safedpa_lab.point.heat_map.heat_map", lambda *_, **__: pytest.fail("work was begun"))
    (tmp_path / "file").touch()
    assert told(name, "--out", str(tmp_path / "file" / "in")).startswith(f"--out {tmp_path / 'file' / 'in'}: cannot be")


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("point", "--models"),
        ("point", "--baselines"),
        ("point-heat-map", "--models"),
        ("point-relinearised", "--models"),
    ],
)
def test_a_folder_that_is_named_and_not_there_is_not_replaced_by_what_ships(
    name: str, option: str, tmp_path: Path
) -> None:
    assert told(name, option, str(tmp_path / "mistyped")) == (
        f"{option} {tmp_path / 'mistyped'}: got no folder that exists, wanted one; without {option} what ships is taken"
    )
