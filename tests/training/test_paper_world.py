"""The car in the paper's world: no randomised loads, no footprint in the observation, no filter in training."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.policy.learned import LearnedPolicy
from safedpa_services.command_line.group import safedpa
from safedpa_sim.robots.car.loads import footprint
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.training import pipeline
from safedpa_sim.training.configuration import Configuration, PracticeSettings, load_configuration, parse_configuration
from safedpa_sim.training.configuration import configurations as shipped
from safedpa_sim.training.environments import car_task
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.environments.car_scenes import draw_scenes
from safedpa_sim.training.environments.car_task import DrivingTask, evaluate
from safedpa_sim.training.optimisation import Checkpoint
from safedpa_sim.training.phases.phase_1b import train_policy
from safedpa_sim.training.pipeline import stages_of

BODY = np.array(footprint(None), dtype=np.float32)


@pytest.fixture(scope="module")
def small() -> Configuration:
    found = load_configuration("car_paper_small")
    brief = replace(found.phase_1b, cars=8, rollout=4, batch=32, steps=128, evaluate_every=2, evaluation_cars=4)
    return replace(found, phase_1b=brief)


@pytest.fixture(scope="module")
def weights(small: Configuration, untrained: Callable[[Configuration], Weights]) -> Weights:
    return untrained(small)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shortens drives to 1 s: these tests check how evaluations are used, not their figures."""
    monkeypatch.setattr(car_task, "EPISODE_TICKS", 20)


@pytest.fixture
def taught(small: Configuration, weights: Weights, brief: None, tmp_path: Path) -> tuple[Weights, dict[str, Any]]:
    return train_policy(small, weights, tmp_path)


@pytest.mark.parametrize("name", ["car_paper", "car_paper_small"])
def test_only_a_force_is_randomised_and_training_has_no_loads_and_no_filter(name: str) -> None:
    configuration = load_configuration(name)
    assert configuration.environment.keys() == {"constant_force.ax", "constant_force.ay"}
    assert {entry.path for entry in BatchedSimulator(configuration).entries} == set(configuration.environment)
    reported = configuration.practice
    assert (reported.shelter, reported.loads, reported.footprint, reported.near, reported.contact) == (
        False,
        False,
        False,
        0.0,
        0.0,
    )
    assert reported.cost > 0.0
    assert len(reported.penalties) > 1


def test_both_configurations_differ_only_in_their_sizes() -> None:
    large, small = (load_configuration(name) for name in ("car_paper", "car_paper_small"))
    grid = small.practice.penalties
    assert set(grid) <= set(large.practice.penalties)
    assert replace(large.practice, penalties=grid) == small.practice
    today = load_configuration("car")
    for name in ("state", "action", "latents", "history", "seed"):
        assert getattr(large, name) == getattr(small, name) == getattr(today, name)
    for name in ("phase_1a", "phase_2", "phase_3"):
        assert getattr(large, name) == getattr(today, name), "what is not the world is as in the other family"


def test_scenes_are_for_the_car_alone(small: Configuration, weights: Weights) -> None:
    radii = draw_scenes(np.random.default_rng(0), 200, loads=False).footprint
    np.testing.assert_array_equal(radii, np.broadcast_to(BODY, radii.shape))
    assert len(np.unique(draw_scenes(np.random.default_rng(0), 200).footprint[:, 2])) > 4
    driving = DrivingTask(small, weights, 8, 0)
    np.testing.assert_array_equal(driving.scene.footprint, np.broadcast_to(BODY, (8, 3)))


def test_no_phase_uses_the_filter(small, weights, monkeypatch) -> None:
    def refused(*_: Any) -> Any:
        raise AssertionError("a stand-in of the filter was asked")

    monkeypatch.setattr(car_task.TrainingFilter, "decide", refused)
    robots = DrivingTask(small, weights, 8, 0)  # phase 2 always requests the filter
    assert not robots.with_filter
    robots.advance(np.ones((8, 2), dtype=np.float32))
    assert robots.rewards == replace(car_task.Rewards(), near=0.0, contact=0.0)


