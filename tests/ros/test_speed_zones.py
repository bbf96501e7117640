"""Speed zones scale the nominal action as Nav2's collision monitor does, and never more than that."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from tests.ros.gateway_rig import ASKED, DRIVE, Link, Sense, rig_of

from safedpa.bus import NominalMessage, StateMessage, logging
from safedpa.errors import InputError
from safedpa.perception import Rays
from safedpa.ros.encoding import encode
from safedpa.ros.face import HolonomicFace
from safedpa.ros.sensor_messages import POLYGON, POLYGON_INSTANCE
from safedpa.ros.transforms import pose_matrix
from safedpa_services.command_line.group import safedpa
from safedpa_services.ros_gateway.robot_file import LocalisationTopic, NominalActionTopic, parse_robot_file
from safedpa_services.ros_gateway.sensor_inputs import NominalInput
from safedpa_services.ros_gateway.sensor_tables import SourceTopic, SpeedZone, VelocityPolygon
from safedpa_services.ros_gateway.simulated_clock import CLOCK, SimulatedClock
from safedpa_services.ros_gateway.sources import SourceReading
from safedpa_services.ros_gateway.speed_zones import (
    BOOL,
    FLOAT,
    SpeedZones,
    ToggleInput,
    ZonePolygon,
    ZoneRadius,
    scaled,
)

BOX = ((0.5, 0.4), (0.5, -0.4), (-0.2, -0.4), (-0.2, 0.4))
WIDE = ((1.0, 0.8), (1.0, -0.8), (-0.5, -0.8), (-0.5, 0.8))
POINT = np.array([[0.3, 0.0]])


def boxed(points: np.ndarray, corners: Any) -> int:
    (x0, x1), (y0, y1) = ((min(axis), max(axis)) for axis in zip(*corners, strict=True))
    return int(((points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)).sum())


def nav2(zones: tuple[SpeedZone, ...], velocity: tuple[float, float, float], points: np.ndarray) -> float:
    """The share that remains by Nav2's rules: of its zones in order, a slower velocity replaces the one before."""
    best = np.array(velocity)
    for zone in zones:
        if boxed(points, zone.points) < zone.min_points:
            continue
        speed, turn = math.hypot(*velocity[:2]), abs(velocity[2])
        share = {"stop": 0.0, "slowdown": zone.ratio}.get(zone.action, 1.0)
        if zone.action == "limit":
            share = min([1.0, *([zone.linear / speed] if speed else []), *([zone.angular / turn] if turn else [])])
        reduced = share * np.array(velocity)
        best = reduced if reduced @ reduced < best @ best else best
    whole = float(np.array(velocity) @ np.array(velocity))
    return math.sqrt(float(best @ best) / whole) if whole else 1.0


@settings(max_examples=200, deadline=None)
@given(some.data())
def test_zones_leave_the_share_of_the_velocity_that_nav2_leaves(data: some.DataObject) -> None:
    number = some.floats(-1.0, 1.0, allow_subnormal=False)
    velocity = data.draw(some.tuples(number, number, number))
    points = np.array(data.draw(some.lists(some.tuples(number, number), min_size=1, max_size=12)))
    zones = tuple(
        SpeedZone(
            f"z{index}", data.draw(some.sampled_from(["stop", "slowdown", "limit"])),
            data.draw(some.sampled_from([BOX, WIDE])), min_points=data.draw(some.integers(1, 6)),
            ratio=data.draw(some.floats(0.1, 1.0)), linear=data.draw(some.floats(0.1, 1.0)),
            angular=data.draw(some.floats(0.1, 1.0)),
        )
        for index in range(data.draw(some.integers(1, 4)))
    )  # fmt: skip
    share = SpeedZones(zones).limit(velocity, {"a": points[:5], "b": points[5:]}).share
    if math.hypot(*velocity) > 1e-6:
        assert share == pytest.approx(nav2(zones, velocity, points), abs=1e-6)
    assert 0.0 <= share <= 1.0


