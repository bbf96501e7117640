"""The simulated car obeys mechanics: friction limit, momentum, rest, mirror symmetry, drag of loads, stopping."""

from dataclasses import replace
from itertools import pairwise
from math import atan, cos, hypot, sin, sqrt, tan, tanh

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa_sim.ground_forces import GRAVITY, GroundForces
from safedpa_sim.robots import LOADS, CarWorld
from safedpa_sim.robots.car.actuators import SpeedServo, SteeringActuator
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS

OPEN_FIELD = (-500.0, 500.0, -500.0, 500.0)
LOAD_NAMES = ("none", *LOADS)
BRAKING = (2.8, 3.2)
"""m/s2 and 1/s: the braking that docs/reference/robot.md guarantees for the watchdog with every load."""

actions = st.lists(st.tuples(st.floats(-0.6, 2.0), st.floats(-0.34, 0.34)), min_size=1, max_size=60)


def axle_force(rolling: float, sideways: float, drive: float, limit: float, slip_scale: float, slip_speed: float):
    """Returns longitudinal and lateral force [N] on an axle, in the frame of its wheels.

    F_x = clip(drive, +-limit), F_y = -sqrt(limit^2 - F_x^2) s / sqrt(1 + s^2),
    s = sideways / (slip_scale (|rolling| + slip_speed)):
    a tyre of cornering stiffness limit / slip_scale that saturates on the friction circle of radius ``limit`` [N].
    ``rolling`` and ``sideways`` [m/s] are the velocity of the axle's middle along and across its wheels. Source: the
    combined-slip friction circle, Rajamani, Vehicle Dynamics and Control, 2nd ed., ch. 13, with a smooth saturation.
    """
    along = -limit if drive < -limit else limit if drive > limit else drive
    slip = sideways / (slip_scale * (abs(rolling) + slip_speed))
    return along, -sqrt(limit * limit - along * along) * slip / sqrt(1.0 + slip * slip)


def open_world(load: str = "none") -> CarWorld:
    return CarWorld((0.0, 0.0, 0.0), OPEN_FIELD, (), LOADS.get(load))


def driven(world: CarWorld, target_speed: float, steer: float, seconds: float) -> CarWorld:
    for _ in range(round(seconds / 0.05)):
        world.advance(target_speed, steer, 0.05)
    return world


def stopping_bound(speed: float, deceleration: float, gain: float) -> float:
    corner = deceleration / gain
    if speed <= corner:
        return speed / gain
    return corner / gain + (speed**2 - corner**2) / (2 * deceleration)


@settings(max_examples=40, deadline=None)
@given(actions)
def test_the_car_never_accelerates_beyond_tyre_friction(sequence):
    world = open_world()
    car = CAR_PARAMETERS
    # Air and rolling resistance add to the tyre forces.
    largest = car.friction * GRAVITY + car.rolling + car.drag * 2.1**2
    for target_speed, steer in sequence:
        vx, vy = world.body.velocity
        world.advance(target_speed, steer, 0.0025)
        wx, wy = world.body.velocity
        assert hypot(wx - vx, wy - vy) / 0.0025 <= largest * 1.001


def test_too_fast_a_turn_slides_at_the_friction_limit():
    world = open_world()
    world.body.velocity = (6.0, 0.0)
    world.advance(6.0, 0.34, 0.3)
    vx, vy = world.body.velocity
    world.advance(6.0, 0.34, 0.05)
    wx, wy = world.body.velocity
    acceleration = hypot(wx - vx, wy - vy) / 0.05
    assert 0.7 * GRAVITY < acceleration < 0.95 * GRAVITY
    assert abs(world.body.angular_velocity) < 6.0 * tan(0.34) / 0.32 * 0.6, "far below the yaw rate without slip"


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_a_stationary_car_stays_and_the_watchdog_stops_within_the_guaranteed_distance(load):
    world = driven(open_world(load), 0.0, 0.2, 10.0)
    x, y, yaw, speed = world.state
    assert max(abs(x), abs(y), abs(yaw), abs(speed)) < 1e-9
    # From every speed and steer, steady or accelerating, while the wheels straighten.
    for steer in (0.0, -0.34):
        for seconds in (0.05, 0.2, 0.4, 3.0):
            for target_speed in (0.3, 0.8, 1.4, 2.0, -0.6):
                world = driven(open_world(load), target_speed, steer, seconds)
                check_stops(world)


def test_a_circle_has_nearly_the_geometric_radius_and_understeer_grows_with_speed():
    world = driven(open_world(), 1.0, 0.34, 6.0)
    radius = world.state[3] / world.body.angular_velocity
    assert radius == pytest.approx(0.32 / tan(0.34), abs=0.03)
    radii = []
    for target_speed in (0.5, 1.0, 1.5, 2.0):
        world = driven(open_world(), target_speed, 0.34, 6.0)
        radii.append(world.state[3] / world.body.angular_velocity)
    assert radii == sorted(radii)
    assert radii[-1] < 1.1 * radii[0]


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_mirrored_actions_give_the_mirrored_path(load):
    left, right = open_world(load), open_world(load)
    for step in range(100):
        steer = 0.34 * sin(0.1 * step)
        left.advance(1.5, steer, 0.05)
        right.advance(1.5, -steer, 0.05)
    x, y, yaw, speed = left.state
    assert right.state == pytest.approx((x, -y, -yaw, speed), abs=2e-3)


