"""Which effects a system may have is decided by what it declares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.effects import CommandEffect, general_effects
from safedpa.effects.general import position_of_rate
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.systems import System, Variable

X, Y, YAW = Variable("x", "m", -9, 9), Variable("y", "m", -9, 9), Variable("yaw", "rad", -9, 9, angle=True)
VX, VY, TURN = Variable("vx", "m/s", -9, 9), Variable("vy", "m/s", -9, 9), Variable("turn", "rad/s", -9, 9)
LEVEL, PUMP, VOLTS = Variable("level", "m", 0, 4), Variable("pump", "V", 0, 10), Variable("battery", "V", 8, 14)
ANGLE, RATE = Variable("angle", "rad", -9, 9), Variable("rate", "rad/s", -9, 9)
FORCE, OTHER = Variable("force", "N", -1, 1), Variable("other", "N", -1, 1)
MOVING = {"vx": 1.0, "vy": 1.0, "turn": 1.0, "rate": 2.0, "level": 1.0}

JOINT, PLANE, TANK = (ANGLE, RATE), (X, Y, YAW, VX, VY, TURN), (LEVEL,)


def named(state: tuple[Variable, ...], action: tuple[Variable, ...], **more: object) -> set[str]:
    moving = {item.name: MOVING[item.name] for item in state if item.name in MOVING}
    return {item.name for item in general_effects(System("any", state, action), moving, **more)}  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("state", "action", "more", "has", "lacks"),
    [
        (JOINT, (FORCE,), {}, {"rate_gravity", "rate_spring", "rate_bias", "force_torque_speed"}, {"rate_by_angle"}),
        (PLANE, (FORCE, OTHER), {}, {"vx_by_vy", "force_by_other", "velocity_drag", "turn_bias"}, {"turn_spring"}),
        (PLANE, (FORCE, OTHER), {}, set(), {"vx_spring", "vx_bias", "velocity_body_drag", "force_torque_speed"}),
        (PLANE, (FORCE,), {"heading": "yaw"}, {"velocity_body_drag"}, set()),
        (PLANE, (FORCE,), {"positions": {"vx": "x"}}, {"vx_scale", "x_sensor_delay"}, {"turn_bias"}),
        (
            TANK,
            (PUMP,),
            {},
            {"pump_lag", "level_push", "pump_reservoir"},
            {"pump_dead_zone", "level_spring", "level_bias"},
        ),
        (JOINT, (FORCE, VOLTS), {"supply": {"battery": 12.0}}, {"force_supply"}, {"battery_gain"}),
    ],
)
def test_what_a_system_declares_decides_what_it_may_lack(
    state: tuple[Variable, ...],
    action: tuple[Variable, ...],
    more: dict[str, object],
    has: set[str],
    lacks: set[str],
) -> None:
    found = named(state, action, **more)
    assert has <= found
    assert not lacks & found


@pytest.mark.parametrize(
    ("state", "pairs"),
    [
        (JOINT, {"rate": "angle"}),
        (PLANE, {"turn": "yaw"}),
        ((X, Y, VX, VY), {"vx": "x", "vy": "y"}),
        ((LEVEL,), {}),
        ((Variable("a", "rad", -1, 1), Variable("b", "rad", -1, 1), RATE), {}),
    ],
)
def test_rates_are_paired_with_their_positions_only_if_that_is_certain(
    state: tuple[Variable, ...], pairs: dict[str, str]
) -> None:
    assert position_of_rate(System("any", state, ())) == pairs


@given(exponent=st.floats(-4.0, 3.55))
def test_lags_and_delays_of_many_periods_are_in_bounds_at_any_period(exponent: float) -> None:
    period = 10.0**exponent
    for item in general_effects(System("any", JOINT, (FORCE,)), {"rate": 2.0}):
        scaled = item.at_period(period)
        assert scaled.at_period(period) is scaled
        assert all(np.isfinite([p.low, p.high, p.typical]).all() for p in scaled.parameters)
        if item.family in ("lag", "delay"):
            assert scaled.parameters[0].high >= 99.0 * period
            assert scaled.parameters[0].typical >= 2.0 * period


@given(inflows=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12), emptiness=st.floats(0.5, 20.0))
def test_a_vessel_in_front_of_an_actuator_keeps_its_balance(inflows: list[float], emptiness: float) -> None:
    (item,) = (each for each in general_effects(System("any", TANK, (PUMP,))) if each.family == "reservoir")
    assert isinstance(item, CommandEffect)
    memory = item.initial_memory({"pump": inflows[0]})
    before, total = 0.5 * emptiness * memory["pump"] ** 2, 0.0
    for inflow in inflows:
        felt, memory = item.transform({"pump": inflow}, memory, {"seconds": emptiness}, 1.0, FLOATS)
        total += inflow - felt["pump"]
        again, _ = item.transform({"pump": inflow}, memory, {"seconds": 0.0}, 1.0, FLOATS)
        assert again["pump"] == inflow
    assert 0.0 <= memory["pump"] <= 1.0 + 1e-12
    assert 0.5 * emptiness * memory["pump"] ** 2 == pytest.approx(before + total, abs=1e-9)


def test_partners_are_effects_of_the_same_system() -> None:
    items = {item.name: item for item in general_effects(System("any", JOINT, (FORCE,)), {"rate": 2.0})}
    named_by = {item.name: set(item.partners) & set(items) for item in items.values()}
    assert named_by["rate_drag"] == {"rate_friction"}
    assert named_by["rate_friction"] == {"rate_gravity"}
    assert named_by["rate_speed_limit"] == {"force_delay", "force_gain"}
    assert {item.family for item in items.values() if item.rare} >= {"backlash", "stribeck", "second_order"}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"positions": {"rate": "angel"}}, "positions: got 'angel'"),
        ({"vectors": {"v": ("vx",)}}, "vectors: got 'vx'"),
        ({"heading": "yaw"}, "vectors: got 'yaw'"),
        ({"supply": {"battery": 12.0}}, "supply: got 'battery'"),
        ({"supply": {"force": 0.0}}, "wanted its usual size, above 0"),
    ],
)
def test_what_the_system_lacks_is_refused(more: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        named(JOINT, (FORCE,), **more)
