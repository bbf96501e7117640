"""Systems of the user, effects that every system has, and the point robot."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose, library_for
from safedpa.diagnosis.fit.heldout import heldout_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.fit.trial import tried
from safedpa.diagnosis.search.search import searched
from safedpa.dynamics import load_model, load_own
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.records.write import write_columns
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa

DOCS = Path(__file__).parents[2] / "docs"
BALL = DOCS / "examples" / "falling_ball.py"
MODEL = DOCS / "examples" / "falling_ball.toml"
GRASS = re.findall(r"```python\n(.*?)```", (DOCS / "effects.md").read_text(encoding="utf-8"), flags=re.DOTALL)[0]


@pytest.fixture(scope="module")
def drops(tmp_path_factory):
    root = Path(os.environ.get("SAFEDPA_DATA", Path(__file__).parents[3] / "shared" / "data"))
    table = root / "ball_drops" / "ball_drops.csv"
    if not table.is_file():
        pytest.skip(f"no real logs in {root}; set SAFEDPA_DATA to the folder that holds them")
    folder = tmp_path_factory.mktemp("drops")
    found = defaultdict(list)
    with table.open(encoding="utf-8", newline="") as file:
        for number, t, height, velocity, ball in list(csv.reader(file))[1:]:
            found[ball, number].append(f"{t},{height},{velocity}\n")
    for (ball, number), lines in found.items():
        path = folder / f"{ball.replace(' ', '_').lower()}-{number}.csv"
        path.write_text("t,height,velocity\n" + "".join(lines), encoding="utf-8")
    return folder


def diagnosed(runs, out, capsys):
    arguments = ["diagnose", str(MODEL), *map(str, runs), "--effects", str(BALL), "--horizon", "0.5"]
    assert safedpa.run([*arguments, "--out", str(out), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_page_shows_the_files_as_they_are():
    page = (DOCS / "own-system.md").read_text(encoding="utf-8")
    assert BALL.read_text(encoding="utf-8").strip() in page
    assert MODEL.read_text(encoding="utf-8").strip() in page


def test_a_bowling_ball_lacks_nothing(drops, tmp_path, capsys):
    document = diagnosed(sorted(drops.glob("bowling_ball-*.csv")), tmp_path, capsys)
    assert document["verdict"] == "nothing_missing"
    assert document["added"] == []


@pytest.mark.parametrize("ball", ["whiffle_ball_1", "whiffle_ball_2", "yellow_whiffle_ball"])
def test_a_whiffle_ball_lacks_quadratic_drag(ball, drops, tmp_path, capsys):
    document = diagnosed(sorted(drops.glob(f"{ball}-*.csv")), tmp_path, capsys)
    assert document["added"] == ["quadratic_drag"]
    assert document["stages"][1]["heldout_error"] < 0.4 * document["stages"][0]["heldout_error"]
    assert 0.02 < document["parameters"]["quadratic_drag.coefficient"]["value"] < 0.08
    model = load_model(tmp_path / "model.toml")
    assert [item.name for item in model.effects] == ["quadratic_drag"]
    assert (tmp_path / "report.html").stat().st_size > 1000


def falls(coefficient, seed):
    """Rows of a drop with drag by the square, every 0.05 s for 3 s: the terminal-speed solution, and noise."""
    t = 0.05 * np.arange(60)
    terminal = np.sqrt(9.81 / coefficient)
    velocity = -terminal * np.tanh(9.81 * t / terminal)
    height = 60.0 - terminal**2 / 9.81 * np.log(np.cosh(9.81 * t / terminal))
    noise = np.random.default_rng(seed).normal(0.0, [[0.01], [0.05]], (2, len(t)))
    return np.column_stack([t, height + noise[0], velocity + noise[1]])


@pytest.fixture
def simulated(tmp_path):
    paths = []
    for seed in range(3):
        paths.append(tmp_path / f"drop_{seed}.csv")
        np.savetxt(paths[-1], falls(0.05, seed), delimiter=",", header="t,height,velocity", comments="")
    return paths


@pytest.mark.long
def test_every_command_takes_a_system_of_the_user(simulated, tmp_path, capsys):
    own, runs = ["--effects", str(BALL)], [str(path) for path in simulated]
    assert safedpa.run(["effects", "--robot", "ball", "--json", *own]) == 0
    assert {item["name"] for item in json.loads(capsys.readouterr().out)["effects"]} == {"quadratic_drag"}
    assert safedpa.run(["compare", str(MODEL), *runs, *own, "--horizon", "0.5", "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["error"] > 0
    document = diagnosed(simulated, tmp_path / "found", capsys)
    assert document["added"] == ["quadratic_drag"]
    value = document["parameters"]["quadratic_drag.coefficient"]
    assert abs(value["value"] - 0.05) < max(4.0 * value["std"], 0.002)
    out = tmp_path / "with_drag.toml"
    added = ["add", str(MODEL), "quadratic_drag", *runs, *own, "--horizon", "0.5", "--out", str(out), "--json"]
    assert safedpa.run(added) == 0
    assert json.loads(capsys.readouterr().out)["after"] < 0.3 * document["stages"][0]["heldout_error"]
    table = tmp_path / "predicted.csv"
    assert safedpa.run(["predict", str(out), runs[0], *own, "--horizon", "0.5", "--out", str(table)]) == 0
    assert table.read_text(encoding="utf-8").startswith("start_t,t,height,velocity")


def test_the_environment_variable_serves_every_process(tmp_path):
    script = "from safedpa.dynamics import load_model; import sys; print(load_model(sys.argv[1]).system.name)"
    environment = {**os.environ, "SAFEDPA_EFFECTS": str(BALL)}
    done = subprocess.run(
        [sys.executable, "-c", script, MODEL], capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout.strip() == "ball", done.stderr


def test_an_entry_point_serves_every_process(tmp_path):
    """An installed package as pip leaves it: a module and its metadata on the path."""
    shutil.copy(BALL, tmp_path / "our_ball.py")
    metadata = tmp_path / "our_ball-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: our-ball\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[safedpa.effects]\nours = our_ball\n")
    script = (
        "from safedpa.dynamics import load_model; from safedpa.effects import effects_of; import sys;"
        "print(load_model(sys.argv[1]).system.name, *effects_of('ball'))"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", script, MODEL], capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout.split() == ["ball", "quadratic_drag"], done.stderr


@pytest.mark.long
def test_an_effect_of_the_user_is_found_in_a_log_and_written_to_the_model(tmp_path, capsys):
    """Rolling resistance is taken out of the library: what remains is the user's own, the same law by another name."""
    own = tmp_path / "grass.py"
    own.write_text(GRASS, encoding="utf-8")
    hidden = {"rolling_resistance": {"deceleration": 0.5}}
    log = write_case(Case("test", 5, hidden, runs=3, seconds=20.0), tmp_path / "log")
    out = tmp_path / "with_grass.toml"
    runs = [str(path) for path in log.runs]
    arguments = ["add", str(log.model), "grass_resistance", *runs, "--effects", str(own), "--out", str(out), "--json"]
    assert safedpa.run(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < 0.4 * document["before"]
    assert abs(document["parameters"]["grass_resistance.deceleration"]["value"] - 0.5) < 0.1
    assert [item.name for item in load_model(out).effects] == ["grass_resistance"]


TEXT = BALL.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TEXT.replace('"height": state["velocity"], ', ""), "rates: got velocity, wanted one rate for each state"),
        (TEXT.replace('parameters["gravity"]', 'parameters["gravty"]'), "rates: failed with KeyError: 'gravty'"),
        (TEXT.replace('name="ball"', 'name="car"'), "system 'car' ships with the project"),
        (TEXT.replace('Variable("velocity"', 'Variable("height"'), "'height' stands twice"),
        (TEXT.replace('Variable("height"', 'Variable("t"'), "'t' stands twice"),
        ("x = 1\n", "got no effect, wanted a class derived from"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(text, message, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(text.replace('"ball"', '"ball2"'), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_own(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_of_an_unknown_robot_names_the_option(tmp_path, capsys):
    path = tmp_path / "model.toml"
    path.write_text(MODEL.read_text(encoding="utf-8").replace('"ball"', '"kite"'), encoding="utf-8")
    assert safedpa.run(["compare", str(path), "run.csv"]) == 2
    assert "--effects FILE.py" in capsys.readouterr().err


NOISE = np.array([0.001, 0.001, 0.002, 0.005, 0.005])
HIDDEN = {
    "constant_force": {"ax": 0.3, "ay": -0.2},
    "viscous_drag": {"coefficient": 0.6},
    "quadratic_drag": {"coefficient": 0.5},
    "payload": {"mass_ratio": 0.4},
    "actuator_gain": {"gain": 0.8},
    "actuator_delay": {"seconds": 0.1},
}


def driven(hidden, seed, seconds=20.0, period=0.02, substeps=4):
    """The robot simulated in steps of 5 ms, with steps of thrust and turn, measured with noise."""
    random = np.random.default_rng(seed)
    rows, mass = round(seconds / period), 0.005189
    hold = round(0.5 / period)
    thrust = np.repeat(random.uniform(-0.006, 0.008, -(-rows // hold)), hold)[:rows]
    turn = np.repeat(random.uniform(-2.0, 2.0, -(-rows // hold)), hold)[:rows]
    value = lambda name, key, neutral=0.0: hidden.get(name, {}).get(key, neutral)  # noqa: E731
    late = round(value("actuator_delay", "seconds") / period)
    x, y, yaw, vx, vy = random.uniform(-0.5, 0.5, 5)
    states = []
    for row in range(rows):
        states.append((x, y, yaw, vx, vy))
        sent = max(row - late, 0)
        push = value("actuator_gain", "gain", 1.0) * thrust[sent] / mass
        for _ in range(substeps):
            step = period / substeps
            drag = value("viscous_drag", "coefficient") + value("quadratic_drag", "coefficient") * np.hypot(vx, vy)
            middle = yaw + 0.5 * step * turn[sent]
            own = 1.0 + value("payload", "mass_ratio")
            ax = (push * np.cos(middle) + value("constant_force", "ax") - drag * vx) / own
            ay = (push * np.sin(middle) + value("constant_force", "ay") - drag * vy) / own
            x, y = x + step * (vx + 0.5 * step * ax), y + step * (vy + 0.5 * step * ay)
            vx, vy, yaw = vx + step * ax, vy + step * ay, yaw + step * turn[sent]
    model = load_model("point")
    measured = np.array(states) + random.normal(0.0, 1.0, (rows, 5)) * NOISE
    actions = np.column_stack([thrust, turn])
    return Run(f"run{seed}", model.system, period * np.arange(rows), measured, actions, (Stretch(0, rows),))


@pytest.mark.parametrize("name", HIDDEN)
def test_each_hidden_effect_fits_best_and_with_its_size(name):
    given = load_model("point")
    runs = [driven({name: HIDDEN[name]}, seed, 12.0) for seed in (11, 12)]
    search = searched(given, [], shooting_of(runs, 0.5), heldout_of(runs, 0.5))
    trials = [tried(search.current, [item], search.shooting) for item in library_for(given)]
    best = min(trials, key=lambda trial: trial.loss)
    # thrust / mass: a heavier robot and a weaker thruster are one and the same
    same = {"payload", "actuator_gain"}
    assert best.effects[0] in (same if name in same else {name})
    (own,) = (trial for trial in trials if trial.effects == (name,))
    assert own.loss < search.current.loss - 0.02
    for key, true in HIDDEN[name].items():
        assert abs(own.fit.model.settings[f"{name}.{key}"].value - true) < 0.25 * abs(true)


@pytest.mark.long
def test_a_damped_robot_is_diagnosed_whole():
    report = diagnose(load_model("point"), [driven({"viscous_drag": {"coefficient": 0.6}}, s, 12.0) for s in (11, 12)])
    assert report.added == ("viscous_drag",)
    assert abs(report.parameters["viscous_drag.coefficient"].value - 0.6) < 0.02


@pytest.mark.long
def test_the_commands_take_it(tmp_path, capsys):
    run = driven({"viscous_drag": {"coefficient": 0.6}}, 31)
    names = ("t", *run.system.state_names, *run.system.action_names)
    table = dict(zip(names, np.column_stack([run.t, run.states, run.actions]).T, strict=True))
    path = tmp_path / "run.csv"
    write_columns(table, path, "csv")
    assert safedpa.run(["compare", "point", str(path), "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["robot"] == "point"
    out = tmp_path / "damped.toml"
    assert safedpa.run(["add", "point", "viscous_drag", str(path), "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < 0.2 * document["before"]
    f, g = load_model(out).affine(np.zeros(5))
    assert np.allclose(f, 0.0)
    assert g.shape == (5, 2)