def test_observations_in_training_do_not_depend_on_the_footprint(small: Configuration, weights: Weights) -> None:
    driving = DrivingTask(small, weights, 8, 3)
    before = driving.observation()
    driving.scene.footprint[:, 0] += 0.3
    driving.scene.footprint[:, 2] = 0.45
    np.testing.assert_array_equal(driving.observation(), before)
    reported = replace(small, practice=replace(small.practice, footprint=True))
    other = DrivingTask(reported, weights, 8, 3)
    before = other.observation()
    other.scene.footprint[:, 2] = 0.45
    assert not np.array_equal(other.observation(), before)


def test_a_trained_policy_ignores_the_load(taught: tuple[Weights, dict[str, Any]]) -> None:
    made, _ = taught
    np.testing.assert_array_equal(made["observation_body"], BODY)
    policy, latent = LearnedPolicy(made), np.zeros(made.description.latents)
    message = CarRobot(Scene.random(3, "none")).state_message()
    nominal_actions = {
        policy.nominal_action(replace(message, footprint=footprint), latent) for footprint in _footprints(message)
    }
    assert len(nominal_actions) == 1
    seeing = LearnedPolicy(
        Weights({k: v for k, v in made.tensors.items() if k != "observation_body"}, made.description)
    )
    assert len({seeing.nominal_action(replace(message, footprint=item), latent) for item in _footprints(message)}) > 1
    assert seeing.nominal_action(message, latent)[0] == pytest.approx(nominal_actions.pop()[0], abs=1e-5)


def _footprints(message: StateMessage) -> list[tuple[float, ...]]:
    rear, front, radius = message.footprint
    return [(rear, front, radius), (rear, front, 0.25), (rear + 0.3, front, 0.45)]


def test_a_body_of_another_length_is_refused(weights: Weights, small: Configuration, tmp_path: Path) -> None:
    seen = len(DrivingTask(small, weights, 2, 0).observation()[0])
    tensors = {"policy.0.weight": np.zeros((2, seen)), "policy.0.bias": np.zeros(2), "observation_body": np.zeros(2)}
    tensors |= {"observation_middle": np.zeros(seen), "observation_scale": np.ones(seen)}
    with pytest.raises(InputError, match="'observation_body' has 2 numbers, wanted 3"):
        LearnedPolicy(weights.with_tensors(tensors))


def test_the_best_policy_by_return_and_cost_is_selected_also_after_an_interruption(
    small, weights, brief, tmp_path, monkeypatch
):
    """Three evaluations: the second is best though the third reaches more goals; training is interrupted in between."""
    reported = iter([(0.2, 1.0, 0.1), (0.5, 4.0, 0.1), (0.9, 6.0, 2.0)])
    seen: list[Weights] = []

    def figures(_: Any, made: Weights, *, cars: int, **_named: Any) -> dict[str, Any]:
        if cars > small.phase_1b.evaluation_cars:
            return {"success": 0.0, "reward": 0.0, "contacts": 0.0}
        seen.append(made)
        success, reward, contacts = next(reported)
        return {"success": success, "reward": reward, "contacts": contacts}

    def interrupt(_name: str, done: int, _all: int, _note: str) -> None:
        if done == 128:
            raise KeyboardInterrupt

    monkeypatch.setattr(car_task, "evaluate", figures)
    longer = replace(small, phase_1b=replace(small.phase_1b, steps=192))
    with pytest.raises(KeyboardInterrupt):
        train_policy(longer, weights, tmp_path, interrupt)
    made, summary = train_policy(longer, weights, tmp_path)
    assert (len(seen), made.digest) == (3, seen[1].digest)
    assert [entry["success"] for entry in summary["learning_curve"]] == [0.2, 0.5, 0.9]


def test_development_drives_are_not_trained_on(small, taught, weights, monkeypatch) -> None:
    """Evaluation seeds differ from those of training, which are the configuration's seed plus the steps done."""
    made: list[tuple[DrivingTask, int]] = []

    def driving(configuration: Configuration, with_: Weights, cars: int, seed: int, **named: Any) -> DrivingTask:
        made.append((DrivingTask(configuration, with_, cars, seed, **named), seed))
        return made[-1][0]

    monkeypatch.setattr(car_task, "DrivingTask", driving)
    evaluate(small, taught[0], cars=64, seed=small.seed)
    for name in ("car_paper", "car_paper_small"):
        phase = load_configuration(name).phase_1b
        assert (made[0][1] - small.seed) % (phase.cars * phase.rollout)
    trained_on, developed = DrivingTask(small, weights, 64, small.seed).scene.start, made[0][0].scene.start
    assert not set(map(tuple, trained_on.tolist())) & set(map(tuple, developed.tolist()))


