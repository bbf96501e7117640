"""The wrapper around an environment and a reckless policy."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is an optional extra")

from safedpa.errors import InputError  # noqa: E402
from safedpa.safety import (  # noqa: E402
    FilterSettings,
    FunctionBarrier,
    GymnasiumSafetyFilter,
    GymnasiumVectorSafetyFilter,
    Plausible,
    SafetyFilter,
    Status,
)

DT = 0.05
F, G = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[DT * DT / 2], [DT]])
SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), epsilon=0.002, eta=0.1)


class Cart(gymnasium.Env):  # type: ignore[misc]
    """A double integrator; the wall stands at 1."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = np.array([-2.0, 0.0])
        return np.append(self.x, 1.0), {"start": True}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken = action
        self.x = F @ self.x + G @ action
        return np.append(self.x, 1.0), 0.0, bool(self.x[0] >= 1.0), False, {"own": 1}


def wall(x: Any) -> float:
    return float(1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.1 * max(x[1], 0.0))


def filter_of() -> SafetyFilter:
    return SafetyFilter(lambda x: (F @ x, G), [FunctionBarrier(wall)], SETTINGS)


def wrapped(**changes: Any) -> Any:
    return GymnasiumSafetyFilter(Cart(), filter_of(), state_of=lambda seen: seen[:2], **changes)


def test_a_reckless_policy_never_hits_the_wall_that_it_hits_without_the_wrapper() -> None:
    env, statuses = wrapped(), set()
    env.reset(seed=0)
    for _ in range(300):
        observation, _, terminated, _, info = env.step(np.array([1.0], np.float32))
        statuses.add(info["verdict"].status)
        assert info["own"] == 1
        assert env.env.taken.dtype == np.float32
        assert not terminated
    assert statuses == {Status.passed, Status.corrected}
    assert observation[0] > 0.9
    env = Cart()
    env.reset(seed=0)
    assert any(env.step(np.array([1.0]))[2] for _ in range(300))


def test_reset_passes_through_and_scenes_may_change() -> None:
    env = wrapped(
        barriers_of=lambda seen: [FunctionBarrier(lambda x: 9.0 + 0.0 * seen[2] - x[0])], latent_of=lambda seen: None
    )
    observation, info = env.reset(seed=3)
    assert info == {"start": True}
    assert observation.tolist() == [-2.0, 0.0, 1.0]
    assert env.step(np.array([0.5], np.float32))[4]["verdict"].h_now == 11.0


def test_a_policy_that_returns_nan_gets_the_brake_and_the_observation_is_the_state_by_default() -> None:
    env = wrapped()
    env.reset()
    verdict = env.step(np.array([np.nan], np.float32))[4]["verdict"]
    assert verdict.status is Status.fallback
    assert env.env.taken.tolist() == [-1.0]
    safe = SafetyFilter(lambda x: (x, np.zeros((3, 1))), [FunctionBarrier(lambda x: x[2])], SETTINGS)
    env = GymnasiumSafetyFilter(Cart(), safe)
    env.reset()
    assert env.step(np.array([0.0], np.float32))[4]["verdict"].h_now == 1.0


def test_other_action_spaces_are_refused() -> None:
    class Keys(Cart):
        action_space = gymnasium.spaces.Discrete(3)

    class Two(Cart):
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    class Unbounded(Cart):
        action_space = gymnasium.spaces.Space((1,), np.float32)  # of one float, and without bounds

    safe = SafetyFilter(lambda x: (x, np.eye(1)), None, SETTINGS)
    for env in (Keys(), Two(), Unbounded()):
        with pytest.raises(InputError, match=r"action space: got .*, wanted a Box of floats of shape \(1,\)"):
            GymnasiumSafetyFilter(env, safe)


def reckless(env: Any, steps: int = 60) -> list[Any]:
    env.reset(seed=0)
    return [env.step(np.array([1.0], np.float32))[4]["verdict"] for _ in range(steps)]


