"""``safedpa init``: a log becomes a model that ``safedpa diagnose`` takes at once."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

import safedpa
from safedpa.errors import InputError
from safedpa_lab.own_robots.plants import PLANTS, drive
from safedpa_services.command_line.group import safedpa as command_line


def write_log(path: Path, plant: str, header: str, hidden: dict[str, dict[str, float]], seed: int = 1) -> None:
    """A log of one of the laboratory's robots; the columns in ``header`` are named in the order of the plant's."""
    t, states, actions = drive(PLANTS[plant], hidden, seed)
    table = np.column_stack([t, states, actions])
    names = header.split(",")
    kept = [at for at, name in enumerate(names) if name]
    np.savetxt(path, table[:, kept], "%.6g", ",", header=",".join(names[at] for at in kept), comments="")


@pytest.mark.parametrize(
    ("plant", "header", "hidden", "kind", "found"),
    [
        ("own_servo", "t,angle,,target", {"target_delay": {"seconds": 0.12}}, None, "target_delay"),
        ("own_joint", "t,q,dq,current", {"rate_friction": {"deceleration": 1.5}}, {"q": "joint"}, "dq_friction"),
    ],
)
@pytest.mark.long
def test_the_printed_command_diagnoses_the_proposed_model(
    plant: str, header: str, hidden: dict[str, dict[str, float]], kind: dict[str, str] | None, found: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "log.csv", plant, header, hidden)
    robot = f"started_{plant}"
    assert command_line.run(["init", "log.csv", "--out", "started", "--robot", robot, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert kind in (None, answer["bases"])
    program, *arguments = shlex.split(answer["next"])
    assert program == "safedpa"
    assert command_line.run([*arguments, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert found in {name for stage in report["stages"] for name in stage["effects"]}


@pytest.mark.parametrize(
    ("plant", "header", "states", "kinds"),
    [
        ("own_motor", "time_ms,speed,voltage", ("speed",), {"speed": "first_order"}),
        ("own_conveyor", "t,v,v_target", ("v",), {"v": "first_order"}),
        pytest.param(
            *("own_quadrotor", "t,vx,vy,vz,thrust,pitch,roll", ("vx", "vy", "vz"), {"vx": "multirotor"}),
            marks=pytest.mark.long,
        ),
        pytest.param(
            "own_boat",
            "t,x,y,yaw,surge,turn,thrust,rudder",
            ("x", "y", "yaw", "surge", "turn"),
            {"x": "planar"},
            marks=pytest.mark.long,
        ),
    ],
)
def test_commands_and_the_base_are_recognised(
    plant: str, header: str, states: tuple[str, ...], kinds: dict[str, str], tmp_path: Path
) -> None:
    write_log(tmp_path / "log.csv", plant, header, {})
    if "time_ms" in header:
        table = np.loadtxt(tmp_path / "log.csv", delimiter=",", skiprows=1) * ([1000.0] + [1.0] * header.count(","))
        np.savetxt(tmp_path / "log.csv", table, "%.6g", ",", header=header, comments="")
    started = safedpa.init(tmp_path / "log.csv", tmp_path / "out", robot=f"a_{plant}")
    assert (started.system.state_names, started.kinds) == (states, kinds)
    assert started.error < 0.1
    assert started.unused == ()


@pytest.mark.parametrize("base", ["coupled", pytest.param(None, marks=pytest.mark.long)])
def test_a_state_that_another_one_drives_gets_a_coupled_base(base: str | None, tmp_path: Path) -> None:
    """A voltage drives a current and the current a speed, which acts back: exact between rows, with noise."""
    random = np.random.default_rng(1)
    voltage = np.repeat(random.uniform(-10.0, 10.0, 30), 20)
    # i' = 4 u - 10 i - 0.8 w, w' = 20 i - 1.5 w, in steps of a tenth of a period of 0.02 s
    now, rows = np.zeros(2), []
    for u in voltage:
        rows.append(now)
        for _ in range(10):
            now = now + 0.002 * np.array([4.0 * u - 10.0 * now[0] - 0.8 * now[1], 20.0 * now[0] - 1.5 * now[1]])
    noisy = np.array(rows) + random.normal(0.0, [0.02, 0.2], (len(rows), 2))
    table = np.column_stack([0.02 * np.arange(len(rows)), noisy, voltage])
    np.savetxt(tmp_path / "log.csv", table, "%.6g", ",", header="time_s,i_A,speed_rad_s,cmd_V", comments="")
    roles = {"states": {"i": "i_A", "speed": "speed_rad_s"}, "actions": {"volts": "cmd_V"}}
    started = safedpa.init(tmp_path / "log.csv", tmp_path / "out", **roles, base=base, robot="two_stage_motor")
    assert started.kinds == {"i": "coupled"}
    assert started.error < 0.2
    safedpa.list_effects(effects=tmp_path / "out" / "robot.py")
    values = {path: one.value for path, one in safedpa.load_model(tmp_path / "out" / "model.toml").settings.items()}
    assert "base.speed_by_volts" not in values  # the voltage drives the speed by the current only
    assert values["base.speed_by_i"] == pytest.approx(20.0, rel=0.1)
    assert values["base.i_by_volts"] == pytest.approx(4.0, rel=0.1)


def test_named_columns_a_named_base_and_the_parameters_of_the_plant(tmp_path: Path) -> None:
    write_log(tmp_path / "log.csv", "own_joint", "t,c1,c2,c3", {})
    roles = {"states": {"angle": "c1", "omega": "c2"}, "actions": {"current": "c3"}}
    write_log(tmp_path / "other.csv", "own_joint", "t,c1,c2,c3", {}, seed=2)
    logs = [tmp_path / "log.csv", tmp_path / "other.csv"]
    started = safedpa.init(logs, tmp_path / "out", **roles, base="joint", robot="named")
    assert started.system.state_names == ("angle", "omega"), "the rate is recognised by its values"
    safedpa.list_effects(effects=tmp_path / "out" / "robot.py")  # loads the file
    model = safedpa.load_model(tmp_path / "out" / "model.toml")
    values = [setting.value for setting in model.settings.values()]
    assert values == pytest.approx([2.1, 6.2], rel=0.03)
    with pytest.raises(InputError, match="exists"):
        safedpa.init(tmp_path / "log.csv", tmp_path / "out", **roles, robot="named_again")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"base": "jont"}, "joint"),
        ({"states": {"angle": "c9"}}, "no column 'c9'"),
        ({"robot": "car"}, "known already"),
        ({}, "name one with --action"),
        ({"actions": {"u": "c3"}, "base": "bicycle"}, "needs other states"),
    ],
)
def test_a_proposal_that_cannot_be_made_says_what_is_wanted(
    options: dict[str, object], message: str, tmp_path: Path
) -> None:
    t = np.arange(0.0, 10.0, 0.05)
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.sin(0.7 * t)])
    np.savetxt(tmp_path / "log.csv", rows, "%.6g", ",", header="t,c1,c2,c3", comments="")
    with pytest.raises(InputError, match=message):
        safedpa.init(tmp_path / "log.csv", tmp_path / "out", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_a_named_state_that_no_command_moves_is_refused(tmp_path: Path) -> None:
    t = np.arange(0.0, 20.0, 0.05)
    left, right = (np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, 40), 10) for seed in (4, 5))
    rows = np.column_stack([t, 0.05 * np.cumsum(left + right), np.sin(2.0 * t), left, right])
    np.savetxt(tmp_path / "log.csv", rows, "%.6g", ",", header="t,moved,alone,left,right", comments="")
    roles = {"states": {"moved": "moved", "alone": "alone"}, "actions": {"left": "left", "right": "right"}}
    with pytest.raises(InputError, match="no base moves alone by left, right"):
        safedpa.init(tmp_path / "log.csv", tmp_path / "out", **roles)
    assert not (tmp_path / "out").exists()
