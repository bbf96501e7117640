"""Which processes a loop consists of, and which of them it cannot do without."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import CliRunner

from safedpa.bus import MemoryBroker, MemoryTransport
from safedpa.bus.security.certificates import Card
from safedpa.errors import InputError, SafedpaError
from safedpa_services.command_line import up
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.plan import Plan
from safedpa_sim.robots import CHANGES


def planned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *options: str) -> Plan:
    """The plan that ``safedpa up`` makes of its options; nothing is started."""
    seen: list[Plan] = []
    summary: dict[str, Any] = {}

    def drive(plan: Plan, *_: Any, **__: Any) -> dict[str, Any]:
        seen.append(plan)
        return summary

    monkeypatch.setattr(up, "driven", drive)
    result = CliRunner().invoke(up.command, ["--json", "--out", str(tmp_path), *options])
    assert result.exception is None, result.output
    return seen[0]


def named(plan: Plan) -> dict[str, Child]:
    return {child.name: child for child in plan.services()}


def after(words: tuple[str, ...], option: str) -> str:
    return words[words.index(option) + 1]


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ([], True),
        (["--headless"], True),
        (["--lockstep"], True),
        (["--lockstep", "--headless"], False),
        (["--lockstep", "--headless", "--diagnosis"], True),
        (["--no-diagnosis"], False),
    ],
)
def test_the_diagnosis_runs_unless_only_a_summary_is_wanted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, options: list[str], wanted: bool
) -> None:
    children = named(planned(monkeypatch, tmp_path, *options))
    assert ("diagnosis" in children) is wanted
    assert ("workbench" in children) is (wanted and "--headless" not in options)


def test_perception_is_told_its_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "perception.toml"
    file.write_text("[perception]\nmin_points = 2\n")
    told = named(planned(monkeypatch, tmp_path, "--laser", "--perception", str(file)))["perception"].arguments
    assert told[: told.index(str(file)) + 1] == ("--perception", str(file))
    assert "--perception" not in named(planned(monkeypatch, tmp_path, "--laser"))["perception"].arguments


def test_only_what_drives_is_essential_and_has_priority(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    children = named(planned(monkeypatch, tmp_path, "--margin", "car"))
    assert {name for name, child in children.items() if "--realtime" in child.arguments} == {
        "adaptation",
        "policy",
        "safety_filter",
    }
    assert not children["diagnosis"].essential
    assert not children["workbench"].essential
    assert all(children[name].essential for name in ("adaptation", "policy", "safety_filter", "recorder"))
    words = children["diagnosis"].arguments
    assert [after(words, option) for option in ("--margin", "--model", "--settings")] == ["car"] * 3
    assert after(words, "--versions").endswith("/models"), "what was agreed on outlives the process"


def test_perception_runs_beside_a_car_with_a_laser_and_beside_no_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    without = planned(monkeypatch, tmp_path, "--headless")
    plan = planned(monkeypatch, tmp_path, "--headless", "--laser", "--people", "2")
    assert "perception" not in named(without)
    assert "--laser" not in without.robot_process().arguments
    assert named(plan)["perception"].essential
    assert "--realtime" in named(plan)["perception"].arguments
    assert "--laser" in plan.robot_process().arguments
    assert "--people=2" in plan.robot_process().arguments


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--people", "2"], "without --laser"),
        (["--laser", "--people", "99"], "wanted 0 to 12"),
        (["--laser", "--robot", "pendulum"], "--laser: got one for a pendulum"),
    ],
)
def test_people_and_lasers_where_there_are_none_are_refused(tmp_path: Path, options: list[str], said: str) -> None:
    result = CliRunner().invoke(up.command, ["--headless", "--out", str(tmp_path), *options])
    assert said in str(result.exception)


def test_what_changes_is_the_robot_s_affair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert up.CHANGES == CHANGES
    robot = planned(monkeypatch, tmp_path, "--change", "hitch", "--change-after", "12").robot_process()
    at = robot.arguments.index("--change")
    assert robot.arguments[at : at + 4] == ("--change", "hitch", "--change-after", "12.0")
    assert "--change" not in planned(monkeypatch, tmp_path).robot_process().arguments


def test_a_time_of_the_change_that_cannot_be_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(up.command, ["--change-after", "-1", "--out", str(tmp_path)])
    assert "--change-after: got -1.0" in str(result.exception)


def test_several_robots_have_names_and_scenes_of_their_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plan = planned(monkeypatch, tmp_path, "--robots", "3", "--name", "r7", "--seed", "4")
    assert plan.names == ("r7", "r8", "r9")
    robots = [plan.robot_process(index) for index in range(3)]
    told = [dict(zip(robot.arguments[::2], robot.arguments[1::2], strict=False)) for robot in robots]
    assert [(options["--name"], options["--seed"]) for options in told] == [("r7", "4"), ("r8", "5"), ("r9", "6")]
    assert len({options["--summary"] for options in told}) == len({robot.log for robot in robots}) == 3
    assert planned(monkeypatch, tmp_path, "--name", "ann").names == ("ann",)
    assert planned(monkeypatch, tmp_path, "--name", "ann", "--robots", "2").names == ("ann1", "ann2")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--robots", "0"], "--robots: got 0, wanted 1 to 8"),
        (["--robots", "9"], "--robots: got 9, wanted 1 to 8"),
        (["--robots", "2", "--secure"], "--robots: got more than 1 with --secure"),
    ],
)
def test_robots_that_cannot_be_are_refused(tmp_path: Path, options: list[str], complaint: str) -> None:
    result = CliRunner().invoke(up.command, [*options, "--out", str(tmp_path)])
    assert complaint in str(result.exception)


@pytest.mark.parametrize(
    ("options", "load", "change"),
    [
        ([], "none", ""),
        (["--load", "chair"], "chair", ""),
        (["--load", "none"], "none", ""),
        (["--change", "headwind"], "none", "headwind"),
    ],
)
def test_load_and_change_are_as_asked_and_none_by_default(
    options: list[str], load: str, change: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plan = planned(monkeypatch, tmp_path, "--headless", *options)
    assert (plan.load, plan.change) == (load, change)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--model", "dart_car"], ""),
        (["--model", "dart_car", "--load", "none"], ""),
        (["--model", "dart_car", "--laser"], ""),
        (["--model", "dart_car", "--load", "chair"], "--load: got 'chair' for a car with throttle, steer, whose"),
        (["--model", "dart_car", "--change", "hitch"], "--change: got 'hitch' for a car with throttle, steer, whose"),
        (["--robot", "pendulum", "--load", "chair"], "--load: got one for a pendulum, which has none"),
        (["--model", "car_learned"], ""),
        (["--model", "car_learned", "--rate", "20.1"], ""),  # half a percent is rounding of a period
        (["--model", "car_learned", "--rate", "19"], "--rate: got 19 ticks per second, the model's networks were "),
        (["--model", "car_learned", "--rate", "40"], "--rate: got 40 ticks per second, the model's networks were "),
        (["--model", "car", "--rate", "40"], ""),  # equations hold at any rate
    ],
)
def test_what_a_stand_in_or_a_learned_model_cannot_do_is_refused_and_nothing_else(
    options: list[str], complaint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The throttle's stand-in tows nothing; asked twice as often, networks would say that it goes as far each time."""
    if complaint:
        result = CliRunner().invoke(up.command, ["--headless", "--out", str(tmp_path), *options])
        assert isinstance(result.exception, InputError)
        assert str(result.exception).startswith(complaint)
    else:
        plan = planned(monkeypatch, tmp_path, "--headless", *options)
        assert ("--drive=throttle" in plan.robot_process().arguments) is ("dart_car" in options)


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """driven(code, begun, hurried): the summary of a drive whose supervisor ended so."""

    def run(code: int, *, begun: bool, hurried: bool) -> Any:
        class Supervisor:
            def __init__(self, *_: Any) -> None:
                """Its processes are made up."""

            def run(self) -> int:
                return code

        monkeypatch.setattr("safedpa.bus.ZenohTransport", lambda _: MemoryTransport(MemoryBroker()))
        monkeypatch.setattr("safedpa_services.supervisor.supervisor.Supervisor", Supervisor)
        summary = tmp_path / "robot.json"
        summary.write_text('{"ticks": 7}')
        robot = SimpleNamespace(begun=begun, last_words=lambda: "the motor is on fire", name="robot", pid=1, restarts=2)
        plan: Any = SimpleNamespace(
            services=list, robot_process=lambda: robot, wallet=None, own_session=lambda: None, fleet="f",
            names=("r1",), recording=tmp_path / "drive.mcap", summary=summary, other_summaries={},
        )  # fmt: skip
        stop: Any = SimpleNamespace(hurried=hurried)
        return up.driven(plan, stop, lambda *_: nullcontext(lambda: None))

    return run


