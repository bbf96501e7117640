"""``--json``: every command that ends by itself has it, and prints one JSON document."""

import json
from pathlib import Path

import click
import pytest

from safedpa_services.command_line.group import COMMANDS, safedpa


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_json(name: str) -> None:
    command = safedpa.get_command(click.Context(safedpa), name)
    if not isinstance(command, click.Group):
        assert "--json" in {option for item in command.params for option in item.opts}


def test_lines_become_one_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    assert safedpa.run(["certificates", str(folder), "--robot", "r1", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert "robot.r1" in first["made"]
    assert first["retained"] == []
    assert safedpa.run(["certificates", str(folder), "--robot", "r1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["retained"] == first["made"]
    assert safedpa.run(["certificates", str(folder), "--robot", "r1"]) == 0
    assert "robot.r1: exists already" in capsys.readouterr().out


def test_an_error_prints_one_line_and_no_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["screenshot", "nothing.rrd", "--out", str(tmp_path / "p.png"), "--json"]) == 2
    notice = capsys.readouterr()
    assert notice.out == ""
    assert notice.err.count("\n") == 1
