"""Commands that another distribution brings by an entry point, the laboratory's among them."""

import sys
from pathlib import Path

import pytest

from safedpa_services.command_line.group import COMMANDS, ENTRY_POINTS, LABORATORY, safedpa

COMMAND = "import click\n\n@click.command()\ndef command():\n    click.echo('a stranger says hello')\n"


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an installed distribution that brings a command ``hello``, and two that are broken."""
    info = tmp_path / "stranger-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n", encoding="utf-8")
    points = "hello = stranger_hello:command\ngone = stranger_gone:command\nodd = stranger_hello:__name__\n"
    (info / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\n{points}", encoding="utf-8")
    (tmp_path / "stranger_hello.py").write_text(COMMAND, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "stranger_hello", raising=False)
    return tmp_path


def test_a_command_of_another_distribution_runs(stranger: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert stranger.exists()
    assert safedpa.run(["hello"]) == 0
    assert capsys.readouterr().out == "a stranger says hello\n"


@pytest.mark.parametrize(("name", "notice"), [("gone", "reinstall stranger"), ("odd", "wanted a click command")])
def test_a_broken_one_costs_one_line(name: str, notice: str, stranger: Path, capsys: pytest.CaptureFixture[str]):
    assert stranger.exists()
    assert safedpa.run([name]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert f"command '{name}' of stranger" in line
    assert notice in line


def test_help_lists_every_command_whatever_a_stranger_broke(stranger: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert stranger.exists()
    assert safedpa.run(["--help"]) == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.split("Commands:")[1].splitlines() if line.strip()}
    assert {*COMMANDS, *LABORATORY, "hello", "gone"} <= listed


def test_without_the_laboratory_its_commands_say_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setattr("safedpa_services.command_line.group.entry_points", lambda **_: ())
    for name in LABORATORY:
        assert safedpa.run([name]) == 2
        assert "pip install 'safedpa[lab]'" in capsys.readouterr().err
    assert safedpa.run(["exprimnt"]) == 2
    assert safedpa.run(["--help"]) == 0