def test_a_zone_acts_and_stops_acting_after_its_counts_and_only_for_its_sources() -> None:
    zone = SpeedZone("near", "stop", BOX, min_points=1, sources=("a",), trigger_after=2, release_after=3)
    zones = SpeedZones((zone,))
    seen = [zones.limit((1.0, 0.0, 0.0), {"b": POINT, "a": POINT if hit else POINT + 9.0}).share
            for hit in (1, 1, 1, 0, 0, 0, 1)]  # fmt: skip
    assert seen == [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]


def test_the_polygon_of_the_velocity_counts_and_the_last_one_for_all_others() -> None:
    ahead, back = (BOX, (0.0, 1.0)), (tuple((-x, y) for x, y in BOX), (-1.0, 0.0))
    parts = tuple(VelocityPolygon(points, linear, (-1.0, 1.0)) for points, linear in (ahead, back))
    zones = SpeedZones((SpeedZone("v", "stop", velocity=parts, min_points=1),))
    assert [zones.limit((speed, 0.0, 0.0), {"a": POINT}).share for speed in (0.5, -0.5, 3.0)] == [0.0, 1.0, 1.0]
    side = VelocityPolygon(BOX, (0.1, 1.0), (-1.0, 1.0), (math.pi / 4, 3 * math.pi / 4))
    none = VelocityPolygon(((5.0, 5.0), (6.0, 5.0), (6.0, 6.0)), (0.0, 9.0), (-9.0, 9.0))
    zones = SpeedZones((SpeedZone("h", "stop", velocity=(side, none), min_points=1, holonomic=True),))
    assert [zones.limit(one, {"a": POINT}).share for one in ((0.0, 0.5, 0.0), (0.0, -0.5, 0.0))] == [0.0, 1.0]


