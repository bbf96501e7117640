"""A learned policy at work: what it sees, what it requests, and what it refuses."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from tests.messages import latent_of, stamp, state_of

from safedpa.bus import LATENT, NOMINAL, LatentMessage, NominalMessage, Stale, StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel, Setting, fingerprint, load_model
from safedpa.errors import InputError, MessageError
from safedpa.networks import Description, EnvironmentEntry, Weights
from safedpa.policy import LearnedPolicy, PolicyNode
from safedpa.policy.controller import controller_for
from safedpa.robots.car.observation import OBSTACLES, RAYS, clearances, observation_length, observe, padded
from safedpa.systems.robots import robot_named

LATENTS = 2
STATE = state_of(
    0.5, -0.3, 0.7, 0.5, **stamp(7, epoch=5), applied=(0.5, 0.1), goal=(1.0, 2.5),
    obstacles=((1.2, 0.9, 0.3), (-1.5, 0.2, 0.25)), footprint=(0.08, 0.4, 0.12),
)  # fmt: skip
OFFSET, STEERED = 9, 7
"""Where the nearest obstacles begin in an observation, and where the steer in force stands."""


def weights(seed: int = 0, hidden: int = 8) -> Weights:
    random = np.random.default_rng(seed)
    shapes = {
        "mu.0": (hidden, 1), "mu.1": (LATENTS, hidden), "f.0": (hidden, 3 + LATENTS), "f.1": (4, hidden),
        "g.0": (hidden, 3 + LATENTS), "g.1": (8, hidden), "policy.0": (hidden, observation_length(LATENTS)),
        "policy.1": (hidden, hidden), "policy.2": (2, hidden),
    }  # fmt: skip
    tensors: dict[str, Any] = {}
    for name, (outputs, inputs) in shapes.items():
        tensors[f"{name}.weight"] = random.normal(0.0, 0.4, (outputs, inputs))
        tensors[f"{name}.bias"] = random.normal(0.0, 0.1, outputs)
    tensors |= {"feature_middle": np.zeros(3), "feature_scale": np.ones(3)}
    tensors |= {"environment_middle": np.zeros(1), "environment_scale": np.ones(1)}
    tensors |= {"increment_scale": np.full(4, 0.1), "latent_nominal": np.array([0.1, -0.2])}
    tensors |= {"latent_low": -np.ones(LATENTS), "latent_high": np.ones(LATENTS)}
    tensors |= {"action_middle": np.array([0.7, 0.0]), "action_scale": np.array([1.3, 0.34])}
    tensors |= {"observation_middle": np.full(observation_length(LATENTS), 0.1)}
    tensors |= {"observation_scale": np.full(observation_length(LATENTS), 0.5)}
    described = Description(
        "car", 0.05, ("x", "y", "yaw", "speed"), ("target_speed", "steer"), LATENTS, 0,
        (EnvironmentEntry("towed_load.mass_ratio", 0.0, 1.5),),
    )  # fmt: skip
    return Weights({name: np.asarray(value, dtype=np.float32) for name, value in tensors.items()}, described)


def without_policy(given: Weights) -> Weights:
    return Weights({k: v for k, v in given.tensors.items() if not k.startswith("policy")}, given.description)


def learned_model(given: Weights) -> PhysicsModel:
    physics = load_model("car")
    settings = {path: value for path, value in physics.settings.items() if path.startswith("base.")}
    latents = {f"base.latent_{index}": Setting(float(given["latent_nominal"][index]), free=True) for index in range(2)}
    return PhysicsModel(LearnedBase(physics.base, given), (), settings | latents)


def seen(state: StateMessage, latent: Any = (0.0, 0.0)) -> Any:
    vectors = (np.array(part) for part in (state.values, state.applied, state.goal))
    rest = (np.array(part) for part in (state.field, state.footprint, latent))
    return observe(*vectors, padded(state.obstacles), *rest)


def test_an_observation_has_the_announced_length_and_entries_of_size_one() -> None:
    observation = seen(STATE)
    assert observation.shape == (observation_length(LATENTS),)
    assert np.abs(observation).max() <= 1.5


def test_many_robots_see_what_each_sees_alone() -> None:
    random = np.random.default_rng(1)
    states = [
        dataclasses.replace(STATE, values=tuple(random.uniform(-3, 3, 4)), goal=tuple(random.uniform(-3, 3, 2)))
        for _ in range(5)
    ]
    batch = observe(
        np.array([state.values for state in states]), np.array([state.applied for state in states]),
        np.array([state.goal for state in states]), np.stack([padded(state.obstacles, 6) for state in states]),
        np.array([state.field for state in states]), np.array([state.footprint for state in states]),
        np.zeros((5, LATENTS)),
    )  # fmt: skip
    np.testing.assert_allclose(batch, np.stack([seen(state) for state in states]), atol=1e-12)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_world_turned_by_quarters_looks_the_same_from_inside(quarters: int) -> None:
    angle = quarters * np.pi / 2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    x, y, yaw, speed = STATE.values
    turned = dataclasses.replace(
        STATE,
        values=(*(turn @ (x, y)).tolist(), yaw + angle, speed),
        goal=tuple((turn @ STATE.goal).tolist()),
        obstacles=tuple((*(turn @ row[:2]).tolist(), row[2]) for row in STATE.obstacles),
    )
    np.testing.assert_allclose(seen(turned), seen(STATE), atol=2e-4)  # the padding is not turned


def test_a_mirrored_world_is_seen_mirrored() -> None:
    x, y, yaw, speed = STATE.values
    mirrored = dataclasses.replace(
        STATE, values=(x, -y, -yaw, speed), applied=(STATE.applied[0], -STATE.applied[1]),
        goal=(STATE.goal[0], -STATE.goal[1]), obstacles=tuple((row[0], -row[1], row[2]) for row in STATE.obstacles),
    )  # fmt: skip
    plain, other = seen(STATE), seen(mirrored)
    rays = slice(OFFSET + 5 * OBSTACLES, OFFSET + 5 * OBSTACLES + RAYS)
    np.testing.assert_allclose(other[rays], np.roll(plain[rays][::-1], 1), atol=1e-9)
    assert other[1] == pytest.approx(-plain[1])
    assert other[STEERED] == pytest.approx(-plain[STEERED])


def test_rays_measure_the_distance_to_the_footprint_and_clearance_that_to_the_capsule() -> None:
    state = dataclasses.replace(STATE, values=(0.0, 0.0, 0.0, 0.0), obstacles=((2.0, 0.0, 0.3),))
    rays = seen(state)[OFFSET + 5 * OBSTACLES :][:RAYS]
    ahead, left, behind = 1.0 / rays[0] - 1.0, 1.0 / rays[RAYS // 4] - 1.0, 1.0 / rays[RAYS // 2] - 1.0
    assert ahead == pytest.approx(2.0 - 0.3 - 0.12 - 0.16)
    assert left == pytest.approx(4.0 - 0.12)
    assert behind == pytest.approx(4.0 + 0.16 - 0.12)
    footprint = np.array([0.1, 0.4, 0.2])
    own = np.array([[1.0, 0.0], [0.2, 0.7], [-0.5, 0.0], [0.2, 0.0]])
    room, _ = clearances(own, np.full(4, 0.1), footprint)
    np.testing.assert_allclose(room, [0.3, 0.4, 0.1, -0.3], atol=1e-12)


def test_only_the_nearest_obstacles_are_observed_one_by_one_and_none_is_needed() -> None:
    far = tuple((3.0, -3.0 + 0.1 * index, 0.05) for index in range(7))
    near = ((1.2, 0.9, 0.3), (-1.5, 0.2, 0.25), (0.5, 0.9, 0.2), (0.5, -1.5, 0.2))
    reported = slice(OFFSET, OFFSET + 5 * OBSTACLES)
    both = seen(dataclasses.replace(STATE, obstacles=far + near))
    np.testing.assert_allclose(both[reported], seen(dataclasses.replace(STATE, obstacles=near[::-1]))[reported])
    np.testing.assert_allclose(seen(dataclasses.replace(STATE, obstacles=()))[reported], 0.0, atol=1e-3)


def test_however_large_the_network_answers_its_mean_stays_within_the_range_of_actions() -> None:
    policy = LearnedPolicy(weights())
    values, name = policy.nominal_action(STATE, np.array([0.3, 0.4]))
    assert name == "learned"
    given = weights()
    x = (seen(STATE, (0.3, 0.4)) - 0.1) / 0.5
    for index in range(2):
        x = np.tanh(given[f"policy.{index}.weight"] @ x + given[f"policy.{index}.bias"])
    mean = np.clip(given["policy.2.weight"] @ x + given["policy.2.bias"], -1, 1)
    np.testing.assert_allclose(values, [0.7 + 1.3 * mean[0], 0.34 * mean[1]], rtol=1e-4)
    given = weights()
    policy = LearnedPolicy(given.with_tensors({"policy.2.bias": [100.0, -100.0]}))
    assert policy.nominal_action(STATE, None)[0] == pytest.approx((2.0, -0.34))


def test_without_a_latent_it_takes_the_one_where_nothing_acts() -> None:
    policy = LearnedPolicy(weights())
    nominal = policy.nominal_action(STATE, weights()["latent_nominal"].astype(np.float64))
    assert policy.nominal_action(STATE, None) == nominal
    assert policy.nominal_action(STATE, np.array([0.9, 0.9])) != nominal


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"values": (0.0,) * 3}, "values: got 3 numbers, wanted 4"),
        ({"goal": (1.0,)}, "goal: got 1 numbers, wanted 2"),
        ({"footprint": ()}, "footprint: got 0 numbers, wanted 3"),
        ({"obstacles": ((1.0, 2.0),)}, "wanted 3 numbers in each"),
        ({"values": (0.0, 0.0, float("nan"), 0.0)}, "not finite"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(MessageError, match=sentence):
        LearnedPolicy(weights()).nominal_action(dataclasses.replace(STATE, **change), None)


def test_latents_of_another_length_and_weights_of_no_or_another_policy_are_refused() -> None:
    with pytest.raises(MessageError, match="got 3 entries, wanted 2"):
        LearnedPolicy(weights()).nominal_action(STATE, np.zeros(3))
    with pytest.raises(InputError, match="no policy"):
        LearnedPolicy(without_policy(weights()))
    with pytest.raises(InputError, match="train it again"):
        LearnedPolicy(weights().with_tensors({"policy.0.weight": np.zeros((8, 12))}))


def nominal_of(node: PolicyNode, latent: LatentMessage | Stale) -> NominalMessage:
    message = node.step("r", STATE, {LATENT: latent})[NOMINAL]
    assert isinstance(message, NominalMessage)
    return message


def test_the_service_takes_the_learned_policy_where_there_is_one() -> None:
    stale = Stale(LATENT, None)
    model = learned_model(weights())
    assert nominal_of(PolicyNode(model), stale).controller == "learned"
    assert nominal_of(PolicyNode(model, controller="goal_seeker"), stale).controller == "goal_seeker:seek"
    assert nominal_of(PolicyNode(learned_model(without_policy(weights()))), stale).controller == "goal_seeker:seek"
    assert nominal_of(PolicyNode(load_model("car")), stale).controller == "goal_seeker:seek"


def test_the_service_hands_the_latent_on_and_leaves_a_foreign_one_aside() -> None:
    model = learned_model(weights())
    latent = latent_of(0.9, 0.9, **stamp(7, epoch=5), model=fingerprint(model))
    node = PolicyNode(model)
    assert nominal_of(node, latent).values == LearnedPolicy(weights()).nominal_action(STATE, np.array([0.9, 0.9]))[0]
    assert nominal_of(node, dataclasses.replace(latent, model="another")) != nominal_of(node, latent)
    assert (
        nominal_of(node, dataclasses.replace(latent, values=(0.9,))).values
        == LearnedPolicy(weights()).nominal_action(STATE, None)[0]
    )


def test_controllers_that_do_not_exist_or_cannot_work_are_refused() -> None:
    with pytest.raises(InputError, match="controller 'learnt'"):
        controller_for(load_model("car"), "learnt")
    with pytest.raises(InputError, match="no networks"):
        controller_for(load_model("car"), "learned")
    with pytest.raises(InputError, match="no policy"):
        controller_for(learned_model(without_policy(weights())), "learned")
    assert set(robot_named("car").controllers(load_model("car"))) == {"goal_seeker", "planner", "way_seeker"}
