"""Robots of the user's own, outside the package: checked, driven by nodes and by processes, diagnosed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.check_robot import check_robot
from safedpa.dynamics import load_model, load_user_file
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FunctionBarrier
from safedpa.safety.defaults import settings_named
from safedpa.stand_in import world_number
from safedpa.systems import systems
from safedpa.systems.robots import robot_named, robots
from safedpa_services.command_line.group import safedpa
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.stand_in_robot import StandInRobot

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
STRANGER = """from safedpa.systems import System, Variable
DRONE = System("drone", (Variable("height", "m", 0.0, 9.0),), ())
"""
"""A system of a name that a robot bears as well."""
WORLDS = {"drone": {"wind": 1.5}, "cleaner": {"pull": 0.5, "lag": 0.06}}
FILES = {name: EXAMPLES / name / f"{name}.py" for name in WORLDS}


@pytest.fixture(scope="module", params=sorted(WORLDS))
def name(request: pytest.FixtureRequest) -> str:
    """Returns the name of a robot, which is registered from now on."""
    load_user_file(FILES[request.param])
    return str(request.param)


@pytest.mark.long
def test_nothing_is_wrong_with_it(name: str) -> None:
    found = check_robot(robot_named(name))
    assert [str(one) for one in found if not one.ends_well] == []
    assert {"system", "model", "settings", "barriers", "filter", "controllers", "draw"} <= {one.part for one in found}


@pytest.mark.long
def test_it_reaches_goals_and_touches_nothing_in_a_world_that_no_model_knows(name: str) -> None:
    robot, model = robot_named(name), load_model(str(robot_named(name).model))
    simulated = StandInRobot(robot, 1.0 / robot.rate, 1, WORLDS[name])
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named(name))]
    statuses = {tick.verdict.status for tick in drive(simulated, nodes, round(15 * robot.rate))}
    assert simulated.collisions == []
    assert simulated.goals_reached >= 2
    assert statuses <= {"passed", "corrected"}


def test_settings_of_another_robot_are_refused(name: str) -> None:
    model = load_model(str(robot_named(name).model))
    for other in set(robots()) - {name}:
        with pytest.raises(InputError, match="settings: made for the system"):
            SafetyFilterNode(model, settings_named(other))


@pytest.mark.long
@pytest.mark.processes
def test_up_drives_it_and_its_recording_contains_the_hidden_parameters(name, tmp_path, capfd):
    file, out = FILES[name], tmp_path / "runs"
    world = [word for key, value in WORLDS[name].items() for word in ("--world", f"{key}={value}")]
    phrase = ["up", "--robot-file", str(file), "--lockstep", "--headless", "--seconds", "6", "--json"]
    assert safedpa.run([*phrase, *world, "--seed", "1", "--out", str(out)]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["collisions"] == 0, summary
    (recording,) = out.glob("*/recording.mcap")
    page = tmp_path / "page"
    plain = str(file.with_name("plain.toml"))
    phrase = ["diagnose", plain, str(recording), "--robot-file", str(file), "--json", "--out", str(page)]
    assert safedpa.run(phrase) == 0
    report = json.loads(capfd.readouterr().out)
    taken = [one for one in report["candidates"] if one["decision"] == "accepted"]
    named = {*report["added"], *(twin for one in taken for twin in one["indistinguishable_from"])}
    assert {"drone": "ax_offset", "cleaner": "pull"}[name] in named


def test_a_file_without_a_robot_and_one_that_lacks_something_are_reported_in_a_line(tmp_path, capsys):
    empty, half = tmp_path / "empty.py", tmp_path / "half.py"
    empty.write_text("from safedpa.effects import general_effects\n", encoding="utf-8")
    half.write_text("from safedpa.robot import AbstractRobot\nclass Half(AbstractRobot):\n    rate = 1.0\n", "utf-8")
    for file, notice in ((empty, "wanted a class derived from"), (half, "class Half: 'bases' is missing")):
        assert safedpa.run(["check", str(file)]) == 2
        line = capsys.readouterr().err
        assert notice in line
        assert line.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new", "notice"),
    [
        ("    system = SYSTEM\n    rate", "    system = None\n    rate", "class Cleaner: system: got NoneType"),
        ("rate = 20.0", "rate = 0.0", "class Cleaner: rate: got 0.0, wanted ticks a second"),
        ("rate = 20.0", "rate = 'fast'", "class Cleaner: rate: got 'fast', wanted a finite number"),
        ('kinds = ("obstacle", "wall")', 'kinds = "wall"', "class Cleaner: kinds: got 'wall', wanted a tuple"),
        ("barrier_settings = (", "barrier_settings = {}, (", "wanted a tuple of BarrierSetting"),
        ("return {Wheels.kind: Wheels}", "return [Wheels]", "wanted a table of base models by kind"),
        ("return {Wheels.kind: Wheels}", "return {Wheels.kind: Wheels()}", "wanted a table of base models by kind"),
        ("    rate = 20.0", "    rate = 20.0\n    def __init__(self, port): pass", "failed with TypeError"),
        ("class Pull", "raise SystemExit(0)\nclass Pull", "could not be run: SystemExit"),
        ("(0.003, 0.003, 0.005)", "None", "measurement_deviation: got None, wanted one number for each"),
        ("(0.003, 0.003, 0.005)", "(0.0, 0.003, 0.005)", "measurement_deviation: got (0.0, 0.003, 0.005), wanted a"),
        ("(0.003, 0.003, 0.005)", "(0.1, float('nan'), 0.1)", "wanted a positive number for each of x, y, yaw"),
        pytest.param(
            "return Frame((",
            "return 3\n        return Frame((",
            "frame: got int, wanted a Frame",
            marks=pytest.mark.long,
        ),
        ("return Frame((", "1 / 0\n        return Frame((", "frame: raised ZeroDivisionError"),
        ("return Drive(seed, **given)", "return None", "stand_in: got NoneType, wanted an AbstractStandIn"),
        pytest.param(
            'FASTEST_TURN)), "goal_seeker"', "FASTEST_TURN))", "wanted the action and a name", marks=pytest.mark.long
        ),
        pytest.param(
            "return (FASTEST * max",
            "return 1.0, 'one'\n        return (FASTEST * max",
            "returned 1.0, wanted 2 numbers",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "return (FASTEST * max",
            "return 'ab', 'ab'\n        return (FASTEST * max",
            "nominal: got str",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_mistake_of_any_sort_is_reported_in_a_line(tmp_path, capsys, old, new, notice):
    source = FILES["cleaner"].read_text(encoding="utf-8")
    assert old in source
    (tmp_path / "cleaner.toml").write_bytes((FILES["cleaner"].parent / "cleaner.toml").read_bytes())
    file = tmp_path / "robot.py"
    file.write_text(source.replace(old, new, 1), encoding="utf-8")
    try:
        assert safedpa.run(["check", str(file)]) == 2
    finally:
        load_user_file(FILES["cleaner"])
    reported = capsys.readouterr()
    lines = [line for line in (reported.out + reported.err).splitlines() if notice in line]
    assert len(lines) == 1
    assert "Traceback" not in reported.err


def _raises(*_: object) -> None:
    raise ZeroDivisionError("a tree of no size")


def _not_a_number(*_: object) -> list[FunctionBarrier]:
    return [FunctionBarrier(lambda x: float("nan") * x[0], kind="tree")]


def _of_another_robot(*_: object) -> list[FunctionBarrier]:
    return [FunctionBarrier(lambda x: x[0], kind="tree", reads=("x", "y", "yaw"))]


@pytest.mark.parametrize(
    ("broken", "notice"),
    [
        (_raises, "ZeroDivisionError: a tree of no size (test_own_robots.py, line "),
        (_not_a_number, "NaN"),
        (lambda *_: [], "no barrier"),
        (lambda *_: [1.0], "AbstractBarrier"),
        (_of_another_robot, "reads the states x, y, yaw"),
    ],
)
def test_a_defect_of_its_own_barriers_is_reported_and_the_backup_acts(broken, notice, monkeypatch):
    load_user_file(FILES["drone"])
    robot, model = robot_named("drone"), load_model(str(robot_named("drone").model))
    monkeypatch.setattr(type(robot), "barriers", broken)
    simulated = StandInRobot(robot, 0.04, 1)
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("drone"))]
    ticks = list(drive(simulated, nodes, 5))
    assert {tick.verdict.status for tick in ticks} == {"fallback"}
    assert notice in ticks[-1].verdict.sentence
    assert np.hypot(*simulated.values[2:]) < 0.1
    assert [one for one in check_robot(robot) if not one.ends_well]


def test_the_newest_file_defines_what_a_name_refers_to(tmp_path: Path) -> None:
    """A system alone, then a robot of that name, the same file twice, and the system again."""
    alone = tmp_path / "alone.py"
    alone.write_text(STRANGER, encoding="utf-8")
    load_user_file(alone)
    for _ in range(2):
        load_user_file(FILES["drone"])
        assert robots()["drone"].system is systems()["drone"]
        assert systems()["drone"].state_names == ("x", "y", "vx", "vy")
    load_user_file(alone)
    assert "drone" not in robots()
    assert systems()["drone"].state_names == ("height",)


def test_an_unknown_parameter_of_a_simulation_is_refused_by_name() -> None:
    load_user_file(FILES["drone"])
    with pytest.raises(InputError, match="does not take --world rain=2"):
        StandInRobot(robot_named("drone"), 0.04, 0, {"rain": 2.0})
    for wrong in ("wind", "wind=", "wind=nan", "wind=inf", "=1", "wi nd=1"):
        with pytest.raises(InputError, match="wanted NAME=NUMBER"):
            world_number(wrong)


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize(
    ("value", "notice"),
    [
        ("stranger_gone:ROBOT", "cannot be loaded"),
        ("stranger_glider:SYSTEM", "wanted an Abstract"),
        ("stranger_glider:ROBOT", "25.0"),
    ],
)
def test_the_robot_of_another_distribution_is_known_and_a_broken_one_is_a_sentence(value, notice, tmp_path):
    """A process looks for installed robots once."""
    info = tmp_path / "stranger-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[safedpa.robots]\nglider = {value}\n", encoding="utf-8")
    source = FILES["drone"].read_text(encoding="utf-8").replace('"drone"', '"glider"')
    (tmp_path / "stranger_glider.py").write_text(source + "\n\nROBOT = Drone()\n", encoding="utf-8")
    asked = "from safedpa.systems.robots import robots\ntry: print(robots()['glider'].rate)\n"
    asked += "except Exception as e: print(e)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run([sys.executable, "-c", asked], env=environment, capture_output=True, text=True, check=True)
    assert notice in done.stdout
    assert done.stdout.count("\n") == 1