def test_a_zone_from_a_topic_stops_the_robot_until_its_polygon_arrives() -> None:
    polygon = ZonePolygon(lambda _: pose_matrix(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    zones = SpeedZones((SpeedZone("t", "slowdown", topic="/p", min_points=1),), {"t": polygon})
    assert (zones.limit((1.0, 0.0, 0.0), {"a": POINT}).share, "no polygon" in zones.missing()) == (0.0, True)
    points = [{"x": x, "y": y} for x, y in BOX]
    polygon.take(encode(POLYGON, {"polygon": {"points": points}}))
    assert (zones.limit((1.0, 0.0, 0.0), {"a": POINT}).share, zones.missing()) == (0.5, "")
    polygon.take(encode(POLYGON, {"polygon": {"points": points[:2]}}))
    assert "wanted 3 to" in polygon.why


def test_a_zone_with_a_radius_from_a_topic_stops_the_robot_without_a_usable_one() -> None:
    radius = ZoneRadius()
    zones = SpeedZones((SpeedZone("t", "slowdown", radius_topic="/r", min_points=1),), {"t": radius})
    shares = []
    for sent in (None, 0.5, 0.2, math.nan, -1.0):
        if sent is not None:
            radius.take(encode(FLOAT, {"data": sent}))
        shares.append(zones.limit((1.0, 0.0, 0.0), {"a": POINT}).share)
    assert shares == [0.0, 0.5, 1.0, 0.0, 0.0]
    assert "wanted more than 0" in zones.missing()


def test_topics_switch_a_zone_and_all_zones() -> None:
    own, every = ToggleInput(True), ToggleInput(True)
    zones = SpeedZones((SpeedZone("near", "stop", BOX, min_points=1),), {}, {"near": own}, every)

    def share() -> float:
        return zones.limit((1.0, 0.0, 0.0), {"a": POINT}).share

    assert share() == 0.0
    for switch in (own, every):
        switch.take(encode(BOOL, {"data": False}))
        assert share() == 1.0
        switch.take(b"junk")
        assert share() == 1.0
        switch.take(encode(BOOL, {"data": True}))
        assert share() == 0.0


def test_steering_stays_as_it_is_and_velocities_are_scaled() -> None:
    assert scaled((1.0, 0.3), ("drive.speed", "drive.steering_angle"), 0.5) == (0.5, 0.3)
    assert scaled((1.0, 0.3), ("twist.linear.x", "twist.angular.z"), 0.5) == (0.5, 0.15)


class Sensor:
    refused, why = 0, ""

    def __init__(self, points: np.ndarray, age: float = 0.0) -> None:
        self.reading = SourceReading(100.0, Rays((0.0, 0.0, 0.0), 0.0, 0.1, (1.0, 2.0), 0.1, 9.0), points)
        self.age = age

    def take_all(self) -> list[SourceReading]:
        return []

    def newest(self) -> tuple[SourceReading, float]:
        return self.reading, self.age


@pytest.mark.parametrize(
    ("points", "age", "sent", "state"),
    [(POINT, 0.0, 0.25, (2, "near")), (POINT + 9.0, 0.0, 0.5, None), (POINT + 9.0, 0.6, 0.0, (1, "invalid source"))],
)
def test_the_gateway_scales_the_nominal_action_and_publishes_the_state_of_the_zones(points, age, sent, state):
    zones = (SpeedZone("near", "slowdown", BOX, min_points=1),)
    asked = replace(ASKED, sources=(SourceTopic("/scan", name="laser"),), zones=zones)
    inputs = {"sources": (Sensor(points, age),), "zones": SpeedZones(zones), "nominal": Sense((0.5, 0.1))}
    heard: list[Any] = []
    publisher: Any = type("Publisher", (), {"put": staticmethod(heard.append), "type": "x"})
    with rig_of(asked=asked, zone_state=publisher, **inputs) as rig:
        rig.turns(3)
        messages = rig.messages()
    assert {one.values for one in messages if isinstance(one, NominalMessage)} == {(sent, 0.1)}
    assert [(one["action_type"], one["polygon_name"]) for one in heard] == ([] if state is None else [state])
    assert {one.sources for one in messages if isinstance(one, StateMessage)} == {("laser",)}


def test_nominal_actions_of_another_type_that_the_robot_knows_are_used() -> None:
    twist = "geometry_msgs/msg/Twist"
    now = [100.0]
    types = {DRIVE: ("drive.speed", "drive.steering_angle"), twist: ("linear.x", "angular.z")}
    nominal = NominalInput(types, lambda: now[0])
    asked = replace(ASKED, nominal=NominalActionTopic("/drive_in", DRIVE))
    with rig_of(asked=asked, nominal=nominal, now=now) as rig:
        nominal.inputs[twist].take(encode(twist, {"linear": {"x": 0.6}}))
        rig.turns()
        (heard,) = [one for one in rig.messages() if isinstance(one, NominalMessage)]
    assert heard.values == (0.6, 0.0)
    nominal.inputs[DRIVE].take(encode(DRIVE, {}), None)
    assert nominal.type == DRIVE


def test_a_publisher_of_another_type_is_named_once_and_whether_it_is_used(capsys) -> None:
    others = (
        SimpleNamespace(node="/policy", topic="/drive_in", type="geometry_msgs/msg/Twist"),
        SimpleNamespace(node="/base", topic="/odom", type="geometry_msgs/msg/PoseStamped"),
        SimpleNamespace(node="/good", topic="/drive_in", type=DRIVE),
    )
    with rig_of(link=Link("rmw_zenoh", *others), nominal=Sense((0.5, 0.1))) as rig:
        rig.turns(80, lambda _: logging.EVENT_LOG.reset_rate_limits())
    notice = [line for line in capsys.readouterr().err.splitlines() if "other_type" in line]
    assert len(notice) == 2
    assert "/base publishes geometry_msgs/msg/PoseStamped on /odom" in notice[0]
    assert "it is not used" in notice[0]
    assert "/policy publishes geometry_msgs/msg/Twist on /drive_in" in notice[1]
    assert "it is used" in notice[1]


def test_a_reason_with_a_growing_age_is_logged_once(capsys) -> None:
    localised = Sense((0.0, 0.0, 0.0), 3.0)
    with rig_of(localised=localised, asked=replace(ASKED, localisation=LocalisationTopic("/tf"))) as rig:
        rig.turns(60, lambda turn: setattr(localised, "age", 3.0 + turn))
    assert sum("robot.brakes" in line for line in capsys.readouterr().err.splitlines()) == 1


def clock_of(seconds: float) -> bytes:
    return encode(CLOCK, {"clock": {"sec": int(seconds), "nanosec": round(1e9 * (seconds % 1.0))}})


def test_simulated_time_advances_with_its_messages_stops_with_a_reason_and_restarts() -> None:
    now = [50.0]
    clock = SimulatedClock(0.5, lambda: now[0])
    assert clock.why
    clock.take(clock_of(1000.0))
    for step in range(10):
        now[0] += 0.1
        clock.take(clock_of(1000.0 + 0.01 * (step + 1)))
    assert (clock(), clock.why) == (pytest.approx(0.1, abs=1e-6), "")
    assert clock.nanoseconds == pytest.approx(1000.1 * 1e9, abs=10)
    now[0] += 2.5
    assert clock() == pytest.approx(2.1), "the gateway must not wait for a paused simulation"
    assert "stopped" in clock.why
    clock.take(clock_of(1000.2))
    before = clock()
    for jump in (3.0, 5000.0):
        clock.take(clock_of(jump))
    assert (clock.restarts, clock()) == (2, pytest.approx(before))
    clock.take(b"")
    assert clock.refused == 1


def test_the_gateway_brakes_while_simulated_time_is_stopped_and_begins_again_after_a_reset() -> None:
    now = [100.0]
    clock = SimulatedClock(0.5, lambda: now[0])
    with rig_of(simulated=clock) as rig:
        rig.act(0.5, 0.1)
        assert rig.turns() == [(0.0, 0.0)]
        assert rig.gateway.why == "no simulated time has arrived yet"
        clock.take(clock_of(7.0))
        assert rig.turns() == [(0.5, 0.1)]
        epoch = rig.gateway.epoch
        clock.take(clock_of(1.0))
        rig.turns()
        assert rig.gateway.epoch != epoch


def test_a_holonomic_robot_is_read_and_commanded_to_its_side() -> None:
    face = HolonomicFace()
    state = face.state_moving_aside(1.0, 2.0, 0.3, 0.4, -0.2, 0.1)
    assert (face.planar(state), face.aside(state)) == ((1.0, 2.0, 0.3, 0.4, 0.1), -0.2)
    stamped = face.message("geometry_msgs/msg/TwistStamped", (0.4, -0.2, 0.1), state)
    assert stamped["twist"]["linear"] == {"x": 0.4, "y": -0.2}
    with pytest.raises(InputError, match="wanted one of"):
        face.paths(DRIVE)


MONITOR = """
/**:
  collision_monitor:
    ros__parameters:
      base_frame_id: base_link
      cmd_vel_in_topic: cmd_vel_raw
      enable_stamped_cmd_vel: true
      use_sim_time: true
      state_topic: state
      source_timeout: 0.4
      polygons: [Stop, Slow, Foot, Fast]
      Stop: {type: polygon, action_type: stop, points: "[[0.3, 0.3], [0.3, -0.3], [0.0, -0.3]]", max_points: 5}
      Slow: {type: circle, action_type: slowdown, radius: 0.8, slowdown_ratio: 0.4, sources_names: [cloud]}
      Foot: {type: polygon, action_type: approach, points: [0.2, 0.1, 0.2, -0.1, -0.2, -0.1, -0.2, 0.1]}
      Fast:
        type: velocity_polygon
        action_type: limit
        velocity_polygons: [on]
        "on": {points: [[1, 1], [1, -1], [0, 0]], linear_min: 0.0, linear_max: 1.0, theta_min: -1.0, theta_max: 1.0}
      observation_sources: [scan, cloud, cost, tracks]
      tracks: {type: polygon, topic: tracks, sampling_distance: 0.2}
      scan: {type: scan, topic: /scan}
      cloud: {type: pointcloud, topic: points, min_height: 0.1, exclusion_zones: [arm, off], source_timeout: 5.0}
      cost: {type: costmap, topic: costmap_raw, cost_threshold: 253, treat_unknown_as_obstacle: false}
      arm: {enabled: true, type: circle, radius: 0.2, frame_id: arm_link}
      "off": {enabled: false, type: circle, radius: 0.2}
"""


def converted(folder: Path, text: str) -> Any:
    (folder / "monitor.yaml").write_text(text, encoding="utf-8")
    out = folder / "robot.toml"
    assert safedpa.run(["ros", "from-collision-monitor", str(folder / "monitor.yaml"), "--out", str(out)]) == 0
    return parse_robot_file(out.read_text(encoding="utf-8"))


def test_parameters_of_nav2_become_a_robot_file_and_differences_are_listed(tmp_path, capsys) -> None:
    found = converted(tmp_path, MONITOR)
    notice = capsys.readouterr().out
    assert (found.nominal.topic, found.command.type) == ("/cmd_vel_raw", "geometry_msgs/msg/TwistStamped")
    assert [(zone.name, zone.action, zone.min_points) for zone in found.zones] == [
        ("Stop", "stop", 6), ("Slow", "slowdown", 4), ("Fast", "limit", 4),
    ]  # fmt: skip
    assert (found.zones[1].radius, found.zones[1].sources) == (0.8, ("cloud",))
    scan, cloud, cost, tracks = found.sources
    assert (scan.time_out, cloud.time_out, cloud.height, cloud.exclusions) == (0.4, 1.0, (0.1, 0.5), ("arm", "off"))
    assert [one.enabled for one in found.exclusions] == [True, False]
    assert (tracks.type, tracks.sampling) == (POLYGON_INSTANCE, 0.2)
    assert (cost.occupied, found.clock.topic, found.monitor.state) == (99, "/clock", "/state")
    assert found.surroundings.footprint[2] >= 0.1
    for part in ("'approach' is replaced", "source_timeout 5 s becomes 1 s", "tracks: for the filter, what is behind"):
        assert part in notice


def test_radii_from_topics_are_zones_and_no_footprints(tmp_path, capsys) -> None:
    text = MONITOR.replace("radius: 0.8,", "polygon_sub_topic: radius,")
    text = text.replace("Foot: {type: polygon, action_type: approach,", "Foot: {type: circle, action_type: approach,")
    found = converted(tmp_path, text)
    assert found.zones[1].radius_topic == "/radius"
    notice = capsys.readouterr().out
    assert "Foot: its radius comes from a topic" in notice
    assert "the disc of 0.25 m is a placeholder" in notice


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("action_type: stop", "action_type: halt", "Stop.action_type"), ("radius: 0.8,", "", "Slow: got no radius"),
        ("[0.3, -0.3]", "[0.3, x]", "Stop.points"), ("type: scan,", "type: sonar,", "scan.type"),
        ("polygons: [Stop", "polygons: [Missing", "Missing: got no parameters"),
        ("slowdown_ratio: 0.4", "slowdown_ratio: .nan", "number"),
        ("observation_sources:", "sources:", "no node with"), ("max_points: 5", "max_points: true", "max_points"),
        ("theta_max: 1.0", "theta_max: -2.0", "angular"), ("{type: scan,", "{type: [scan,", "not valid YAML"),
        ("slowdown_ratio: 0.4", "slowdown_ratio: 4", "ratio"), ("use_sim_time: true", "<<: {a: 1}", "merge key"),
    ],
)  # fmt: skip
def test_parameters_that_contradict_themselves_cost_one_line(before, after, message, tmp_path, capsys):
    assert before in MONITOR
    (tmp_path / "m.yaml").write_text(MONITOR.replace(before, after), encoding="utf-8")
    assert safedpa.run(["ros", "from-collision-monitor", str(tmp_path / "m.yaml")]) == 2
    notice = capsys.readouterr().err.strip()
    assert message in notice
    assert "\n" not in notice


def test_the_conversion_is_printed_as_json_and_replaces_no_file(tmp_path, capsys) -> None:
    (tmp_path / "m.yaml").write_text(MONITOR, encoding="utf-8")
    assert safedpa.run(["ros", "from-collision-monitor", str(tmp_path / "m.yaml"), "--json"]) == 0
    assert parse_robot_file(json.loads(capsys.readouterr().out)["robot_file"]).name == "r1"
    assert (
        safedpa.run(["ros", "from-collision-monitor", str(tmp_path / "m.yaml"), "--out", str(tmp_path / "m.yaml")]) == 2
    )
    assert "exists already" in capsys.readouterr().err
