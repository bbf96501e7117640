"""What ``safedpa up`` makes of its options, and what it says of a drive that went wrong: no process is started."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import CliRunner
from tests.services.test_plan import planned

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError, SafedpaError
from safedpa_services.command_line import up


@pytest.mark.parametrize(
    ("options", "load", "change"),
    [
        ([], "none", ""),
        (["--load", "chair"], "chair", ""),
        (["--load", "none"], "none", ""),
        (["--change", "headwind"], "none", "headwind"),
    ],
)
def test_load_and_change_are_as_asked_and_none_without_a_word(
    options: list[str], load: str, change: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plan = planned(monkeypatch, tmp_path, "--headless", *options)
    assert (plan.load, plan.change) == (load, change)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], ""),
        (["--model", "dart_car"], ""),
        (["--model", "dart_car", "--load", "none"], ""),
        (["--model", "dart_car", "--laser"], ""),
        (["--model", "dart_car", "--load", "chair"], "--load: got 'chair' for a car with throttle, steer, whose"),
        (["--model", "dart_car", "--change", "hitch"], "--change: got 'hitch' for a car with throttle, steer, whose"),
        (["--load", "chair"], ""),
        (["--robot", "pendulum", "--load", "chair"], "--load: got one for a pendulum, which has none"),
    ],
)
def test_what_a_stand_in_cannot_do_is_refused_and_only_that(
    options: list[str], told: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The throttle's stand-in is a car as well, and tows nothing."""
    words = ["--headless", "--json", "--out", str(tmp_path), *options]
    if told:
        monkeypatch.setattr(up, "driven", None)
        result = CliRunner().invoke(up.command, words)
        assert isinstance(result.exception, InputError)
        assert str(result.exception).startswith(told)
        return
    plan = planned(monkeypatch, tmp_path, "--headless", *options)
    assert ("--drive=throttle" in plan.robot_process().arguments) is ("dart_car" in options)


@pytest.mark.parametrize(
    ("name", "rate", "refused"),
    [
        ("car_learned", 20.0, False),
        ("car_learned", 20.1, False),  # half a percent is rounding of a period
        ("car_learned", 19.0, True),
        ("car_learned", 40.0, True),
        ("car", 40.0, False),  # equations hold at any rate
    ],
)
def test_networks_are_asked_at_the_rate_of_their_training_alone(name: str, rate: float, refused: bool) -> None:
    """Of 0.05 s: asked twice as often, each tick they would say that the robot goes as far as in two."""
    known = load_model(name)
    model = PhysicsModel(known.base, list(known.effects), dict(known.settings), 0.05)
    if not refused:
        up._check_rate(model, rate)
        return
    with pytest.raises(InputError, match=f"--rate: got {rate:g} ticks per second, the model's networks .* for 20;"):
        up._check_rate(model, rate)


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> Any:
    """ended(code, begun, hurried) -> what is told of a drive whose supervisor ended so."""

    def run(code: int, *, begun: bool, hurried: bool) -> Any:
        class Supervisor:
            def __init__(self, *_: Any) -> None:
                pass

            def run(self) -> int:
                return code

        @contextmanager
        def bus(*_: Any) -> Iterator[None]:
            yield None

        @contextmanager
        def shown_by(*_: Any) -> Iterator[Any]:
            yield lambda: None

        watch = SimpleNamespace(health={}, standstills=[], verdicts={"passed": 7})
        monkeypatch.setattr("safedpa.bus.Bus", bus)
        monkeypatch.setattr("safedpa.bus.ZenohTransport", lambda _: None)
        monkeypatch.setattr("safedpa_services.supervisor.supervisor.Supervisor", Supervisor)
        monkeypatch.setattr("safedpa_services.supervisor.watch.Watch", lambda *_: watch)
        monkeypatch.setattr("safedpa_services.supervisor.watch.summary_of", lambda _, verdicts, *__: dict(verdicts))
        robot = SimpleNamespace(begun=begun, last_words=lambda: "the motor is on fire")
        plan: Any = SimpleNamespace(
            services=list, robot_process=lambda: robot, wallet=None, own_session=lambda: None, fleet="f",
            names=("r1",), recording="drive.mcap", summary="summary.json", other_summaries=(),
        )  # fmt: skip
        stop: Any = SimpleNamespace(hurried=hurried)
        return up.driven(plan, stop, shown_by)

    return run


def test_a_drive_that_went_well_is_summed_up(ended: Any) -> None:
    assert ended(0, begun=True, hurried=False) == {"passed": 7}


@pytest.mark.parametrize(("begun", "hurried"), [(True, False), (True, True), (False, False), (False, True)])
def test_a_robot_that_failed_is_told_by_its_last_words_whatever_else_happened(
    ended: Any, begun: bool, hurried: bool
) -> None:
    with pytest.raises(SafedpaError, match="robot: the motor is on fire"):
        ended(1, begun=begun, hurried=hurried)


@pytest.mark.parametrize("begun", [True, False])
def test_a_second_signal_ends_at_once_with_a_status_of_its_own(
    ended: Any, begun: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a shell tells what a signal ended: 128 and the signal's number, 2."""
    with pytest.raises(click.exceptions.Exit) as told:
        ended(0, begun=begun, hurried=True)
    assert told.value.exit_code == 130
    assert "drive.mcap" in capsys.readouterr().err


def test_where_the_robot_was_never_started_no_drive_is_told_of(ended: Any) -> None:
    with pytest.raises(SafedpaError, match="nothing was driven"):
        ended(0, begun=False, hurried=False)
