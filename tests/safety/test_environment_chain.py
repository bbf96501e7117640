"""Wrappers below the filter, vector environments of stable-baselines3, and what a learner gets."""

import warnings
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is an optional extra")

from gymnasium import wrappers  # noqa: E402
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv  # noqa: E402
from gymnasium.wrappers import vector  # noqa: E402

from safedpa.errors import InputError  # noqa: E402
from safedpa.safety import FilterSettings, FunctionBarrier, GymnasiumSafetyFilter, SafetyFilter, Status  # noqa: E402

DT = 0.05
F, G = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[DT * DT / 2], [DT]])


class Cart(gymnasium.Env):  # type: ignore[misc]
    """A double integrator in front of a wall at 1."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, reach: float = 1.0) -> None:
        self.action_space = gymnasium.spaces.Box(-reach, reach, (1,), np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = np.zeros(2)
        return self.x.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x = F @ self.x + G @ np.asarray(action, float)
        return self.x.copy(), float(self.x[0]), bool(self.x[0] > 1.0), False, {}


class Whim(gymnasium.Wrapper):  # type: ignore[misc]
    """A user's wrapper that doubles the action."""

    def step(self, action: Any) -> Any:
        return self.env.step(2.0 * action)


class Lamp(gymnasium.Wrapper):  # type: ignore[misc]
    """A user's wrapper that adds a method of its own."""

    def shine(self) -> str:
        return "on"


def make_filter() -> SafetyFilter:
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.1, epsilon=0.002)
    return SafetyFilter(
        lambda x: (F @ x, G),
        [FunctionBarrier(lambda x: 1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.1 * max(x[1], 0.0))],
        settings,
    )


ACTIONS_CHANGED = {
    "rescale": lambda: wrappers.RescaleAction(Cart(0.4), np.float32(-1), np.float32(1)),
    "sticky": lambda: wrappers.StickyAction(Cart(), 0.5),
    "transform": lambda: wrappers.TransformAction(Cart(), lambda a: 0.5 * a, Cart().action_space),
    "repeat": lambda: wrappers.MaxAndSkipObservation(Cart(), 2),
    "own": lambda: Whim(Cart()),
    "behind others": lambda: wrappers.TimeLimit(wrappers.OrderEnforcing(Whim(Lamp(Cart()))), 60),
    "each part": lambda: SyncVectorEnv([Cart, lambda: Whim(Cart())]),
    "other process": lambda: AsyncVectorEnv([lambda: wrappers.StickyAction(Cart(), 0.5)] * 2),
    "vector": lambda: vector.RescaleAction(SyncVectorEnv([Cart]), np.float32(-1), np.float32(1)),
}


@pytest.mark.parametrize("make", ACTIONS_CHANGED.values(), ids=list(ACTIONS_CHANGED))
def test_a_wrapper_that_changes_actions_is_refused_with_the_remedy(make: Any) -> None:
    env = make()
    with pytest.raises(InputError, match=r"below the filter: it may change actions .*place it above the filter"):
        GymnasiumSafetyFilter(env, make_filter(), lambda seen: seen)
    env.close()


OBSERVATIONS_CHANGED = {
    "normalise": lambda: wrappers.NormalizeObservation(Cart()),
    "stack": lambda: wrappers.FlattenObservation(wrappers.FrameStackObservation(Cart(), 2)),
    "transform": lambda: wrappers.TransformObservation(Cart(), lambda seen: -seen, Cart.observation_space),
    "vector": lambda: vector.TransformObservation(SyncVectorEnv([Cart]), lambda seen: -seen),
}


@pytest.mark.parametrize("make", OBSERVATIONS_CHANGED.values(), ids=list(OBSERVATIONS_CHANGED))
def test_a_changed_observation_needs_state_of(make: Any) -> None:
    with pytest.raises(InputError, match=r"below the filter: .*give state_of"):
        GymnasiumSafetyFilter(make(), make_filter())
    GymnasiumSafetyFilter(make(), make_filter(), state_of=lambda seen: seen)


def test_a_delayed_observation_is_refused_unless_the_user_accounts_for_it() -> None:
    late = wrappers.DelayObservation(Cart(), 5)
    with pytest.raises(InputError, match="DelayObservation below the filter"):
        GymnasiumSafetyFilter(late, make_filter(), lambda seen: seen)
    GymnasiumSafetyFilter(late, make_filter(), lambda seen: seen, accounted_for=(wrappers.DelayObservation,))


def test_an_exception_for_one_part_of_a_vector_environment_does_not_hide_another_part() -> None:
    env = SyncVectorEnv([lambda: wrappers.DelayObservation(Cart(), 5), lambda: Whim(Cart())])
    with pytest.raises(InputError, match="Whim below the filter"):
        GymnasiumSafetyFilter(env, make_filter(), lambda seen: seen, accounted_for=(wrappers.DelayObservation,))


