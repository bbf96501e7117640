"""The processes of a loop, which of them are essential, and how a drive ends."""

import json
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from safedpa.bus import MemoryBroker, MemoryTransport
from safedpa.bus.security.certificates import PemCredentials
from safedpa.errors import SafedpaError
from safedpa_services.command_line import up
from safedpa_sim.robots import CHANGES, TASKS

LOOP = {"adaptation", "policy", "safety_filter"}
INSIDE, DOOR = "tls/127.0.0.1:7450", "tls/0.0.0.0:7447"


@pytest.fixture
def planned(monkeypatch, tmp_path):
    """planned(*options): the plan that ``safedpa up`` makes from its options; nothing is started."""

    def run(*options):
        seen = []
        with monkeypatch.context() as patch:
            patch.setattr(up, "run_plan", lambda plan, *_: seen.append(plan) or {"recording_error": None})
            result = CliRunner().invoke(up.command, ["--json", "--out", str(tmp_path), *options])
        assert result.exception is None, result.output
        return seen[0]

    return run


def named(plan):
    return {child.name: child for child in plan.services()}


def after(phrase, option):
    return phrase[phrase.index(option) + 1]


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
def test_the_diagnosis_runs_unless_only_a_summary_is_wanted(planned, options, wanted):
    children = named(planned(*options))
    assert ("diagnosis" in children) is wanted
    assert ("workbench" in children) is (wanted and "--headless" not in options)


def test_only_what_drives_is_essential_and_has_priority(planned):
    children = named(planned("--margin", "car"))
    assert {name for name, child in children.items() if "--realtime" in child.arguments} == LOOP
    assert not children["diagnosis"].essential
    assert not children["workbench"].essential
    assert all(children[name].essential for name in (*LOOP, "recorder"))
    phrase = children["diagnosis"].arguments
    assert [after(phrase, option) for option in ("--margin", "--model", "--settings")] == ["car"] * 3
    assert after(phrase, "--versions").endswith("/models"), "what was agreed on outlives the process"


def test_perception_runs_with_a_laser_only_and_gets_its_settings_file(planned, tmp_path):
    without = planned("--headless")
    assert "perception" not in named(without)
    assert "--laser" not in without.robot_process().arguments
    plan = planned("--headless", "--laser", "--people", "2")
    assert named(plan)["perception"].essential
    assert "--realtime" in named(plan)["perception"].arguments
    assert "--perception" not in named(plan)["perception"].arguments
    assert {"--laser", "--people=2"} <= set(plan.robot_process().arguments)
    file = tmp_path / "perception.toml"
    file.write_text("[perception]\nmin_points = 2\n")
    reported = named(planned("--headless", "--laser", "--perception", str(file)))["perception"].arguments
    assert after(reported, "--perception") == str(file)


def test_several_robots_have_names_and_scenes_of_their_own(planned):
    plan = planned("--robots", "3", "--name", "r7", "--seed", "4")
    assert plan.names == ("r7", "r8", "r9")
    robots = [plan.robot_process(index) for index in range(3)]
    reported = [(after(robot.arguments, "--name"), after(robot.arguments, "--seed")) for robot in robots]
    assert reported == [("r7", "4"), ("r8", "5"), ("r9", "6")]
    assert len({after(robot.arguments, "--summary") for robot in robots}) == len({robot.log for robot in robots}) == 3
    assert planned("--name", "ann").names == ("ann",)
    assert planned("--name", "ann", "--robots", "2").names == ("ann1", "ann2")


@pytest.mark.parametrize(
    ("options", "load", "change"),
    [
        ([], "none", ""),
        (["--load", "chair"], "chair", ""),
        (["--load", "none"], "none", ""),
        (["--change", "headwind", "--change-after", "12"], "none", "headwind"),
    ],
)
def test_load_and_change_are_as_asked_and_none_by_default(planned, options, load, change):
    plan = planned("--headless", *options)
    assert (plan.load, plan.change) == (load, change)
    phrase = plan.robot_process().arguments
    assert after(phrase, "--load") == load
    assert ("--change" in phrase) is bool(change)
    if change:
        assert (after(phrase, "--change"), after(phrase, "--change-after")) == (change, "12.0")


def test_the_command_knows_all_changes_and_tasks_of_the_simulated_robots():
    assert up.CHANGES == CHANGES
    assert set(up.TASKS) == set(TASKS)


@pytest.mark.parametrize(
    "options",
    [
        ["--model", "dart_car"],
        ["--model", "dart_car", "--load", "none"],
        ["--model", "dart_car", "--laser"],
        ["--model", "car_learned"],
        ["--model", "car_learned", "--rate", "20.1"],  # half a percent is rounding of a period
        ["--model", "car", "--rate", "40"],  # equations hold at any rate
    ],
)
def test_what_a_stand_in_and_a_learned_model_can_do_is_not_refused(planned, options):
    assert ("--drive=throttle" in planned("--headless", *options).robot_process().arguments) is ("dart_car" in options)


