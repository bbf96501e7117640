"""Any planar robot drives by its sensors, as soundly as its body is declared; others refuse sensors."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.adaptation import AdaptationNode
from safedpa.bus import SurroundingsMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.scene import check_senses, scene_of
from safedpa.safety.barriers.planar_body import BodyPart, PlanarBody, SensedMovers, SensedPoints
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.systems.robots import robot_named
from safedpa_lab.experiments.sensing.planar import PlanarDrive, run_planar_drive
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.stand_in_robot import StandInRobot
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.people import StepsOut
from safedpa_sim.sensing.stand_in_sensors import StandInSensors

WHEELED, MODEL, SETTINGS = (
    robot_named("differential_drive"),
    load_model("differential_drive"),
    settings_named("differential_drive"),
)
STATES = ("x", "y", "yaw", "forward", "left")
RECTANGLE = BodyPart(((-0.3, -0.2), (0.3, -0.2), (0.3, 0.2), (-0.3, 0.2)))
BODIES = {
    "a disc": (BodyPart(((0.0, 0.0),), 0.2),),
    "a capsule": (BodyPart(((-0.2, 0.0), (0.4, 0.0)), 0.1),),
    "a rectangle": (RECTANGLE,),
    "two parts": (RECTANGLE, BodyPart(((0.3, 0.0), (0.6, 0.0)), 0.05)),
}


def body_of(parts: tuple[BodyPart, ...], **more: object) -> PlanarBody:
    return PlanarBody(1.0, 4.0, 1.0, STATES[:3], STATES[3:], parts=parts, clearance=0.0, **more)  # type: ignore[arg-type]


def swept_distance(parts: tuple[BodyPart, ...], at: tuple[float, float], way: tuple[float, float]) -> float:
    """The distance of a position in the body frame from the body at many places along it."""
    shares = np.linspace(0.0, 1.0, 401)
    return min(part.distance(at[0] - s * way[0], at[1] - s * way[1]) for part in parts for s in shares)


@pytest.mark.parametrize("parts", BODIES.values(), ids=BODIES.keys())
@settings(max_examples=40, deadline=None)
@given(
    yaw=st.floats(-pi, pi), forward=st.floats(-1.0, 1.0), left=st.floats(-1.0, 1.0), x=st.floats(-2.0, 2.0),
    y=st.floats(-2.0, 2.0),
)  # fmt: skip
def test_h_is_the_distance_from_the_body_on_its_way_to_a_stop(parts, yaw, forward, left, x, y) -> None:
    state = np.array([0.5, -0.3, yaw, forward, left])
    h = float(SensedPoints([[x, y, 0.0]], body_of(parts), parts, STATES).h(state)[0])
    speed = hypot(forward, left)
    length = speed / 4.0 if speed <= 0.25 else 0.0625 + (speed**2 - 0.0625) / 2.0
    way = (forward * length / max(speed, 1e-9), left * length / max(speed, 1e-9))
    apart = x - 0.5, y + 0.3
    at = (cos(yaw) * apart[0] + sin(yaw) * apart[1], cos(yaw) * apart[1] - sin(yaw) * apart[0])
    true = swept_distance(parts, at, way)
    assert h <= true + 1e-6
    if true > 0.01:
        assert h == pytest.approx(true, abs=2e-3)


@settings(max_examples=60, deadline=None)
@given(
    speed=st.floats(-0.6, 0.6), turn=st.floats(-3.0, 3.0), x=st.floats(-1.5, 1.5), y=st.floats(-1.5, 1.5),
    hidden=st.booleans(),
)  # fmt: skip
def test_no_h_of_a_differential_drive_falls_while_it_brakes_as_guaranteed(speed, turn, x, y, hidden) -> None:
    """Both wheels brake by exactly what is guaranteed, and the mover comes straight at the robot."""
    body = PlanarBody(
        0.7, 5.0, 0.65, turn_rate="turn_rate", track=0.233, parts=(BodyPart(((-0.1, 0.0), (0.3, 0.0)), 0.1),)
    )
    names, w, pace = MODEL.system.state_names, 1.5, 0.002
    state, place = np.array([0.0, 0.0, 0.3, speed, turn]), np.array([x, y])

    def h(state: np.ndarray, place: np.ndarray) -> float:
        return float(SensedMovers([[*place, 0.2, w]], [hidden], body, body.parts, names).h(state)[0])

    before = h(state, place)
    while abs(state[3]) + 0.117 * abs(state[4]) > 0.1:
        wheels = np.array([state[3] - 0.1165 * state[4], state[3] + 0.1165 * state[4]])
        wheels -= np.sign(wheels) * np.minimum(np.abs(wheels), pace * np.minimum(5.0 * np.abs(wheels), 0.7))
        state[:3] += pace * np.array([state[3] * cos(state[2]), state[3] * sin(state[2]), state[4]])
        state[3:] = wheels.mean(), (wheels[1] - wheels[0]) / 0.233
        towards = state[:2] - place
        place = place + pace * w * towards / max(float(np.hypot(*towards)), 1e-9)
        now = h(state, place)
        stands = abs(state[3]) + 0.117 * abs(state[4]) <= 0.1
        if not (hidden or stands):  # in the last step it stands for a part of it
            assert now >= before - 1e-3
        before = now


def sensed_robot(seed: int = 3, people=(), rate: float = 10.0, latency: float = 0.05) -> StandInRobot:
    def sensors(stand_in):
        laser = Laser(LaserSettings(mount=(0.0, 0.0, 0.0), rate=rate, latency=latency), seed)
        return StandInSensors((laser,), people)

    return StandInRobot(WHEELED, 0.05, seed, sensors=sensors)


def nodes():
    eyes, policy = PerceptionNode(), PolicyNode(MODEL, "goal_seeker")
    return [AdaptationNode(MODEL), eyes, policy, SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))]


def test_a_differential_drive_with_a_laser_is_filtered_and_gets_somewhere() -> None:
    robot = sensed_robot()
    statuses = [tick.verdict.status for tick in drive(robot, nodes(), 120)]
    assert statuses.count("fallback") <= 2  # before the first scan
    assert hypot(*robot.values[:2]) > 0.2
    assert not robot.collisions


def test_a_silent_laser_stops_a_differential_drive_and_the_verdict_names_it() -> None:
    robot = sensed_robot(latency=1.0)
    ticks = list(drive(robot, nodes(), 30))
    assert {tick.verdict.status for tick in ticks[2:]} == {"fallback"}
    assert "laser" in ticks[-1].verdict.sentence


@pytest.mark.long
def test_a_differential_drive_stands_before_someone_who_steps_into_its_way() -> None:
    for seed in range(3):
        robot = sensed_robot(seed)
        goal = robot.stand_in.goal
        x, y = 0.55 * goal[0], 0.55 * goal[1]
        robot = sensed_robot(seed, (StepsOut((x + 0.8, y), (x, y), 1.5, 0.9),))
        for _ in drive(robot, nodes(), 100):
            if any("person" in str(hit) for hit in robot.collisions):
                assert abs(robot.values[3]) < 0.1
                break


@pytest.mark.long
@pytest.mark.parametrize("robot", ["drone", "omni"])
def test_robots_of_ones_own_drive_by_a_laser(robot: str) -> None:
    found = run_planar_drive(PlanarDrive(robot, 11, 4.0, 1))
    assert found["statuses"].get("fallback", 0) <= 3
    assert found["way"] > 0.3
    assert not found["moving"]


@pytest.mark.long
@pytest.mark.parametrize("source", ["cloud", "depth", "grid"])
def test_other_sources_alone_are_enough_to_drive(source: str) -> None:
    found = run_planar_drive(PlanarDrive("omni", 11, 4.0, 0, source=source))
    assert found["statuses"].get("fallback", 0) <= 5
    assert found["way"] > 0.2
    assert not found["moving"]


@pytest.mark.long
def test_a_ring_of_range_sensors_is_no_defect_and_touches_nothing() -> None:
    found = run_planar_drive(PlanarDrive("omni", 7000, 3.0, 3, source="range"))
    assert found["statuses"]["fallback"] <= 5
    assert found["way"] > 0.2
    assert not found["moving"]


def test_a_robot_without_a_planar_body_refuses_sensors_by_name() -> None:
    model = load_model("pendulum")
    with pytest.raises(
        InputError, match="--laser: got sensors for the robot 'pendulum', but this robot's barriers take"
    ):
        check_senses(model, settings_named("pendulum"), "--laser")
    check_senses(MODEL, SETTINGS, "--laser")
    check_senses(load_model("car"), settings_named("car"), "--laser")


def surroundings(state, **more) -> SurroundingsMessage:
    known = {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}
    return SurroundingsMessage(**known, **{"points": (), "movers": (), "hidden": (), "ages": (0.0,), **more})


def test_near_discs_enter_a_decision_and_far_ones_do_not() -> None:
    scene, state = scene_of(MODEL, SETTINGS), sensed_robot().state_message()
    scene.learn(MODEL.latent)
    seen = surroundings(state, points=((0.28, 0.0, 0.05), (40.0, 0.0, 0.05)), movers=((0.55, 0.0, 0.2, 0.0, 0.0, 1.5),))
    barriers = scene.around(state, seen)
    assert not isinstance(barriers, str)
    assert {"point 0", "mover 0"} <= set(barriers.names)
    assert "point 1" not in barriers.names


@pytest.mark.parametrize(
    ("more", "names"),
    [
        ({"points": ((0.5, 0.0),)}, "points"),
        ({"movers": ((0.5, 0.0, float("nan"), 0.0, 0.0, 1.0),)}, "movers"),
        ({"hidden": ((0.5, 0.0, -1.0, 1.0),)}, "hidden"),
    ],
)
def test_hostile_surroundings_are_reported_instead_of_barriers(more, names) -> None:
    scene, state = scene_of(MODEL, SETTINGS), sensed_robot().state_message()
    found = scene.around(state, surroundings(state, **more))
    assert isinstance(found, str)
    assert names in found


def test_a_state_without_a_pose_is_refused_where_its_values_do_not_begin_with_one() -> None:
    body = PlanarBody(1.0, 4.0, 1.0, ("speed", "turn_rate"), (), parts=(RECTANGLE,))

    class Sideways(type(WHEELED)):  # type: ignore[misc]
        def planar_body(self, model, settings):
            return body

    from safedpa.runtime.scene import DeclaredScene

    scene, state = DeclaredScene(Sideways(), MODEL, SETTINGS), sensed_robot().state_message()
    assert "got no pose" in str(scene.around(state, surroundings(state)))
    assert not isinstance(scene.around(replace(state, pose=(0.0, 0.0, 0.0)), surroundings(state)), str)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"deceleration": 0.0}, "deceleration"),
        ({"largest_speed": float("nan")}, "largest_speed"),
        ({"pose": ("x",)}, "pose"),
        ({"pose": ("x", "y")}, "heading"),
        ({"turn_rate": "turn_rate"}, "turning"),
        ({"track": 0.2}, "track"),
        ({"velocity": ("a", "b", "c")}, "velocity"),
    ],
)
def test_an_impossible_body_is_refused_by_the_name_of_its_field(change, names) -> None:
    with pytest.raises(InputError, match=names):
        replace(PlanarBody(1.0, 4.0, 1.0), **change)


def test_a_body_that_names_an_unknown_state_is_refused() -> None:
    with pytest.raises(InputError, match="'forward'"):
        SensedPoints((), body_of((RECTANGLE,)), (RECTANGLE,), ("x", "y", "yaw"))
