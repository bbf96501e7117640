"""Systems of the user, effects that every system has, the point robot, and models that are learned."""

import csv
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.diagnosis.add_effect import add_effect
from safedpa.diagnosis.diagnose import diagnose, library_for
from safedpa.diagnosis.experiment_design import choose_experiment, general_manoeuvres, manoeuvres
from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.fit.trial import fit_trial
from safedpa.diagnosis.search.forward_selection import run_search
from safedpa.dynamics import LearnedBase, Setting, fingerprint, load_model, load_user_file
from safedpa.effects import CommandEffect, FeltEffect, effect, effects_of, general_effects
from safedpa.effects.effect import Context
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.policy import PolicyNode
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa.records.writers.tables import write_columns
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.systems import System, Variable
from safedpa_lab.hidden import Case, write_case
from safedpa_lab.hidden.lanes import car_commands
from safedpa_services.command_line.group import safedpa
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots import CarRobot
from safedpa_sim.robots.car.scene import Scene

DOCS = Path(__file__).parents[2] / "docs"
BALL = DOCS / "examples" / "falling_ball.py"
MODEL = DOCS / "examples" / "falling_ball.toml"
EFFECTS_PAGE = (DOCS / "reference" / "effects.md").read_text(encoding="utf-8")
GRASS = re.findall(r"```python\n(.*?)```", EFFECTS_PAGE, flags=re.DOTALL)[0]


@pytest.fixture(scope="module")
def drops(tmp_path_factory, data_folder):
    table = data_folder / "ball_drops" / "ball_drops.csv"
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
    page = (DOCS / "guides" / "own-system.md").read_text(encoding="utf-8")
    for name in ("falling_ball.py", "falling_ball.toml"):
        assert (DOCS / "examples" / name).read_text(encoding="utf-8").strip() in page
    for name in ("cart.py", "cart.toml", "helicopter.py"):
        assert f"(../examples/{name})" in page


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


def printed(script, own):
    return subprocess.run([sys.executable, "-c", script, MODEL], capture_output=True, text=True, check=False, env=own)


def test_the_environment_variable_serves_every_process(tmp_path):
    script = "from safedpa.dynamics import load_model; import sys; print(load_model(sys.argv[1]).system.name)"
    environment = {**os.environ, "SAFEDPA_EFFECTS": str(BALL)}
    done = printed(script, environment)
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
    done = printed(script, environment)
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
        load_user_file(path)
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
    "constant_force": {"ax": 0.3, "ay": -0.2}, "viscous_drag": {"coefficient": 0.6},
    "quadratic_drag": {"coefficient": 0.5}, "payload": {"mass_ratio": 0.4}, "actuator_gain": {"gain": 0.8},
    "actuator_delay": {"seconds": 0.1},
}  # fmt: skip


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
    search = run_search(given, [], shooting_of(runs, 0.5), heldout_of(runs, 0.5))
    trials = [fit_trial(search.current, [item], search.shooting) for item in library_for(given)]
    best = min(trials, key=lambda trial: trial.loss)
    # thrust / mass: a heavier robot and a weaker thruster are one and the same
    same = {"payload", "actuator_gain"}
    assert best.effects[0] in (same if name in same else {name})
    (own,) = (trial for trial in trials if trial.effects == (name,))
    assert own.loss < search.current.loss - 0.02
    for key, true in HIDDEN[name].items():
        assert abs(own.fit.model.settings[f"{name}.{key}"].value - true) < 0.25 * abs(true)


@pytest.mark.long
def test_a_damped_robot_passes_the_whole_diagnosis():
    report = diagnose(load_model("point"), [driven({"viscous_drag": {"coefficient": 0.6}}, s, 12.0) for s in (11, 12)])
    assert report.added == ("viscous_drag",)
    assert abs(report.parameters["viscous_drag.coefficient"].value - 0.6) < 0.02


@pytest.mark.long
def test_all_commands_accept_a_user_system(tmp_path, capsys):
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


EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
STEP = 0.001


@pytest.fixture(autouse=True)
def own():
    load_user_file(EXAMPLES / "cart.py")
    load_user_file(EXAMPLES / "helicopter.py")


def held(random, seconds, size, lengths=(0.3, 1.5)):
    """A command by fine steps: held at random sizes for random times."""
    found = []
    while len(found) < seconds / STEP:
        found += [random.uniform(-size, size)] * round(random.uniform(*lengths) / STEP)
    return np.array(found[: round(seconds / STEP)])


