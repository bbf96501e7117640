import math

import pytest
from tests.safety.dual_numbers import DUALS, Dual, dual

from safedpa.errors import InputError
from safedpa.safety.braking import Braking, stopping_distance


def slope(deceleration: float, gain: float, speed: float) -> float:
    return dual(stopping_distance(Dual(speed, 1.0), deceleration, gain, DUALS)).slope


@pytest.mark.parametrize(("deceleration", "gain"), [(2.0, 2.5), (0.5, 4.0), (9.0, 1.0)])
@pytest.mark.parametrize("speed", [-20.0, -1.0, -0.2, 0.0, 0.3, 0.8, 1.0, 2.0, 15.0])
def test_distance_is_what_the_brake_takes(deceleration: float, gain: float, speed: float) -> None:
    """Integrates d|v|/dt = -min(k |v|, b) in small steps: an independent road to D."""
    left, travelled, dt = abs(speed), 0.0, 1e-4
    while left > 1e-7:
        middle = left - 0.5 * dt * min(gain * left, deceleration)
        travelled += dt * middle
        left -= dt * min(gain * middle, deceleration)
    assert Braking(deceleration, gain).distance(speed) == pytest.approx(math.copysign(travelled, speed), abs=1e-6)


@pytest.mark.parametrize("speed", [-3.0, -0.8, -0.5, 0.0, 0.1, 0.79, 0.8, 0.81, 2.0])
def test_slope_is_the_larger_of_both_and_continuous(speed: float) -> None:
    braking, step = Braking(2.0, 2.5), 1e-6
    difference = (braking.distance(speed + step) - braking.distance(speed - step)) / (2 * step)
    assert slope(2.0, 2.5, speed) == pytest.approx(difference, abs=1e-6)
    assert slope(2.0, 2.5, speed) == pytest.approx(max(1.0 / 2.5, abs(speed) / 2.0), abs=1e-15)


def test_corner_of_the_servo() -> None:
    braking = Braking(2.0, 2.5)
    assert braking.distance(0.8) == pytest.approx(0.32)
    assert braking.distance(2.0) == pytest.approx(0.32 + (4.0 - 0.64) / 4.0)
    assert slope(2.0, 2.5, 2.0) == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_refuses_what_is_no_braking_ability(bad: float) -> None:
    with pytest.raises(InputError, match=r"braking deceleration: got .*, wanted a positive finite"):
        Braking(bad, 1.0)
    with pytest.raises(InputError, match=r"braking gain: got"):
        Braking(1.0, bad)


def test_accepts_small_and_large_abilities() -> None:
    assert Braking(0.5, 0.5).distance(0.1) == pytest.approx(0.2)
    assert slope(1e-3, 30.0, 1.0) == pytest.approx(1000.0)