def test_model_settings_and_rate_are_the_robots_own(planned):
    plan = planned("--headless", *["--robot", "pendulum", "--wind", "4", "--wind-direction", "135", "--task", "swing"])
    assert (plan.model, plan.settings, plan.rate) == ("pendulum", "pendulum", 100.0)
    assert set(plan.surroundings) == {"--task=swing", "--wind=4.0", "--wind-direction=135.0"}
    assert set(plan.surroundings) < set(plan.robot_process().arguments)
    car = planned("--headless")
    assert (car.model, car.settings, car.rate, car.surroundings) == ("car", "car", 20.0, ())


# with certificates


def card_of(role):
    return PemCredentials(role, b"", b"", b"")


@pytest.fixture
def certificates():
    """Returns the options and the credentials of each role."""
    return SimpleNamespace(options_of=lambda role: (("--role", role), card_of(role)), identity=card_of, credentials={})


@pytest.mark.parametrize("door", ["", DOOR])
def test_the_router_listens_at_its_endpoint_and_all_others_connect_locally_with_their_own_credentials(
    planned, door, certificates
):
    plan = replace(planned(), certificates=certificates, endpoint=INSIDE, listen=door)
    children = named(plan)
    assert next(iter(children)) == "router", "it starts first and ends last"
    assert after(children.pop("router").arguments, "--listen") == (door or INSIDE)
    for name, child in children.items():
        assert after(child.arguments, "--connect") == INSIDE
        assert (after(child.arguments, "--role"), child.credentials) == (name, card_of(name))
    assert plan.robot_process().credentials == card_of(f"robot.{plan.name}")


def test_the_supervisor_joins_a_secured_loop_as_operator_and_listens_in_a_plain_one(planned, certificates):
    plan = replace(planned(), endpoint="tcp/127.0.0.1:7450")
    plain = plan.own_session()
    assert (plain.mode, plain.listen, plain.connect, plain.certificates) == ("peer", (plan.endpoint,), (), None)
    secured = replace(plan, endpoint=INSIDE, certificates=certificates).own_session()
    assert (secured.mode, secured.listen, secured.connect) == ("client", (), (INSIDE,))
    assert secured.certificates == card_of("operator")
    assert "router" not in named(plan)


# the end of a drive


@pytest.mark.parametrize(
    ("code", "begun", "hurried", "error"),
    [
        (0, True, False, None),
        (0, False, False, "nothing was driven"),
        *((1, begun, hurried, "robot: the motor is on fire") for begun in (True, False) for hurried in (True, False)),
        (0, True, True, "130"),
        (0, False, True, "130"),
    ],
)
def test_a_drive_ends_with_its_summary_its_robots_last_log_line_or_the_status_of_an_interrupt(
    code, begun, hurried, error, monkeypatch, tmp_path, capsys
):
    """A second signal gives the exit code of shells: 128 plus the signal's number, 2."""
    ended = SimpleNamespace(run=lambda: code)
    monkeypatch.setattr("safedpa.bus.ZenohTransport", lambda _: MemoryTransport(MemoryBroker()))
    monkeypatch.setattr("safedpa_services.supervisor.supervisor.Supervisor", lambda *_: ended)
    (tmp_path / "robot.json").write_text('{"ticks": 7}')
    last = {"last_text": lambda: "the motor is on fire", "cause": "it burnt"}
    robot = SimpleNamespace(has_begun=begun, name="robot", pid=1, restarts=2, **last)
    plan = SimpleNamespace(
        services=list, robot_process=lambda: robot, certificates=None, own_session=lambda: None, fleet="f",
        names=("r1",), recording=tmp_path / "drive.mcap", summary=tmp_path / "robot.json", other_summaries={},
    )  # fmt: skip
    drive = (plan, SimpleNamespace(hurried=hurried), lambda *_: nullcontext(lambda: None))
    if error is None:
        found = up.run_plan(*drive)
        assert found["ticks"] == 7
        assert found["services"] == [{"name": "robot", "pid": 1, "restarts": 2, "cause": "it burnt"}]
    elif error == "130":
        with pytest.raises(click.exceptions.Exit) as raised:
            up.run_plan(*drive)
        assert raised.value.exit_code == 130
        assert "drive.mcap" in capsys.readouterr().err
    else:
        with pytest.raises(SafedpaError, match=error):
            up.run_plan(*drive)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_two_robots_drive_side_by_side(tmp_path):
    options = ("--robots", "2", "--headless", "--lockstep", "--seconds", "4", "--json", "--out", str(tmp_path))
    command = [sys.executable, "-m", "safedpa_services", "up", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["ticks"] == summary["robots"]["r2"]["ticks"] == 80
    assert sum(summary["verdicts"].values()) == 80, "those of the first robot alone"