def rows_of(command):
    """The command as it is held over each row of 0.05 s."""
    each = round(0.05 / STEP)
    return np.repeat(command[::each], each)[: len(command)]


def carts(folder, delay=0.0, lag=0.0, drag=0.0, runs=4, seconds=30.0):
    """Logs of a cart, by Euler's method in steps of a millisecond, independent of the library's equations."""
    for number in range(runs):
        random = np.random.default_rng(50 + number)
        command = rows_of(held(random, seconds, 0.6))
        late = np.concatenate([np.full(round(delay / STEP), command[0]), command])[: len(command)]
        speed, felt, found = 0.0, late[0], []
        for index, wanted in enumerate(late):
            felt += (wanted - felt) * (1.0 - np.exp(-STEP / lag)) if lag else wanted - felt
            if index % 50 == 0:
                found.append((index * STEP, speed + random.normal(0.0, 0.01), command[index]))
            speed += STEP * (3.0 * felt - drag * speed)
        path = folder / f"run_{number}.csv"
        np.savetxt(path, found, delimiter=",", header="t,speed,throttle", comments="", fmt="%.9g")
    return sorted(folder.glob("run_*.csv"))


def runs_of(model, paths):
    return [load_run(path, model.system) for path in paths]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "names"),
    [
        ({"delay": 0.15, "drag": 0.6}, {"throttle_delay": 0.15, "speed_drag": 0.6}),
        ({"lag": 0.2, "drag": 0.6}, {"throttle_lag": 0.2, "speed_drag": 0.6}),
    ],
)
def test_the_effects_that_a_cart_lacks_are_found(hidden, names, tmp_path):
    model = load_model(EXAMPLES / "cart.toml")
    report = diagnose(model, runs_of(model, carts(tmp_path, **hidden)))
    assert set(report.added) == set(names)
    for name, value in names.items():
        (number,) = (item for path, item in report.parameters.items() if path.startswith(f"{name}."))
        assert number.value == pytest.approx(value, rel=0.05)
    assert report.conditions == ()


@pytest.mark.slow
def test_a_cart_that_lacks_nothing_is_reported_as_complete(tmp_path):
    model = load_model(EXAMPLES / "cart.toml")
    assert diagnose(model, runs_of(model, carts(tmp_path))).verdict == "nothing_missing"


def test_add_chooses_its_horizon(tmp_path):
    model = load_model(EXAMPLES / "cart.toml")
    runs = runs_of(model, carts(tmp_path, drag=0.6, runs=3, seconds=20.0))
    short, long = (add_effect(model, "speed_drag", runs, horizon) for horizon in (0.3, 2.0))
    assert short.values == long.values
    assert short.values["speed_drag.coefficient"].value == pytest.approx(0.6, rel=0.02)