@pytest.mark.parametrize("kind", [np.int64, np.int8, np.uint8, np.float16], ids=str)
def test_a_box_that_would_round_the_action_is_refused(kind: Any) -> None:
    class Whole(Cart):
        action_space = gymnasium.spaces.Box(0 if kind is np.uint8 else -1, 1, (1,), kind)

    with pytest.raises(InputError, match=r"action space: got Box.*, wanted a Box of floats"):
        GymnasiumSafetyFilter(Whole(), filter_of(), state_of=lambda seen: seen[:2])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_wider_box_is_brought_within_the_settings(kind: Any) -> None:
    class Wide(Cart):
        action_space = gymnasium.spaces.Box(-3.0, np.inf, (1,), kind)

    env = GymnasiumSafetyFilter(Wide(), filter_of(), state_of=lambda seen: seen[:2])
    env.reset()
    verdict = env.step(np.array([2.5]))[4]["verdict"]
    assert (verdict.status, verdict.action.tolist()) == (Status.corrected, [1.0])
    assert env.env.taken.tolist() == [1.0]
    assert env.env.taken.dtype == kind


def test_bounds_that_single_precision_cannot_hold() -> None:
    """0.7 is a little less in 32 bits, 0.34 a little more: the environment gets neither more than its own."""
    settings = FilterSettings(action_low=(-0.34,), action_high=(0.34,), epsilon=0.002, eta=0.1)

    class Tight(Cart):
        action_space = gymnasium.spaces.Box(-0.34, 0.34, (1,), np.float32)

    safe = SafetyFilter(lambda x: (F @ x, G), [FunctionBarrier(wall)], settings)
    env = GymnasiumSafetyFilter(Tight(), safe, state_of=lambda seen: seen[:2])
    for nominal in (-1.0, 1.0):
        env.reset()
        env.step(np.array([nominal], np.float32))
        assert abs(float(env.env.taken[0])) <= 0.34
        assert float(env.env.taken[0]) == pytest.approx(0.34 * nominal)
        assert env.env.taken.dtype == np.float32


def test_an_observation_that_is_no_state_needs_state_of() -> None:
    safe = SafetyFilter(
        lambda x: (F @ x, G),
        [FunctionBarrier(wall)],
        SETTINGS,
        state_range=Plausible(np.full(2, -9.0), np.full(2, 9.0), ("position", "velocity")),
    )
    with pytest.raises(
        InputError, match=r"observation space: got Box.*\(3,\).*, wanted a Box of shape \(2,\).*state_of"
    ):
        GymnasiumSafetyFilter(Cart(), safe)

    class Named(Cart):
        observation_space = gymnasium.spaces.Dict({"x": gymnasium.spaces.Box(-1.0, 1.0, (2,))})

    with pytest.raises(InputError, match=r"observation space: got Dict.*wanted a Box of one axis; give state_of"):
        GymnasiumSafetyFilter(Named(), filter_of())
    GymnasiumSafetyFilter(Named(), filter_of(), state_of=lambda seen: seen["x"])

    class Picture(Cart):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2, 3))

    with pytest.raises(InputError, match=r"observation space: got Box.*\(2, 3\).*wanted a Box of one axis"):
        GymnasiumSafetyFilter(Picture(), filter_of())


def many(count: int, **changes: Any) -> Any:
    return gymnasium.vector.SyncVectorEnv([lambda: Cart(**changes) for _ in range(count)])


def test_a_vector_environment_gets_one_verdict_an_environment() -> None:
    env = GymnasiumSafetyFilter(many(3), filter_of(), lambda seen: seen[:2])
    assert isinstance(env, GymnasiumVectorSafetyFilter)
    _, infos = env.reset(seed=0)
    assert infos["start"].tolist() == [True] * 3
    nominal_actions = np.array([[1.0], [-0.5], [np.nan]], np.float32)
    statuses: set[tuple[int, Status]] = set()
    for _ in range(120):
        observations, _, terminated, _, infos = env.step(nominal_actions)
        verdicts = infos["verdict"]
        assert verdicts.shape == (3,)
        (masks,) = (value for key, value in infos.items() if key.startswith("_") and key.endswith("verdict"))
        assert masks.tolist() == [True] * 3, "as gymnasium marks which environments have a value"
        assert infos["own"].tolist() == [1, 1, 1]
        assert not terminated.any()
        statuses |= {(index, verdict.status) for index, verdict in enumerate(verdicts)}
        taken = [cart.taken for cart in env.env.envs]
        np.testing.assert_allclose(taken, [verdict.action for verdict in verdicts], rtol=1e-6)
    assert statuses == {(0, Status.passed), (0, Status.corrected), (1, Status.passed), (2, Status.fallback)}
    assert observations[0, 0] > 0.9


