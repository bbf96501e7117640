"""``safedpa status``, ``stop`` and ``go`` in a script, on a bus without messages."""

import json

import pytest

from safedpa.bus.monitor.fleet_state import FleetOverview
from safedpa.bus.service.process import StopSignal
from safedpa_services.command_line.group import safedpa

NO_ONE = ("--fleet", "a-fleet-without-robots", "--connect")


@pytest.fixture
def endpoint(free_port: int) -> str:
    """Of a bus without messages."""
    return f"tcp/127.0.0.1:{free_port}"


@pytest.fixture
def empty_bus(endpoint: str):  # type: ignore[no-untyped-def]
    from safedpa.bus import ZenohSettings, ZenohTransport

    transport = ZenohTransport(ZenohSettings("router", listen=(endpoint,)))
    yield endpoint
    transport.close()


def run(*arguments: str) -> int:
    code: int = safedpa.run(list(arguments))  # type: ignore[attr-defined]
    return code


def test_an_empty_bus_is_one_clear_line_and_code_1(empty_bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("status", *NO_ONE, empty_bus, "--seconds", "0.5") == 1
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.count("\n") == 1
    assert "no process found on the bus within 0.5 s" in errors
    assert "--connect" in errors


def test_an_empty_bus_in_json_is_not_healthy(empty_bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("status", *NO_ONE, empty_bus, "--seconds", "0.5", "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert not document["healthy"]
    assert document["robots"] == document["services"] == []


@pytest.mark.parametrize("command", ["stop", "go"])
def test_an_order_that_no_filter_hears_is_reported(command: str, empty_bus: str, capsys: pytest.CaptureFixture[str]):
    assert run(command, *NO_ONE, empty_bus) == 1
    assert "no safety filter answers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("--seconds", "0"), "--seconds"),
        (("--watch", "--json"), "--watch, --json"),
        (("--picture", "a.png"), ".svg"),
        (("--certificates", "/no/such/folder"), "authority.pem"),
    ],
)
def test_bad_options_are_refused_in_one_line(arguments, reported, capsys):
    assert run("status", *arguments) in (1, 2)
    errors = capsys.readouterr().err
    assert reported in errors
    assert errors.count("\n") == 1


def test_watching_into_a_file_writes_one_table_after_the_other(
    empty_bus: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class TwoTurns(StopSignal):
        turns = iter((False, False, True))

        def __call__(self) -> bool:
            return next(self.turns)

        def listen_to_signals(self) -> None:
            pass

    monkeypatch.setattr("safedpa.bus.service.process.StopSignal", TwoTurns)
    monkeypatch.setattr(FleetOverview, "listen", lambda _fleet, _wait: None)
    assert run("status", *NO_ONE, empty_bus, "--watch") == 1
    assert capsys.readouterr().out.count("no process found for 0 s") == 2