@pytest.mark.long
@pytest.mark.slow
def test_the_lag_and_drag_of_a_helicopter_of_two_axes_are_found(tmp_path):
    model = load_model(EXAMPLES / "helicopter.toml")
    for number in range(4):
        random = np.random.default_rng(80 + number)
        main, tail = rows_of(5.0 + held(random, 30.0, 2.0)), rows_of(held(random, 30.0, 4.0))
        pitch = yaw = pitch_rate = yaw_rate = 0.0
        felt, found = main[0], []
        for index in range(len(main)):
            # a pilot keeps it up: without feedback it would hang
            wanted = main[index // 50 * 50] if index % 50 else main[index] - 4.0 * pitch - 2.0 * pitch_rate
            if index % 50 == 0:
                sent = wanted
                noise = random.normal(0.0, [0.002, 0.002, 0.01, 0.01])
                found.append((index * STEP, *(np.array([pitch, yaw, pitch_rate, yaw_rate]) + noise), sent, tail[index]))
            felt += (sent - felt) * (1.0 - np.exp(-STEP / 0.3))
            lift = 0.6 * felt - 3.0 * np.cos(pitch)
            turn = 0.8 * tail[index] + 0.1 * felt - 0.9 * yaw_rate
            pitch, yaw = pitch + STEP * pitch_rate, yaw + STEP * yaw_rate
            pitch_rate, yaw_rate = pitch_rate + STEP * lift, yaw_rate + STEP * turn
        head = "t,pitch,yaw,pitch_rate,yaw_rate,main,tail"
        np.savetxt(tmp_path / f"run_{number}.csv", found, delimiter=",", header=head, comments="", fmt="%.9g")
    report = diagnose(model, runs_of(model, sorted(tmp_path.glob("run_*.csv"))))
    assert set(report.added) == {"main_lag", "yaw_rate_drag"}
    assert report.parameters["main_lag.time_constant"].value == pytest.approx(0.3, rel=0.05)
    assert report.parameters["yaw_rate_drag.coefficient"].value == pytest.approx(0.9, rel=0.05)


@pytest.mark.parametrize("name", ["cart", "helicopter"])
def test_the_next_experiment_uses_the_action_names_of_the_system(name):
    model = load_model(EXAMPLES / f"{name}.toml")
    texts = list(manoeuvres(model))
    for action in model.system.action_names:
        assert sum(action in text for text in texts) == 4
    first = model.system.action_names[0]
    one, other = (
        model.with_effect(effect(name, f"{first}_{kind}"), {key: Setting(0.2)})
        for kind, key in (("lag", "time_constant"), ("delay", "seconds"))
    )
    proposed = choose_experiment({"lag": one, "delay": other}, np.full(len(model.system.state), 0.005))
    assert proposed is not None
    assert first in proposed.manoeuvre


def test_every_general_effect_does_nothing_where_it_is_neutral():
    for name in ("cart", "helicopter"):
        model = load_model(EXAMPLES / f"{name}.toml")
        random = np.random.default_rng(3)
        state, action = random.uniform(-0.5, 0.5, len(model.system.state)), random.uniform(-0.5, 0.5, 1)
        action = np.resize(action, len(model.system.action))
        every = effects_of(name)
        assert every
        for item in every.values():
            done = model.with_effect(item, {}).step(state, action)
            np.testing.assert_allclose(done, model.step(state, action), atol=1e-12)
            assert type(pickle.loads(pickle.dumps(item))) is type(item)


def test_bounds_may_be_missing():
    free = System("free", (Variable("v", "m/s", -np.inf, np.inf),), (Variable("u", "N", -np.inf, np.inf),))
    for item in general_effects(free, {"v": 2.0}):
        for parameter in item.parameters:
            assert np.isfinite([parameter.low, parameter.high, parameter.typical]).all()
        if isinstance(item, CommandEffect):
            felt, _ = item.transform({"u": 0.3}, item.initial_memory({"u": 0.3}), start_of(item), 0.05, FLOATS)
            assert np.isfinite(felt["u"])
        else:
            context = Context({"v": 1.0}, {"u": 0.3}, {}, 0.0, 0.05, FLOATS)
            on_action = isinstance(item, FeltEffect)
            found = (
                item.feel(start_of(item), context) if on_action else item.modify({"v": 1.0}, start_of(item), context)
            )
            assert np.isfinite(list(found.values())).all()
    proposed = general_manoeuvres(free, np.arange(0.0, 6.0, 0.05)).values()
    assert all(np.isfinite(actions).all() for _, actions in proposed)


@pytest.mark.parametrize(
    ("low", "high", "start"), [(2.0, 10.0, 6.0), (-9.0, -1.0, -5.0), (2.0, np.inf, 4.0), (0.0, 9.0, 0.0)]
)
def test_manoeuvres_start_inside_the_bounds_of_a_state_that_cannot_be_zero(low, high, start):
    tank = System("tank", (Variable("level", "m", low, high),), (Variable("pump", "1", 0.2, 1.0),))
    proposed = general_manoeuvres(tank, np.arange(0.0, 6.0, 0.05)).values()
    assert {float(state[0]) for state, _ in proposed} == {start}
    assert min(actions.min() for _, actions in proposed) == 0.2, "an action rests at its nearer bound"


def start_of(item):
    return {parameter.name: parameter.typical for parameter in item.parameters}


def test_an_unknown_state_is_refused():
    system = System("slow", (Variable("v", "m/s", -1.0, 1.0),), ())
    with pytest.raises(InputError, match="moving: got 'w'"):
        general_effects(system, {"w": 1.0})
    with pytest.raises(InputError, match="usual"):
        general_effects(system, {"v": 0.0})


DRAG = 0.15
SENSED = np.array([0.002, 0.002, 0.003, 0.015])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two drives of the learned car with drag added to its networks, as files."""
    true = load_model("car_learned").with_effect(effect("car", "quadratic_drag"), {"coefficient": Setting(DRAG)})
    paths = []
    for run in range(2):
        random, rows = np.random.default_rng([1, run]), 400
        commands = car_commands(random, rows, true.period, 0.34)
        actions = np.stack([commands.drive, commands.steer], axis=1)
        states = np.zeros((rows, 4))
        states[0] = (0.0, 0.0, random.uniform(-3.0, 3.0), 0.5)
        for row in range(rows - 1):
            states[row + 1], _ = true.advance(states[row], actions[row], ())
        measured = states + SENSED * random.standard_normal(states.shape)
        table = np.column_stack([true.period * np.arange(rows), measured, actions])
        paths.append(str(tmp_path_factory.mktemp("learned") / f"run_{run}.csv"))
        names = ("t", *true.system.state_names, *true.system.action_names)
        np.savetxt(paths[-1], table, delimiter=",", header=",".join(names), comments="")
    return paths


@pytest.fixture(scope="module")
def found_on_top(runs, tmp_path_factory):
    """(report, folder) of ``safedpa diagnose`` with a library of two."""
    folder = tmp_path_factory.mktemp("found")
    names = ("quadratic_drag", "steering_offset")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])
        assert safedpa.run(["diagnose", "car_learned", *runs, "--out", str(folder), "--json"]) == 0
    return json.loads((folder / "report.json").read_text(encoding="utf-8")), folder


@pytest.mark.long
@pytest.mark.slow
def test_the_effect_on_top_of_the_networks_is_found(found_on_top):
    report, _ = found_on_top
    assert report["added"] == ["quadratic_drag"]
    value = report["parameters"]["quadratic_drag.coefficient"]
    assert abs(value["value"] - DRAG) < max(4.0 * value["std"], 0.005)
    assert report["stages"][1]["heldout_error"] < 0.6 * report["stages"][0]["heldout_error"]


@pytest.mark.long
@pytest.mark.slow
def test_model_weights_and_margin_belong_together(found_on_top):
    _, folder = found_on_top
    model = load_model(folder / "model.toml")
    assert isinstance(model.base, LearnedBase)
    assert [item.name for item in model.effects] == ["quadratic_drag"]
    margin = MarginCalibration.load(folder / "margin.toml")
    assert margin.fingerprint == fingerprint(model) != fingerprint(load_model("car_learned"))
    assert 0.0 < margin.epsilon["obstacle"] < 0.2


@pytest.mark.long
@pytest.mark.slow
def test_the_loop_runs_with_a_diagnosed_model(found_on_top):
    _, folder = found_on_top
    model, margin = load_model(folder / "model.toml"), MarginCalibration.load(folder / "margin.toml")
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car"), margin)]
    robot = CarRobot(Scene.random(1, "none"), model.period)
    ticks = list(drive(robot, nodes, 60))
    # The simulated car has none of the drag, so conditions under every delay that is not yet ruled out may conflict.
    assert {tick.verdict.status for tick in ticks} <= {"passed", "corrected", "relaxed"}
    assert {tick.verdict.status for tick in ticks[20:]} <= {"passed", "corrected"}
    assert robot.collisions == []


@pytest.mark.long
@pytest.mark.slow
def test_add_takes_a_learned_model(runs, tmp_path, capsys):
    out = tmp_path / "model.toml"
    assert safedpa.run(["add", "car_learned", "quadratic_drag", *runs, "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < 0.6 * document["before"]
    assert abs(load_model(out).settings["quadratic_drag.coefficient"].value - DRAG) < 0.01
    assert out.with_suffix(".safetensors").is_file()


@pytest.mark.parametrize("action", ["steer", "torque", "throttle"])
def test_an_action_named_as_one_of_a_shipped_robot_makes_no_other_robot_of_a_system(action: str) -> None:
    states = tuple(Variable(name, "m", -9.0, 9.0) for name in ("depth", "range", "drift"))
    system = System(name="glider", state=states, action=(Variable(action, "1", -1.0, 1.0),))
    starts = [start for start, _ in general_manoeuvres(system, np.arange(0.0, 6.0, 0.05)).values()]
    model = SimpleNamespace(system=system, period=0.05)
    assert [start.tolist() for start, _ in manoeuvres(model).values()] == [start.tolist() for start in starts]