def test_it_decides_as_one_environment_does() -> None:
    alone, together = wrapped(), GymnasiumVectorSafetyFilter(many(2), filter_of(), state_of=lambda seen: seen[:2])
    together.reset(seed=0)
    for one in reckless(alone):
        for other in together.step(np.ones((2, 1), np.float32))[4]["verdict"]:
            assert (other.status, other.action.tolist(), other.h_next) == (one.status, one.action.tolist(), one.h_next)


def test_scenes_and_latents_of_each_environment() -> None:
    env = GymnasiumSafetyFilter(
        many(2),
        filter_of(),
        state_of=lambda seen: seen[:2],
        barriers_of=lambda seen: [FunctionBarrier(lambda x: 9.0 + 0.0 * seen[2] - x[0])],
        latent_of=lambda seen: None,
    )
    env.reset()
    found = env.step(np.zeros((2, 1)))[4]["verdict"]
    assert [verdict.h_now for verdict in found] == [11.0, 11.0]


@pytest.mark.parametrize(("low", "high"), [((-1.0, -0.1), (1.0, 1.0)), ((-1.0, -1.0), (0.1, 1.0))])
def test_each_bound_of_each_action_has_to_be_in_the_box(low: tuple[float, ...], high: tuple[float, ...]) -> None:
    two = FilterSettings(action_low=(-0.5, -0.5), action_high=(0.5, 0.5), backup_action=(0.0, 0.0), system="")
    safe, env = SafetyFilter(lambda x: (F @ x, np.hstack([G, G])), [FunctionBarrier(wall)], two), Cart()
    env.action_space = gymnasium.spaces.Box(-0.5, 0.5, (2,), np.float32)
    GymnasiumSafetyFilter(env, safe, lambda seen: seen[:2])
    env.action_space = gymnasium.spaces.Box(np.float32(low), np.float32(high), (2,))
    with pytest.raises(InputError, match="wanted one that holds the settings' bounds"):
        GymnasiumSafetyFilter(env, safe, lambda seen: seen[:2])


def test_environments_that_do_not_fit_and_mistakes_around_them_are_reported() -> None:
    class Whole(Cart):
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.int64)

    with pytest.raises(InputError, match=r"action space: got Box.*, wanted a Box of floats"):
        GymnasiumSafetyFilter(gymnasium.vector.SyncVectorEnv([Whole]), filter_of(), lambda seen: seen[:2])
    env = GymnasiumSafetyFilter(many(2), filter_of(), lambda seen: seen[:2])
    env.reset()
    with pytest.raises(InputError, match="actions: got 3, wanted 2, one for each environment"):
        env.step(np.zeros((3, 1)))
    with pytest.raises(InputError, match="safety_filter: got int, wanted a SafetyFilter"):
        GymnasiumSafetyFilter(Cart(), 3)
    env = GymnasiumSafetyFilter(many(2), filter_of(), lambda seen: seen[:2])
    env.reset()
    with pytest.raises(InputError, match=r"actions: got 1.0, wanted 2, one for each environment"):
        env.step(1.0)


def test_before_the_first_observation_nothing_is_known() -> None:
    env = GymnasiumVectorSafetyFilter(many(2), filter_of(), state_of=lambda seen: seen)
    env.env.reset()
    assert {verdict.status for verdict in env.step(np.ones((2, 1)))[4]["verdict"]} == {Status.fallback}


@pytest.mark.parametrize("count", [0, 2], ids=["one", "many"])
def test_a_policy_that_writes_into_its_observation_moves_no_state(count: int) -> None:
    env = GymnasiumSafetyFilter(many(count) if count else Cart(), filter_of(), state_of=lambda seen: seen[:2])
    observation, _ = env.reset()
    nominal = np.ones((count, 1) if count else 1, np.float32)
    for _ in range(150):
        observation -= 50.0
        observation = env.step(nominal)[0]
        assert np.all(observation[..., 0] < 1.0)


def test_a_wrapped_environment_can_be_copied() -> None:
    env = wrapped()
    env.reset()
    other = deepcopy(env)
    assert other.step(np.ones(1, np.float32))[4]["verdict"].status is Status.passed
    assert env.unwrapped.x.tolist() == [-2.0, 0.0]