@pytest.mark.parametrize("reach", [1.0, 0.4])
def test_wrappers_that_change_nothing_are_accepted_where_the_actuators_reach(reach: float) -> None:
    env = wrappers.RecordEpisodeStatistics(wrappers.ClipAction(wrappers.TimeLimit(Lamp(Cart(reach)), 400)))
    if reach < 1.0:
        with pytest.raises(InputError, match="wanted one that holds the settings' bounds"):
            GymnasiumSafetyFilter(env, make_filter())
        return
    env = GymnasiumSafetyFilter(env, make_filter())
    env.reset(seed=0)
    assert not any(env.step(np.ones(1, np.float32))[2] for _ in range(300))
    assert env.get_wrapper_attr("shine")() == "on"


def test_the_same_run_gives_the_same_information_and_gymnasiums_checker_accepts_it() -> None:
    def run() -> list[Any]:
        env = GymnasiumSafetyFilter(Cart(), make_filter())
        env.reset(seed=0)
        return [env.step(np.ones(1, np.float32))[4]["verdict"] for _ in range(60)]

    first, second = run(), run()
    assert first == second
    assert list(map(hash, first)) == list(map(hash, second))
    assert first[0] != first[-1]
    assert first[0] != "passed"
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about unbounded observations, and that it is a wrapper
        check_env(GymnasiumSafetyFilter(Cart(), make_filter()), skip_render_check=True)


def test_the_applied_action_and_a_penalty_reach_the_learner() -> None:
    plain, dear = (GymnasiumSafetyFilter(Cart(), make_filter(), penalty=penalty) for penalty in (0.0, 3.0))
    many = GymnasiumSafetyFilter(SyncVectorEnv([Cart] * 2), make_filter(), penalty=3.0)
    for env in (plain, dear, many):
        env.reset(seed=0)
    for _ in range(80):
        (_, reward, _, _, info), (_, less, _, _, _) = (env.step(np.ones(1, np.float32)) for env in (plain, dear))
        _, rewards, _, _, infos = many.step(np.ones((2, 1), np.float32))
        change = (info["verdict"].action[0] - 1.0) / 2.0
        assert less == pytest.approx(reward - 3.0 * change**2)
        assert rewards == pytest.approx([less, less])
        assert info["applied_action"] == pytest.approx(info["verdict"].action)
        assert infos["applied_action"] == pytest.approx(np.tile(info["applied_action"], (2, 1)))
    assert change != 0.0
    assert dear.step(np.full(1, np.nan, np.float32))[1] < plain.step(np.full(1, np.nan, np.float32))[1] - 2.9
    for wrong in (-1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="penalty: got"):
            GymnasiumSafetyFilter(Cart(), make_filter(), penalty=wrong)


def test_a_vector_environment_of_stable_baselines3_is_filtered_and_inspected() -> None:
    common = pytest.importorskip("stable_baselines3.common.vec_env", reason="stable-baselines3 is an optional extra")
    env = GymnasiumSafetyFilter(common.VecMonitor(common.DummyVecEnv([Cart] * 2)), make_filter())
    env.reset()
    statuses = set()
    for _ in range(150):
        _, _, dones, infos = env.step(np.array([[1.0], [np.nan]], np.float32))
        assert not dones.any()
        statuses |= {(index, info["verdict"].status) for index, info in enumerate(infos)}
        assert all(info["applied_action"] == pytest.approx(info["verdict"].action) for info in infos)
    assert statuses == {(0, Status.passed), (0, Status.corrected), (1, Status.fallback)}
    with pytest.raises(InputError, match="StickyAction below the filter"):
        GymnasiumSafetyFilter(common.DummyVecEnv([lambda: wrappers.StickyAction(Cart(), 0.5)]), make_filter())
    with pytest.raises(InputError, match=r"VecNormalize below the filter.*give state_of"):
        GymnasiumSafetyFilter(common.VecNormalize(common.DummyVecEnv([Cart])), make_filter())
    apart = common.SubprocVecEnv([Cart], start_method="fork")
    with pytest.raises(InputError, match=r"SubprocVecEnv: .*wrapper_class=GymnasiumSafetyFilter"):
        GymnasiumSafetyFilter(apart, make_filter())
    apart.close()


@pytest.mark.long
def test_an_off_policy_learner_can_store_what_was_applied() -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is an optional extra")
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.vec_env import DummyVecEnv

    from safedpa.safety.stable_baselines3 import AppliedActionReplayBuffer

    check_env(GymnasiumSafetyFilter(wrappers.TimeLimit(Cart(), 60), make_filter()))
    venv = GymnasiumSafetyFilter(DummyVecEnv([lambda: wrappers.TimeLimit(Cart(), 60)]), make_filter())
    learner = sb3.SAC("MlpPolicy", venv, replay_buffer_class=AppliedActionReplayBuffer, learning_starts=50, seed=0)
    learner.learn(120)
    buffer = learner.replay_buffer
    states, following = buffer.observations[:119, 0], buffer.next_observations[:119, 0]
    # The velocity that followed shows which action was applied.
    applied = (following[:, 1] - states[:, 1]) / DT
    assert buffer.actions[:119, 0, 0] == pytest.approx(applied, abs=1e-4)
    with pytest.raises(InputError, match="got no applied_action"):
        buffer.add(states[:1], following[:1], np.zeros((1, 1)), np.zeros(1), np.zeros(1), [{}])
