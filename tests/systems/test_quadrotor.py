"""Unit quaternions as states, and the quadrotor of the examples against one that turns a rotation matrix."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.check_robot import check_robot
from safedpa.diagnosis.add_effect import add_effect
from safedpa.dynamics import PhysicsModel, load_user_file
from safedpa.dynamics.base import bases_of
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.systems import System, Variable, add_system
from safedpa.systems.robots import robot_named

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "quadrotor" / "quadrotor.py"
OWN = runpy.run_path(str(EXAMPLE))
SYSTEM: System = OWN["SYSTEM"]
NOISE = np.array([0.003] * 3 + [0.02] * 3 + [0.002] * 4)
turns = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def plain() -> PhysicsModel:
    return PhysicsModel(OWN["RigidQuadrotor"](), (), {}, 0.02)


def flight(seed: int, rows: int, **world: float) -> Run:
    """A log of random wanted accelerations; the sensor reports q or -q."""
    random, truth = np.random.default_rng(seed), OWN["Flight"](seed, **world)
    states, actions, wanted = [], [], np.zeros(3)
    for row in range(rows):
        now = np.array(truth.values)
        if row % 25 == 0:
            back = -0.6 * (now[:3] - [0.0, 0.0, 1.5]) - 0.3 * now[3:6]
            wanted = np.clip(back + random.uniform(-3.0, 3.0, 3), -4.0, 4.0)
        if row % 5 == 0:
            action = OWN["steered"](now, wanted)
        states.append(now + NOISE * random.standard_normal(10))
        actions.append(action)
        truth.advance(action, 0.02)
    measured = np.array(states)
    measured[:, 6:] *= np.where(random.random(rows) < 0.02, -1.0, 1.0)[:, None]
    return Run.from_arrays(0.02 * np.arange(rows), measured, np.array(actions), SYSTEM, name=f"flight_{seed}")


@given(turn=turns, rates=turns, thrust=st.floats(0.0, 20.0))
def test_a_step_of_the_model_is_that_of_a_rotation_matrix(turn: Any, rates: Any, thrust: float) -> None:
    matrix = OWN["rotated"](turn)
    state = np.array([0.0] * 6 + list(OWN["quaternion_of"](matrix)))
    after = plain().step(state, np.array([thrust, *rates]))
    turned = np.array([0.0] * 6 + list(OWN["quaternion_of"](matrix @ OWN["rotated"](0.02 * rates))))
    assert np.abs(SYSTEM.difference(after, turned)[6:]).max() < 1e-6
    assert np.linalg.norm(after[6:]) == pytest.approx(1.0, abs=1e-12)


@given(turn=turns, sign=st.sampled_from([-1.0, 1.0]))
def test_the_difference_of_attitudes_is_that_of_the_rotation_whatever_the_sign(turn: Any, sign: float) -> None:
    angle = float(np.linalg.norm(turn))
    angle = min(angle, abs(2.0 * np.pi - angle))
    state, level = np.zeros(10), np.array([0.0] * 6 + [1.0, 0.0, 0.0, 0.0])
    state[6:] = sign * np.array(OWN["quaternion_of"](OWN["rotated"](turn)))
    length = float(np.linalg.norm(SYSTEM.difference(state, level)))
    assert length == pytest.approx(2.0 * np.sin(angle / 4.0), abs=1e-6)


@pytest.mark.parametrize("entries", [("w", "x", "y", "y"), ("w", "x", "y", "v")])
def test_a_rotation_of_other_than_four_states_is_refused(entries: Any) -> None:
    states = tuple(Variable(name, "1", -1.1, 1.1) for name in "wxyz")
    with pytest.raises(InputError, match="wanted four states"):
        add_system(System("turning", states, (), rotations=(entries,)))


@pytest.mark.long
def test_its_filter_leaves_the_yaw_rate_alone_and_touches_nothing() -> None:
    load_user_file(EXAMPLE)
    rows = check_robot(robot_named("quadrotor"))
    wrong = [str(row) for row in rows if not row.ends_well]
    assert len(wrong) == 1
    assert "no barrier that entry 3 of the action changes" in wrong[0]


@pytest.mark.long
def test_payload_and_rotor_drag_are_found_in_flights() -> None:
    load_user_file(EXAMPLE)
    model = PhysicsModel(bases_of("quadrotor")["rigid_quadrotor"](), (), {}, 0.02)
    runs = [flight(seed, 700, payload=0.25, drag=0.4) for seed in (1, 2)]
    loaded = add_effect(model, "payload", runs, 0.5).model
    found = add_effect(loaded, "rotor_drag", runs, 0.5)
    truths = {"payload.mass_ratio": 0.25, "rotor_drag.side": 0.4, "rotor_drag.vertical": 0.12}
    for path, truth in truths.items():
        std = found.values[path].std
        assert std is not None
        assert abs(found.values[path].value - truth) <= 2.0 * std + 0.005 * truth
    assert found.after.value < 0.1
