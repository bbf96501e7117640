"""Every option of a command that has a function of ``import safedpa`` behind it reaches that function."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from safedpa.errors import InputError
from safedpa_services.command_line.group import safedpa

# The command, what it needs at least, and the function that it calls.
COMMANDS = {
    "add": ("m.toml drag log.csv --out n.toml", "safedpa.api.fitting.add"),
    "refit": ("m.toml log.csv --free drag --out n.toml", "safedpa.api.fitting.refit"),
    "remove": ("m.toml drag log.csv --out n.toml", "safedpa.api.fitting.remove"),
    "calibrate": ("drive.mcap --out margin.toml", "safedpa.api.calibrating.calibrate"),
    "check": ("robot.py", "safedpa.api.robot_check.check"),
    "columns": ("log.csv", "safedpa.api.log_columns.columns"),
    "compare": ("m.toml log.csv", "safedpa.api.comparing.compare"),
    "diagnose": ("m.toml log.csv", "safedpa.api.diagnosing.diagnose"),
    "effects": ("", "safedpa.api.effect_table.list_effects"),
    "export": ("drive.mcap --format csv --out t.csv", "safedpa.api.exporting.export"),
    "init": ("log.csv --out robot", "safedpa.api.starting.init"),
    "predict": ("m.toml log.csv --horizon 1 --out p.csv", "safedpa.api.predicting.predict"),
    "rehearse": ("m.toml log.csv --effect drag --size 1", "safedpa.api.planning.rehearse"),
}
OUTPUT = {"as_json", "markdown"}
"""Options that only say how the answer is printed."""
OTHERS = {"fleet", "by", "jobs", "ray", "again", "check", "folder"}
"""Options with which ``diagnose`` and ``export`` call another function."""


def arguments_of(command: str, given: str, function: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """With what the command calls the function."""
    calls: list[Any] = []

    def called(*arguments: Any, **named: Any) -> Any:
        calls.append((arguments, {name: value for name, value in named.items() if name != "out" or "--out" in given}))
        raise InputError("noted")

    module, _, name = function.rpartition(".")
    monkeypatch.setattr(importlib.import_module(module), name, called)
    assert safedpa.run([command, *given.split()]) != 0
    assert len(calls) == 1, "the function was not called"
    return calls[0]


def options_of(command: str) -> Iterator[click.Option]:
    found = safedpa.get_command(click.Context(safedpa), command)
    assert found is not None
    yield from (item for item in found.params if isinstance(item, click.Option) and item.name != "help")


def probe(item: click.Option, folder: Path) -> str:
    """A value that is not the default."""
    if item.is_flag:
        return max(item.opts, key=len)
    if isinstance(item.type, click.Choice):
        value = item.type.choices[-1]
    elif "integer" in item.type.name or "float" in item.type.name:
        value = "7"
    elif item.type.name == "path":
        value = str(folder / "other")
    else:
        value = "torque=torque" if item.multiple else "other"
    return f"{max(item.opts, key=len)} {value}"


CASES = [(command, item.name) for command in COMMANDS for item in options_of(command)]


@pytest.mark.parametrize(("command", "name"), [case for case in CASES if case[1] not in OUTPUT | OTHERS], ids=str)
def test_an_option_reaches_the_function(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    least, function = COMMANDS[command]
    item = next(item for item in options_of(command) if item.name == name)
    plain = arguments_of(command, least, function, monkeypatch)
    other = arguments_of(command, f"{least} {probe(item, tmp_path)}", function, monkeypatch)
    assert other != plain
