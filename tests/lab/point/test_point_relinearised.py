"""Networks that are not affine in the action: their slope, what a filter makes of them, and the experiment in small."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, frame_of
from safedpa_lab.experiments.point import relinearised as relinearised_errors
from safedpa_lab.experiments.point.relinearised import (
    CarWork,
    Relinearised,
    car_errors,
    car_table,
    thrust_configuration,
    train_networks,
)
from safedpa_lab.point.drivers import windy_task
from safedpa_lab.point.free_model import FreeModel, load_free, save_free
from safedpa_lab.point.free_training import free_hidden, train_free
from safedpa_lab.point.relinearised import (
    COMMANDS,
    NETWORKS,
    RelinearisedFilter,
    SimulatedBody,
    affine_weights,
    free_model,
    model_of,
)
from safedpa_services.command_line import safedpa
from safedpa_sim.point.filtering import to_task_action
from safedpa_sim.point.simulation import centre_state
from safedpa_sim.training.data.transitions import Transitions, draw_transitions
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

SHIPPED = Path("no networks here")
EVERYBODY = np.arange(6)


def drawn(count: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    state = random.uniform(-1.0, 1.0, (count, 5)) * np.array([1.0, 1.0, np.pi, 2.0, 2.0])
    return state, random.uniform(-1.0, 1.0, (count, 2)), random.uniform(-1.0, 1.0, (count, 2))


@pytest.mark.parametrize("thrust", COMMANDS)
def test_the_slope_is_that_of_the_network(thrust: str) -> None:
    """Exact: what central differences say, wherever no unit changes sides between them."""
    model = free_model(thrust, SHIPPED)
    state, latent, action = drawn(40)
    action = action * COMMANDS[thrust]
    value, slope = model.linearised(state, latent, action)
    np.testing.assert_allclose(value, model.increment(state, latent, action), atol=1e-12)
    for index, largest in enumerate(COMMANDS[thrust]):
        nudge = 1e-7 * largest * np.eye(2)[index]
        up, down = (model.increment(state, latent, action + sign * nudge) for sign in (1.0, -1.0))
        measured = (up - down) / (2e-7 * largest)
        agrees = np.abs(measured - slope[:, :, index]).max(axis=1) < 1e-4 / largest
        assert agrees.mean() > 0.9, "a kink between the two is rare"


@pytest.mark.parametrize("kind", ["free", "truth"])
def test_what_is_affine_about_an_action_meets_the_model_there(kind: str) -> None:
    task = windy_task(np.linspace(0.0, 6.0, 6), 0.008, 3, stock=True)
    model = model_of(kind, "stock", task, SHIPPED)
    model.see(centre_state(task.simulation))
    _, _, action = drawn()
    believed = model.about(action, EVERYBODY)
    np.testing.assert_allclose(believed.next_state(action), model.following(action, EVERYBODY), atol=1e-12)


@pytest.mark.parametrize("thrust", COMMANDS)
def test_the_simulated_body_is_the_robot_itself(thrust: str) -> None:
    task = windy_task(np.linspace(0.0, 6.0, 6), 0.008, 3, stock=thrust == "stock")
    _, _, action = drawn()
    for _ in range(3):
        model = SimulatedBody(task.simulation, COMMANDS[thrust])
        model.see(centre_state(task.simulation))
        predicted = model.following(action, EVERYBODY)
        task.advance(to_task_action(action))
        np.testing.assert_allclose(predicted, centre_state(task.simulation), atol=1e-12)


def test_the_free_network_knows_that_the_thrust_saturates_and_the_affine_one_does_not() -> None:
    task = windy_task(np.linspace(0.0, 6.0, 6), 0.008, 3, stock=True)
    off = {}
    for kind in ("affine", "free"):
        model, truth = (model_of(name, "stock", task, SHIPPED) for name in (kind, "truth"))
        errors = []
        for push in (0.05, 1.0):
            action = np.tile([push, 0.0], (6, 1))
            for one in (model, truth):
                one.see(centre_state(task.simulation))
            errors.append(np.abs(model.following(action, EVERYBODY) - truth.following(action, EVERYBODY))[:, 3:].max())
        off[kind] = max(errors)
    assert off["free"] < 0.01 < off["affine"]


@pytest.mark.long
def test_about_a_saturated_nominal_action_the_filter_drives_into_hazards_and_about_its_own_action_it_does_not() -> None:
    """Full ahead at the nearest hazard for 0.8 s, with the stock thrust, given the body itself: the nominal thrust
    has no slope, so that by what is affine no other thrust would help."""
    room = {}
    for about in ("nominal", "own"):
        task = windy_task(np.zeros(12), 0.0, 5, stock=True)
        apart = task.layout.hazards - task.simulation.pose[:2].T[:, None]
        nearest = apart[np.arange(12), np.linalg.norm(apart, axis=2).argmin(axis=1)]
        task.simulation.pose[2] = np.arctan2(nearest[:, 1], nearest[:, 0])
        model, own = model_of("truth", "stock", task, SHIPPED), RelinearisedFilter(0.001, about)
        for _ in range(40):
            found = own.decide(centre_state(task.simulation), np.tile([1.0, 0.0], (12, 1)), task.layout.hazards, model)
            task.advance(to_task_action(found.action))
        room[about] = task.hazard_distance()
    assert (room["nominal"] < 0.0).any()
    assert (room["own"] > 0.0).all()


def test_a_nominal_action_that_the_model_itself_lets_pass_is_not_changed() -> None:
    task = windy_task(np.zeros(6), 0.0, 3)
    model = model_of("free", "clean", task, SHIPPED)
    nominal = np.zeros((6, 2))
    found = RelinearisedFilter(0.0, "own").decide(centre_state(task.simulation), nominal, task.layout.hazards, model)
    np.testing.assert_array_equal(found.action, nominal)
    assert not found.corrected.any()
    with pytest.raises(InputError, match="linearised about 'elsewhere'"):
        RelinearisedFilter(0.0, "elsewhere")


def test_training_learns_and_a_file_brings_back_what_was_written(tmp_path: Path) -> None:
    asked = thrust_configuration("clean", 40_000)
    model, summary = train_free(asked)
    assert summary["loss"] < 0.5
    assert len(model.tensors["h.0.bias"]) == free_hidden(asked.phase_1a.hidden)
    save_free(model, tmp_path / "one.safetensors")
    assert load_free(tmp_path / "one.safetensors").digest == model.digest
    with pytest.raises(InputError, match="no tensor 'h"):
        FreeModel({key: one for key, one in model.tensors.items() if key != "h.0.weight"}, model.description)
    with pytest.raises(InputError, match="nothing"):
        load_free(tmp_path / "nothing.safetensors")


def test_networks_of_ones_own_are_taken_from_their_folder(tmp_path: Path) -> None:
    train_networks(tmp_path, 2048)
    assert {path.stem for path in tmp_path.glob("*.safetensors")} == set(NETWORKS)
    assert free_model("stock", tmp_path).digest != free_model("stock", SHIPPED).digest


def test_errors_of_the_networks_are_roots_of_mean_squares_over_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared with the networks themselves, over the same 300 steps of the training simulator."""
    drawn = []

    def few(cars: BatchedSimulator, _: int, generator: torch.Generator) -> Transitions:
        drawn.append(draw_transitions(cars, 300, generator))
        return drawn[-1]

    monkeypatch.setattr(relinearised_errors, "draw_transitions", few)
    monkeypatch.setattr(relinearised_errors, "affine_floor", lambda *_: np.array([9.0, 9.0, 9.0, 0.25, 0.75]))
    rows = relinearised_errors.point_errors(SHIPPED)
    assert [(row["thrust"], row["form"]) for row in rows] == [
        (thrust, form) for thrust in COMMANDS for form in ("affine", "free")
    ]
    for index, (thrust, part) in enumerate(zip(COMMANDS, drawn, strict=True)):
        environment, state, action, own = (one.double().numpy() for one in part)
        measured = frame_of("point").world_increment(state, own)
        affine, free = affine_weights(thrust, SHIPPED), free_model(thrust, SHIPPED)
        networks = LearnedNetworks(affine)
        f, g = networks.increment(state, networks.encode(environment))
        predicted = f + (g @ action[..., None])[..., 0], free.increment(state, free.encode(environment), action)
        for row, by_it in zip(rows[2 * index :], predicted, strict=False):
            off = by_it - measured
            assert row["yaw"] == pytest.approx(np.sqrt((off[:, 2] ** 2).mean()))
            assert row["velocity"] == pytest.approx(np.sqrt((off[:, 3:] ** 2).mean()))
            spread = measured[:, 3:].var(axis=0).mean()
            assert row["explained"] == pytest.approx(1.0 - (off[:, 3:] ** 2).mean() / spread)
            assert row["not_affine"] == 0.5


def test_errors_of_the_car_are_reported_by_state() -> None:
    found = car_errors(CarWork(4096, "car_small"))
    assert len(found["affine"]["rms_error"]) == len(found["free"]["rms_error"]) == len(found["states"])
    assert car_table({"car": found}).count("\n") == 3 + len(found["states"])


@pytest.mark.long
def test_the_whole_command_in_small(tmp_path: Path) -> None:
    phrase = ["experiment", "point-relinearised", "--quick", "--drives", "99", "--out", str(tmp_path)]
    ended = CliRunner().invoke(safedpa, phrase, catch_exceptions=False)
    assert ended.exit_code == 0, ended.output
    found = json.loads((tmp_path / "relinearised.json").read_text(encoding="utf-8"))
    assert [row["count"] for row in found["rows"]] == [2] * 8
    assert len(found["against"]) == 6
    assert all(line["holm"] >= line["mcnemar"] for line in found["against"])
    by = {(row["thrust"], row["form"]): row["velocity"] for row in found["networks"]}
    assert by["stock", "free"] < 0.1 * by["stock", "affine"]
    assert found["evaluation_seed"] == 2_002_400
    with pytest.raises(InputError, match="--drives: got 20, wanted 99"):
        replace(Relinearised(), drives=20)
