"""A subscriber that joins late gets what its publishers have stored, as ``/tf_static`` needs it."""

import threading
import time

import pytest
import zenoh
import zenoh.ext

from safedpa.bus import (
    NOMINAL,
    SCAN,
    STATE,
    Bus,
    MemoryBroker,
    MemoryTransport,
    Message,
    NominalMessage,
    ReceivedMessage,
    ScanMessage,
    StateMessage,
)
from safedpa.bus.transport import ports
from safedpa.bus.transport.zenoh import close_session, open_session, zenoh_session_configuration
from safedpa.ros.encoding import encode, hash_of, stamp_of
from safedpa.ros.graph import data_key
from safedpa.ros.link import RosLink
from safedpa.ros.outgoing import odometry_of, transform_of
from safedpa_services.ros_gateway.__main__ import make_gateway
from safedpa_services.ros_gateway.robot_file import parse_robot_file

TF = "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize("stored", [True, False])
def test_a_transform_that_was_published_before_is_received_if_its_sender_stores_it(stored: bool) -> None:
    endpoint = f"tcp/127.0.0.1:{ports.free_port()}"
    common = {"listen/endpoints": [endpoint], "scouting/multicast/enabled": False, "timestamping/enabled": True}
    robot = open_session(zenoh_session_configuration({"mode": "router", **common}))
    try:
        key, first, later = data_key(0, "/tf_static", TF, hash_of(TF)), encode(TF, {}), encode(TF, {"transforms": [{}]})
        if stored:
            cache = zenoh.ext.CacheConfig(max_samples=1)
            publisher = zenoh.ext.declare_advanced_publisher(robot, key, cache=cache, publisher_detection=True)
        else:
            publisher = robot.declare_publisher(key)
        publisher.put(first)
        heard: list[bytes] = []
        arrived = threading.Event()

        def take(data: bytes, _attachment: object) -> None:
            heard.append(data)
            arrived.set()

        with RosLink(endpoint) as link:
            link.hear("/tf_static", TF, take, late=True)
            assert arrived.wait(10.0 if stored else 0.5) is stored
            assert heard == [first] * stored
            arrived.clear()
            end = time.monotonic() + 20.0
            while not arrived.is_set() and time.monotonic() < end:
                publisher.put(later)
                arrived.wait(0.1)
            assert later in heard
    finally:
        close_session(robot)


ROBOT = """
    format = 2
    robot = "differential_drive"
    [wire]
    endpoint = "{endpoint}"
    [odometry]
    topic = "/odom"
    largest_age = 2.0
    [nominal]
    topic = "/cmd_vel_in"
    largest_age = 2.0
    [command]
    topic = "/cmd_vel"
    type = "geometry_msgs/msg/TwistStamped"
    hash = "TypeHashNotSupported"
    [surroundings]
    field = [-9.0, 9.0, -9.0, 9.0]
    footprint = [0.0, 0.0, 0.2]
    [[sources]]
    topic = "/sonar"
    type = "sensor_msgs/msg/Range"
    name = "sonar"
    [[zones]]
    name = "near"
    action = "slowdown"
    min_points = 1
    ratio = 0.5
    points = [[2.0, 1.0], [2.0, -1.0], [0.0, -1.0], [0.0, 1.0]]
    [monitor]
    state = "/collision_monitor_state"
"""


def test_a_gateway_on_the_wire_has_sources_with_mounts_from_tf_zones_and_a_twist_of_either_kind() -> None:
    endpoint = f"tcp/127.0.0.1:{ports.free_port()}"
    common = {"listen/endpoints": [endpoint], "scouting/multicast/enabled": False, "timestamping/enabled": True}
    router = open_session(zenoh_session_configuration({"mode": "router", **common}))
    broker = MemoryBroker()
    found: list[Message] = []
    try:
        with (
            RosLink(endpoint, node="/robot") as robot,
            Bus(MemoryTransport(broker), "fleet") as bus,
            Bus(MemoryTransport(broker), "fleet") as ear,
            make_gateway(parse_robot_file(ROBOT.format(endpoint=endpoint)), bus) as gateway,
        ):
            heard = ear.inbox((STATE, SCAN, NOMINAL), "r1", keep_all=True)
            odometry = robot.publisher("/odom", "nav_msgs/msg/Odometry")
            policy = robot.publisher("/cmd_vel_in", "geometry_msgs/msg/Twist")
            sonar, tf = robot.publisher("/sonar", "sensor_msgs/msg/Range"), robot.publisher("/tf_static", TF)
            end = time.monotonic() + 30.0

            def stopped() -> bool:
                now = time.time_ns()
                head = {"stamp": stamp_of(now), "frame_id": "odom"}
                odometry.put(odometry_of(head, "base_link", 0.0, 0.0, 0.0, 0.0, 0.0))
                policy.put({"linear": {"x": 0.4}})
                tf.put({"transforms": [transform_of({"frame_id": "base_link"}, "sonar", 0.2, 0.1, 0.0)]})
                cone = {"field_of_view": 0.3, "min_range": 0.1, "max_range": 4.0, "range": 1.0}
                sonar.put({"header": {"stamp": stamp_of(now), "frame_id": "sonar"}, **cone})
                found.extend(item.message for item in heard.take(0.0) if isinstance(item, ReceivedMessage))
                limited = [one for one in found if isinstance(one, NominalMessage) and one.values == (0.2, 0.0)]
                seen = any(isinstance(one, ScanMessage) for one in found)
                return (bool(limited) and seen) or time.monotonic() > end

            gateway.run(stopped)
    finally:
        close_session(router)
    assert any(isinstance(one, NominalMessage) and one.values == (0.2, 0.0) for one in found)
    scans = [one for one in found if isinstance(one, ScanMessage)]
    assert scans[0].mount == pytest.approx((0.2, 0.1, 0.0))
    assert set(scans[0].ranges) == {1.0}
    assert all(one.sources == ("sonar",) for one in found if isinstance(one, StateMessage))
