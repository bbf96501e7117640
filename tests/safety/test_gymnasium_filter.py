"""The wrapper around an environment and a reckless policy."""

from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is an optional extra")

from safedpa.errors import InputError  # noqa: E402
from safedpa.safety import (  # noqa: E402
    FilterSettings,
    FunctionBarrier,
    GymnasiumSafetyFilter,
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


def wrapped(**changes: Any) -> Any:
    safe = SafetyFilter(lambda x: (F @ x, G), [FunctionBarrier(wall)], SETTINGS)
    return GymnasiumSafetyFilter(Cart(), safe, state_of=lambda seen: seen[:2], **changes)


def test_reckless_policy_never_hits_the_wall() -> None:
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


def test_without_the_wrapper_it_does() -> None:
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


def test_a_policy_that_returns_nan_gets_the_brake() -> None:
    env = wrapped()
    env.reset()
    verdict = env.step(np.array([np.nan], np.float32))[4]["verdict"]
    assert verdict.status is Status.fallback
    assert env.env.taken.tolist() == [-1.0]


def test_observation_is_the_state_by_default() -> None:
    safe = SafetyFilter(lambda x: (x, np.zeros((3, 1))), [FunctionBarrier(lambda x: x[2])], SETTINGS)
    env = GymnasiumSafetyFilter(Cart(), safe)
    env.reset()
    assert env.step(np.array([0.0], np.float32))[4]["verdict"].h_now == 1.0


def test_other_action_spaces_are_refused() -> None:
    class Keys(Cart):
        action_space = gymnasium.spaces.Discrete(3)

    class Two(Cart):
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    safe = SafetyFilter(lambda x: (x, np.eye(1)), [], SETTINGS)
    for env in (Keys(), Two()):
        with pytest.raises(InputError, match=r"action space: got .*, wanted a Box of shape \(1,\)"):
            GymnasiumSafetyFilter(env, safe)