def test_the_frame_of_the_field_does_not_matter():
    here, there = open_world(), CarWorld((3.0, -2.0, 1.0), OPEN_FIELD)
    for step in range(60):
        here.advance(1.5, 0.3 * sin(0.2 * step), 0.05)
        there.advance(1.5, 0.3 * sin(0.2 * step), 0.05)
    x, y, yaw, speed = here.state
    turned = (3.0 + x * cos(1) - y * sin(1), -2.0 + x * sin(1) + y * cos(1), yaw + 1.0, speed)
    assert there.state == pytest.approx(turned, abs=1e-6)


def test_without_tyres_and_floor_momentum_is_conserved(monkeypatch):
    slippery = replace(CAR_PARAMETERS, friction=0.0, rolling=0.0, drag=0.0)
    world = CarWorld((0.0, 0.0, 0.0), OPEN_FIELD, (), LOADS["chair"], slippery)
    towed = world.towed
    assert towed is not None
    monkeypatch.setattr(type(towed), "apply_runners", lambda _: None)
    for joint in tuple(towed.body.constraints):
        if joint.b is world.space.static_body:
            world.space.remove(joint)
    world.body.velocity, world.body.angular_velocity = (1.0, 0.3), 0.5
    before = world.body.mass * world.body.velocity + towed.body.mass * towed.body.velocity
    world.advance(2.0, 0.3, 1.0)
    after = world.body.mass * world.body.velocity + towed.body.mass * towed.body.velocity
    assert (after - before).length < 1e-9
    assert towed.hitch_error < 2e-3


def test_a_load_costs_speed_by_its_friction_and_a_heavier_one_acceleration():
    free = driven(open_world(), 1.5, 0.0, 6.0).state[3]
    for name, load in LOADS.items():
        world = driven(open_world(name), 1.5, 0.0, 6.0)
        expected = load.mass_ratio * load.deceleration / CAR_PARAMETERS.servo_gain
        assert free - world.state[3] == pytest.approx(expected, abs=0.02)
        assert world.state[3] > 1.0, "a useful speed"
    gained = [driven(open_world(name), 2.0, 0.0, 0.2).state[3] for name in LOAD_NAMES]
    assert gained == sorted(gained, reverse=True)
    assert gained[0] > 2 * gained[-1]


@pytest.mark.parametrize("name", list(LOADS))
def test_a_load_alone_slides_to_rest_at_its_deceleration(name):
    world = driven(open_world(name), 1.5, 0.0, 4.0)
    towed = world.towed
    assert towed is not None
    world.unhitch()
    before = towed.body.velocity.length
    world.advance(1.5, 0.0, 0.1)
    assert (before - towed.body.velocity.length) / 0.1 == pytest.approx(LOADS[name].deceleration, rel=0.05)
    driven(world, 1.5, 0.0, 3.0)
    assert towed.body.velocity.length < 1e-6
    assert world.state[3] == pytest.approx(driven(open_world(), 1.5, 0.0, 6.0).state[3], abs=0.01)


@pytest.mark.parametrize("name", list(LOADS))
def test_ground_friction_also_stops_a_spinning_load(name):
    world = open_world(name)
    towed = world.towed
    assert towed is not None
    world.unhitch()
    towed.body.angular_velocity = 3.0
    world.advance(0.0, 0.0, 2.0)
    assert abs(towed.body.angular_velocity) < 1e-6


def test_hitching_while_driving_slows_the_car_and_keeps_the_hitch_together():
    world = driven(open_world(), 1.5, 0.2, 4.0)
    fast = world.state[3]
    world.hitch(LOADS["chair"])
    driven(world, 1.5, 0.2, 4.0)
    assert world.towed is not None
    assert world.towed.hitch_error < 1e-3
    assert world.state[3] < fast - 0.15


@pytest.mark.parametrize("load", list(LOADS))
def test_the_watchdog_stops_a_load_that_was_hitched_at_full_speed(load):
    world = driven(open_world(), 2.0, 0.0, 5.0)
    world.hitch(LOADS[load])
    check_stops(world)


def check_stops(world: CarWorld) -> None:
    x, y, _, speed = world.state
    bound = stopping_bound(abs(speed), *BRAKING) + 1e-4
    distance = 0.0
    for _ in range(80):
        world.advance(0.0, 0.0, 0.025)
        there_x, there_y, _, now = world.state
        distance += hypot(there_x - x, there_y - y)
        x, y = there_x, there_y
    assert abs(now) < 0.005
    assert distance <= bound