def test_clean_drives_reach_their_goal_without_a_contact(taught: tuple[Weights, dict[str, Any]], small: Any) -> None:
    made, summary = taught
    assert summary["clean"] <= summary["success"]
    assert summary["score"] == pytest.approx(summary["reward"] - small.practice.cost * summary["contacts"])
    assert evaluate(small, made, cars=4, seed=small.seed) == evaluate(small, made, cars=4, seed=small.seed)


def test_the_grid_is_trained_and_its_best_gets_a_history_encoder(tmp_path, monkeypatch) -> None:
    names = [stage.name for stage in stages_of("car", (1.0, 10.0))["ablations"]]
    assert names == ["fix", "mix", "ppo", "rma_p_1", "rma_p_10", "rma_p"]
    assert [stage.name for stage in stages_of("car")["ablations"]] == ["fix", "mix", "rma_p"]
    scores = {"rma_p_1": 2.0, "rma_p_10": 3.5}
    record = {name: {"score": score, "file": f"car_{name}.safetensors"} for name, score in scores.items()}
    monkeypatch.setattr(pipeline, "read_record", lambda _: record)
    monkeypatch.setattr(pipeline, "load_weights", lambda path: path)
    monkeypatch.setattr(pipeline, "phase_function", lambda *_: lambda _configuration, given, *_rest: (given, {}))
    best = stages_of("car", (1.0, 10.0))["ablations"][-1]
    made, reported = best.train(None, None, tmp_path, None, "cpu")  # type: ignore[arg-type]
    assert (made, reported) == (tmp_path / "car_rma_p_10.safetensors", {"chosen": "rma_p_10", "scores": scores})
    assert "phi." in best.drops


def test_digests_from_before_the_practice_section_are_unchanged() -> None:
    today = load_configuration("car")
    assert (today.practice, today.digest("phase_1b", "practice")) == (PracticeSettings(), today.digest("phase_1b"))
    other = replace(today, practice=replace(today.practice, shelter=False))
    assert other.digest("phase_1b", "practice") != today.digest("phase_1b")


@pytest.mark.parametrize(
    ("name", "phrase", "message"),
    [
        ("car_paper", "penalties = [0.0]", "practice.penalties: got 0.0, wanted positive numbers"),
        ("car_paper", "shelter = 1", "practice.shelter: got 1, wanted a value of type bool"),
        ("pendulum", "[practice]\nshelter = false", "practice: got settings of a car for robot 'pendulum'"),
    ],
)
def test_an_error_in_the_configuration_is_named(name: str, phrase: str, message: str) -> None:
    path = shipped()[name]
    text = path.read_text(encoding="utf-8")
    key = phrase.split(" ", maxsplit=1)[0]
    changed = [phrase if line.startswith(f"{key} ") else line for line in text.splitlines()]
    with pytest.raises(InputError) as caught:
        parse_configuration("\n".join(changed if phrase in changed else [text, phrase]), path.parent)
    assert str(caught.value).startswith(message)


def test_a_checkpoint_without_the_best_policy_is_refused(tmp_path: Path) -> None:
    torch.save({"digest": "a", "curve": "[]"}, tmp_path / "old.pt")
    with pytest.raises(InputError, match="remove it to train from the beginning"):
        Checkpoint(tmp_path / "old.pt", "a").read(lambda content: content["chosen"])


def test_another_configuration_is_trained_into_its_own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Runs the command in the current folder with a fake pipeline, so that nothing is trained."""
    asked: list[Path] = []

    def run_pipeline(_configuration: Configuration, out: Path, *_: Any) -> dict[str, Any]:
        asked.append(out)
        return {}

    monkeypatch.setattr("safedpa_sim.training.pipeline.run_pipeline", run_pipeline)
    mine = tmp_path / "mine.toml"
    folder = shipped()["car"].parent
    text = shipped()["car_paper"].read_text(encoding="utf-8")
    mine.write_text(text.replace("published_car.toml", str(folder / "published_car.toml")), encoding="utf-8")
    for phrase in ([], ["--configuration", "car_paper"], ["--configuration", str(mine)], ["--small"]):
        assert safedpa.run(["train", "car", *phrase]) == 0
    assert asked == [Path("learned") / name for name in ("car", "car_paper", "car", "car")]