def test_a_drive_that_went_well_is_summed_up(driven: Any) -> None:
    found = driven(0, begun=True, hurried=False)
    assert found["ticks"] == 7
    assert found["services"] == [{"name": "robot", "pid": 1, "restarts": 2}]


@pytest.mark.parametrize(("begun", "hurried"), [(True, False), (True, True), (False, False), (False, True)])
def test_a_robot_that_failed_is_reported_by_its_last_words(driven: Any, begun: bool, hurried: bool) -> None:
    with pytest.raises(SafedpaError, match="robot: the motor is on fire"):
        driven(1, begun=begun, hurried=hurried)


@pytest.mark.parametrize("begun", [True, False])
def test_a_second_signal_ends_with_the_status_of_an_interrupt(
    driven: Any, begun: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a shell reports it: 128 and the number of the signal, 2."""
    with pytest.raises(click.exceptions.Exit) as ended:
        driven(0, begun=begun, hurried=True)
    assert ended.value.exit_code == 130
    assert "drive.mcap" in capsys.readouterr().err


def test_a_drive_whose_robot_never_started_is_an_error(driven: Any) -> None:
    with pytest.raises(SafedpaError, match="nothing was driven"):
        driven(0, begun=False, hurried=False)


INSIDE, DOOR = "tls/127.0.0.1:7450", "tls/0.0.0.0:7447"


def card_of(role: str) -> Card:
    return Card(role, b"", b"", b"")


@pytest.fixture
def wallet() -> Any:
    """Shows for each role its name, and hands out its card."""
    return SimpleNamespace(shown=lambda role: (("--role", role), card_of(role)), identity=card_of, cards={})


@pytest.mark.parametrize("door", ["", DOOR])
def test_a_secured_router_listens_at_the_door_and_all_others_connect_on_this_machine_with_their_own_cards(
    door: str, wallet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = replace(planned(monkeypatch, tmp_path), wallet=wallet, endpoint=INSIDE, door=door)
    children = named(plan)
    assert next(iter(children)) == "router", "it starts first and ends last"
    assert after(children["router"].arguments, "--listen") == (door or INSIDE)
    for name, child in children.items():
        if name != "router":
            assert after(child.arguments, "--connect") == INSIDE
            assert (after(child.arguments, "--role"), child.card) == (name, card_of(name))
    assert plan.robot_process().card == card_of(f"robot.{plan.name}")


def test_the_supervisor_joins_a_secured_loop_as_operator_and_is_the_meeting_place_of_a_plain_one(
    wallet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = replace(planned(monkeypatch, tmp_path), endpoint="tcp/127.0.0.1:7450")
    plain = plan.own_session()
    assert (plain.mode, plain.listen, plain.connect, plain.certificates) == ("peer", (plan.endpoint,), (), None)
    secured = replace(plan, endpoint=INSIDE, wallet=wallet).own_session()
    assert (secured.mode, secured.listen, secured.connect) == ("client", (), (INSIDE,))
    assert secured.certificates == card_of("operator")
    assert "router" not in named(plan)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_two_robots_drive_side_by_side(tmp_path: Path) -> None:
    options = ("--robots", "2", "--headless", "--lockstep", "--seconds", "4", "--json", "--out", str(tmp_path))
    command = [sys.executable, "-m", "safedpa_services", "up", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["ticks"] == summary["robots"]["r2"]["ticks"] == 80
    assert sum(summary["verdicts"].values()) == 80, "those of the first robot alone"