def test_actuators_are_first_order_with_limits():
    steering = SteeringActuator(CAR_PARAMETERS)
    angles = [steering.advance(0.34, 0.0025) for _ in range(400)]
    steps = [later - earlier for earlier, later in pairwise(angles)]
    assert max(steps) <= 4.0 * 0.0025 + 1e-12
    assert angles == sorted(angles)
    assert angles[-1] == pytest.approx(0.34, abs=1e-4)
    small = SteeringActuator(CAR_PARAMETERS)
    for _ in range(32):
        small.advance(0.01, 0.0025)
    assert small.angle == pytest.approx(0.01 * (1 - 2.718281828**-1), rel=1e-6)
    servo = SpeedServo(CAR_PARAMETERS)
    assert max(servo.advance(2.0, 0.0, 0.0025) for _ in range(400)) <= 5.0


def test_the_kinematic_bicycle_is_near_but_not_the_truth():
    """At 1 m/s and gentle steer the path is that of a bicycle within a few per cent, never exactly."""
    world = driven(open_world(), 1.0, 0.0, 3.0)
    driven(world, 1.0, 0.2, 2.0)
    rate = world.body.angular_velocity
    kinematic = world.state[3] * tan(0.2) / 0.32
    assert rate == pytest.approx(kinematic, rel=0.04)
    assert abs(rate / kinematic - 1.0) > 1e-3
    slip = atan(world.body.velocity.y / world.body.velocity.x)
    assert slip != 0.0


@settings(max_examples=200, deadline=None)
@given(
    st.floats(-4, 4), st.floats(-2, 2), st.floats(-8, 8), st.floats(-6, 6),
    st.one_of(st.just(0.0), st.floats(-0.6, 0.6)),
)  # fmt: skip
def test_the_forces_on_the_ground_are_those_of_two_axles(forward, sideways, rate, drive, steer):
    car = CAR_PARAMETERS
    to_rear, to_front = car.centre_of_mass, car.wheelbase - car.centre_of_mass
    share = min(max((to_rear - drive * car.centre_height / GRAVITY) / car.wheelbase, 0.0), 1.0)
    force, limit = car.mass * drive, car.mass * GRAVITY * car.friction
    cosine, sine, ahead = cos(steer), sin(steer), sideways + rate * to_front
    rolling, across = forward * cosine + ahead * sine, ahead * cosine - forward * sine
    front = axle_force(rolling, across, force * share, limit * share, car.front_slip, car.slip_speed)
    rest, behind = 1.0 - share, sideways - rate * to_rear
    rear = axle_force(forward, behind, force * rest, limit * rest, car.rear_slip, car.slip_speed)
    resistance = car.mass * (car.rolling * tanh(forward / 0.02) + car.drag * abs(forward) * forward)
    push = front[0] * sine + front[1] * cosine
    wanted = (
        front[0] * cosine - front[1] * sine + rear[0] - resistance,
        push + rear[1],
        push * to_front - rear[1] * to_rear,
    )
    assert GroundForces(car).of(forward, sideways, rate, drive, steer) == wanted, "to the last bit"


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(LOAD_NAMES), actions, st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.floats(-0.1, 0.1))
def test_a_period_is_its_substeps_by_servo_steering_tyres_and_runners(load, sequence, wind, offset):
    quick, slow = open_world(load), open_world(load)
    for world in (quick, slow):
        world.wind, world.steering_offset = wind, offset
    for target_speed, steer in sequence[:12]:
        quick.advance(target_speed, steer, 0.05)
        for _ in range(20):
            substep(slow, target_speed, steer, 0.0025)
        assert quick.state == slow.state, "to the last bit"
        assert (quick.time, quick.drive.acceleration) == (slow.time, slow.drive.acceleration)
        assert quick.steering.angle == slow.steering.angle
        assert not quick.towed or quick.towed.pose == slow.towed.pose


def substep(world: CarWorld, target_speed: float, steer: float, seconds: float) -> None:
    """Computes one substep from its parts."""
    yaw, (vx, vy) = world.body.angle, world.body.velocity
    forward, sideways = vx * cos(yaw) + vy * sin(yaw), vy * cos(yaw) - vx * sin(yaw)
    drive = world.drive.advance(target_speed, forward, seconds)
    angle = world.steering.advance(steer + world.steering_offset, seconds)
    along, across, torque = GroundForces(CAR_PARAMETERS).of(
        forward, sideways, world.body.angular_velocity, drive, angle
    )
    mass, (east, north) = CAR_PARAMETERS.mass, world.wind
    world.body.force = (
        along * cos(yaw) - across * sin(yaw) + mass * east,
        along * sin(yaw) + across * cos(yaw) + mass * north,
    )
    world.body.torque = torque
    if world.towed:
        body, grip = world.towed.body, world.towed.body.mass * world.towed.load.grip
        cosine, sine, (vx, vy) = cos(body.angle), sin(body.angle), body.velocity
        forward, sideways = vx * cosine + vy * sine, vy * cosine - vx * sine
        _, across = axle_force(forward, sideways, 0.0, grip, 0.1, 0.3)
        body.force = (-across * sine, across * cosine)
    world.time += seconds
    world.contacts.time = world.time
    world.space.step(seconds)
