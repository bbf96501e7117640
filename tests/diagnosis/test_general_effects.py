"""Systems of one's own with an action, a memory and a delay: general effects are found on their channels."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.addition import add_effect
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.experiment.choice import chosen_experiment, manoeuvres
from safedpa.dynamics import Setting, load_model, load_own
from safedpa.effects import CommandEffect, effect, effects_of, general_effects
from safedpa.effects.effect import Context
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.records import load_run
from safedpa.systems import System, Variable

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = DOCS / "examples"
STEP = 0.001


@pytest.fixture(autouse=True)
def own():
    load_own(EXAMPLES / "cart.py")
    load_own(EXAMPLES / "helicopter.py")


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
        np.savetxt(
            folder / f"run_{number}.csv", found, delimiter=",", header="t,speed,throttle", comments="", fmt="%.9g"
        )
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
    report = diagnose(model, runs_of(model, carts(tmp_path)))
    assert report.verdict == "nothing_missing"


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
def test_the_next_experiment_is_in_the_systems_own_words(name):
    model = load_model(EXAMPLES / f"{name}.toml")
    texts = list(manoeuvres(model))
    for action in model.system.action_names:
        assert sum(action in text for text in texts) == 4
    one, other = (
        model.with_effect(effect(name, f"{action}_{kind}"), {key: Setting(0.2)})
        for action, kind, key in (
            (model.system.action_names[0], "lag", "time_constant"),
            (model.system.action_names[0], "delay", "seconds"),
        )
    )
    proposed = chosen_experiment({"lag": one, "delay": other}, np.full(len(model.system.state), 0.005))
    assert proposed is not None
    assert model.system.action_names[0] in proposed.manoeuvre


def test_every_general_effect_does_nothing_where_it_is_neutral():
    for name in ("cart", "helicopter"):
        model = load_model(EXAMPLES / f"{name}.toml")
        random = np.random.default_rng(3)
        state, action = random.uniform(-0.5, 0.5, len(model.system.state)), random.uniform(-0.5, 0.5, 1)
        action = np.resize(action, len(model.system.action))
        every = effects_of(name)
        assert len(every) == 6 * len(model.system.action) + 4 * (1 if name == "cart" else 2)
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
            rates = item.modify({"v": 1.0}, start_of(item), Context({"v": 1.0}, {"u": 0.3}, {}, 0.0, 0.05, FLOATS))
            assert np.isfinite(rates["v"])
    assert all(np.isfinite(actions).all() for _, actions in manoeuvres_of(free).values())


def start_of(item):
    return {parameter.name: parameter.typical for parameter in item.parameters}


def manoeuvres_of(system):
    from safedpa.diagnosis.experiment.choice import general_manoeuvres

    return general_manoeuvres(system, np.arange(0.0, 6.0, 0.05))


def test_an_unknown_state_is_refused():
    system = System("slow", (Variable("v", "m/s", -1.0, 1.0),), ())
    with pytest.raises(InputError, match="moving: got 'w'"):
        general_effects(system, {"w": 1.0})
    with pytest.raises(InputError, match="usual"):
        general_effects(system, {"v": 0.0})


def test_the_page_shows_the_cart_as_it_is():
    page = (DOCS / "own-system.md").read_text(encoding="utf-8")
    for name in ("cart.py", "cart.toml"):
        assert (EXAMPLES / name).read_text(encoding="utf-8").strip() in page
    assert re.search(r"\(examples/helicopter\.py\)", page)
