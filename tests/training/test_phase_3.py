"""Tuning on circles of the simulated car improves predictions of unseen runs or is refused; all phases end to end."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import Setting, load_model
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, LearnedNetworks
from safedpa.policy import PolicyNode
from safedpa.records import write_csv
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa_services.command_line import safedpa
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.data.drives import Drawbars, random_drives
from safedpa_sim.training.data.recorded_runs import drives_of, record_circles
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.export.weights import export_model
from safedpa_sim.training.networks.modules import affine_networks
from safedpa_sim.training.phases import phase_3
from safedpa_sim.training.phases.phase_1a import train_affine
from safedpa_sim.training.phases.phase_2 import train_history_encoder
from safedpa_sim.training.phases.phase_3 import tune, tune_on_drives, tune_on_runs

pytestmark = [pytest.mark.long, pytest.mark.slow]

SMALL = load_configuration("car_small")


def with_phase_3(**changes):
    return replace(SMALL, phase_3=replace(SMALL.phase_3, **changes))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("simulated")
    few = replace(SMALL, phase_2=replace(SMALL.phase_2, rounds=1, updates=30, cars=100))
    return train_history_encoder(few, train_affine(few, folder)[0], folder)[0]


@pytest.fixture(scope="module")
def tuned(simulated, tmp_path_factory):
    return tune(SMALL, simulated, tmp_path_factory.mktemp("tuned"))


def one_step_error(weights, run):
    """Returns the mean over states of the scaled one-step RMS error, computed with the code of the services."""
    encoder, networks = HistoryEncoder(weights), LearnedNetworks(weights)
    rows = encoder.rows(run.states, run.actions[:-1])
    errors = []
    for index in range(encoder.length, len(rows), 3):
        latent = encoder.encode(rows[index - encoder.length : index])
        f, g = networks.own_increment(run.states[index], latent)
        increment = rows[index, 3:7] * weights["increment_scale"]
        errors.append((f + g @ run.actions[index] - increment) / weights["increment_scale"])
    return float(np.sqrt(np.mean(np.square(errors), axis=0)).mean())


def test_the_services_predict_unseen_circles_better_after_tuning(simulated, tuned):
    fresh = record_circles(600, 4711, 600)[0]
    before, after = (one_step_error(weights, fresh) for weights in (simulated, tuned[0]))
    assert after < 0.45 * before


def test_the_summary_compares_before_and_after_on_runs_that_were_not_fitted(tuned):
    weights, summary = tuned
    assert summary["pairs"] == 3000
    assert summary["held_out_pairs"] == 1000
    assert summary["times_better"]["one_step"] > 2.0
    assert set(summary["tuned"]["20_steps"]["per_state"]) == {"x", "y", "yaw", "speed"}
    assert weights.description.trained_on["tuned"]["runs"] == "circles without load"


def test_the_tuned_weights_make_a_model_whose_latent_rests_within_its_range(tuned, tmp_path):
    weights = tuned[0]
    assert (weights["latent_low"] < weights["latent_nominal"]).all()
    assert (weights["latent_nominal"] < weights["latent_high"]).all()
    export_model(weights, SMALL.simulator, tmp_path / "car_learned.toml")
    assert load_model(tmp_path / "car_learned.toml").latent_names == tuple(f"base.latent_{index}" for index in range(4))


@pytest.mark.parametrize(
    ("what", "retained", "changed"),
    [("phi", "f.2.weight", "phi.dense.0.weight"), ("heads", "phi.dense.0.weight", "phi.out.weight")],
)
def test_only_what_is_asked_for_is_tuned(simulated, what, retained, changed):
    drives = drives_of(record_circles(1500, 5, 500), simulated)
    weights, _ = tune_on_drives(with_phase_3(updates=25, learning_rate=3e-3), simulated, drives, what)
    np.testing.assert_array_equal(weights[retained], simulated[retained])
    assert np.abs(weights[changed] - simulated[changed]).max() > 1e-4
    np.testing.assert_array_equal(weights["mu.0.weight"], simulated["mu.0.weight"])


def test_a_tuning_without_improvement_is_refused(simulated):
    drives = drives_of(record_circles(1500, 5, 500), simulated)
    with pytest.raises(InputError, match="the held-out error did not fall"):
        tune_on_drives(with_phase_3(updates=2, learning_rate=0.9, last_learning_rate=0.9), simulated, drives)


def test_recorded_files_are_tuned_on(simulated, tmp_path):
    paths = [tmp_path / f"run_{index}.csv" for index in range(3)]
    for path, run in zip(paths, record_circles(1500, 6, 500), strict=True):
        write_csv(run, path)
    weights, summary = tune_on_runs(with_phase_3(updates=30), simulated, paths, None, tmp_path)
    assert summary["runs"] == "run_0.csv, run_1.csv, run_2.csv"
    assert weights.digest != simulated.digest


def test_weights_without_a_history_encoder_are_refused(simulated):
    retained = {name: tensor for name, tensor in simulated.tensors.items() if not name.startswith("phi.")}
    bare = replace(simulated, tensors=retained)
    with pytest.raises(InputError, match="no history encoder"):
        tune_on_drives(SMALL, bare, drives_of(record_circles(600, 5, 300), bare))


def test_what_is_unknown_is_refused(simulated, tmp_path):
    with pytest.raises(InputError, match="got 'mu', wanted one of all, phi, heads"):
        tune_on_runs(SMALL, simulated, [], None, tmp_path, what="mu")


def test_drives_in_the_corrected_simulator_are_mixed_in(simulated, monkeypatch):
    slower = SMALL.simulator.with_settings({"base.speed_gain": Setting(5.0)})
    found = type("Found", (), {"model": slower, "summary": lambda _self: {"effects": []}})()
    monkeypatch.setattr(phase_3, "ground_simulator", lambda *_: found)
    drives = drives_of(record_circles(1500, 5, 500), simulated)
    weights, summary = tune_on_drives(with_phase_3(updates=20, cars=30, steps=80), simulated, drives)
    assert summary["mended_simulator"] == {"effects": []}
    assert np.abs(weights["phi.out.weight"] - simulated["phi.out.weight"]).max() > 1e-4


def turned_by(bars, cars, state, environment, steer, periods):
    """Returns the angle [rad] by which loads additionally turn the cars in the last of some periods."""
    action = torch.tensor([[1.5, steer]]).expand(len(state), -1)
    for _ in range(periods):
        alone, _ = cars.advance(state, action, environment)
        following = bars.pulled(state, alone, environment)
        turn, state = (following - alone)[:, 2], following
    return turn


def test_a_load_on_a_drawbar_pulls_sideways_in_a_turn_and_not_when_straight():
    cars = BatchedSimulator(SMALL)
    environment = cars.nominal.repeat(20, 1)
    paths = [entry.path for entry in cars.entries]
    environment[:, paths.index("towed_load.mass_ratio")] = 1.0
    state = torch.tensor([[0.0, 0.0, 0.3, 1.2]]).repeat(20, 1)
    for steer, sign in ((0.3, -1.0), (-0.3, 1.0)):
        turn = turned_by(Drawbars(cars, 20, torch.Generator().manual_seed(0)), cars, state, environment, steer, 30)
        assert (sign * turn > 1e-5).all()
    straight = turned_by(Drawbars(cars, 20, torch.Generator().manual_seed(0)), cars, state, environment, 0.0, 30)
    assert float(straight.abs().max()) < 1e-6
    nothing = turned_by(
        Drawbars(cars, 20, torch.Generator().manual_seed(0)), cars, state, cars.nominal.repeat(20, 1), 0.3, 30
    )
    assert float(nothing.abs().max()) < 1e-6


def test_swinging_loads_differ_from_stiff_ones(simulated):
    networks, cars = affine_networks(simulated), BatchedSimulator(SMALL)
    stiff, swinging = (
        random_drives(cars, networks, 10, 60, 0.0, torch.Generator().manual_seed(2), swinging=swings)
        for swings in (False, True)
    )
    assert stiff.rows.shape == swinging.rows.shape
    assert float(swinging.states.reshape(10, 60, 4)[:, 0, 3].abs().max()) == 0.0
    assert not torch.equal(stiff.following, swinging.following)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    assert safedpa.run(["train", "car", "--small", "--phases", "1a,1b,2,3", "--out", str(out)]) == 0
    return out


def test_every_phase_reaches_its_figure(trained: Path) -> None:
    reported = json.loads((trained / "progress.json").read_text())
    assert min(reported["1a"]["explained"]) > 0.93  # share of each increment's variance
    curve = reported["1b"]["learning_curve"]
    assert curve[-1]["reward"] > curve[0]["reward"] + 1.0
    assert curve[0]["steps"] < 0.5 * reported["1b"]["steps"]
    assert reported["1b"]["nearest"] < 0.8 * curve[0]["nearest"]
    assert reported["1b"]["success"] > 0.15
    assert max(reported["2"]["explained"]) > 0.15  # part of z cannot be observed in a history
    assert reported["3"]["times_better"]["one_step"] > 2.0
    assert reported["3"]["times_better"]["20_steps"] > 1.5
    assert list(trained.glob("checkpoint_*.pt")) == [], "checkpoints go when the training is done"


def test_a_trained_policy_drives_with_the_filter(trained: Path) -> None:
    model = load_model(trained / "car_learned.toml")
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car"))]
    robot = CarRobot(Scene.random(3, "box"), 0.05)
    fallbacks = 0
    for tick in drive(robot, nodes, 100):
        fallbacks += tick.verdict.status == "fallback"
    assert fallbacks == 0
    assert not robot.collisions
