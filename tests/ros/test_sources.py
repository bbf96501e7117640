"""Sources of the gateway: clouds, depth images, ranges and grids become rays; mounts come from tf or the file."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.ros.decoding import DecodingError
from safedpa.ros.encoding import decode, encode, type_store
from safedpa.ros.outgoing import odometry_of
from safedpa.ros.sensor_messages import (
    CAMERA_INFO,
    CLOUD,
    COSTMAP,
    DEPTH_IMAGE,
    GRID,
    POLYGON,
    POLYGON_INSTANCE,
    RANGE,
    cone_of,
    corners_of,
    covering_capsule,
    depth_of,
    grid_of,
    points_of,
)
from safedpa.ros.transforms import TransformTree, pose_matrix, roll_pitch_yaw
from safedpa_services.command_line.group import safedpa
from safedpa_services.ros_gateway.bag_sources import read_sources
from safedpa_services.ros_gateway.robot_file import parse_robot_file
from safedpa_services.ros_gateway.sensor_inputs import TRANSFORMS, FootprintInput, LatestMessage, pose_paths
from safedpa_services.ros_gateway.sensor_tables import LASER, ExclusionArea, FrameTopics, SourceTopic
from safedpa_services.ros_gateway.sources import BodyFrames, SourceReader, SourceReading, SourceReceiver
from safedpa_services.ros_gateway.speed_zones import ToggleInput

NAN, INF = math.nan, math.inf
FLOATS = [{"name": axis, "offset": 4 * index, "datatype": 7, "count": 1} for index, axis in enumerate("xyz")]


def head(frame: str = "sensor", stamp: int = 1) -> dict[str, Any]:
    return {"stamp": {"sec": 1, "nanosec": stamp}, "frame_id": frame}


def cloud_of(points: Any, stamp: int = 1, frame: str = "sensor", **changes: Any) -> bytes:
    table = np.asarray(points, dtype="<f4").reshape(-1, 3)
    fields = {
        "header": head(frame, stamp), "height": 1, "width": len(table), "fields": FLOATS, "is_bigendian": False,
        "point_step": 12, "row_step": 12 * len(table), "data": list(table.tobytes()), "is_dense": True,
    }  # fmt: skip
    return encode(CLOUD, {**fields, **changes})


def image_of(depth: np.ndarray, kind: str = "32FC1", stamp: int = 1, **changes: Any) -> bytes:
    raw = depth.astype("<f4") if kind == "32FC1" else np.round(1000.0 * np.nan_to_num(depth)).astype("<u2")
    rows, columns = depth.shape
    fields = {
        "header": head("camera", stamp), "height": rows, "width": columns, "encoding": kind, "is_bigendian": 0,
        "step": raw.itemsize * columns, "data": list(raw.tobytes()),
    }  # fmt: skip
    return encode(DEPTH_IMAGE, {**fields, **changes})


def info_of(rows: int, columns: int, focal: float = 60.0) -> bytes:
    k = [focal, 0.0, (columns - 1) / 2, 0.0, focal, (rows - 1) / 2, 0.0, 0.0, 1.0]
    return encode(CAMERA_INFO, {"header": head("camera"), "height": rows, "width": columns, "k": k})


def range_of(distance: float, nearest: float = 0.1, farthest: float = 4.0, view: float = 0.3, stamp: int = 1) -> bytes:
    limits = {"min_range": nearest, "max_range": farthest, "field_of_view": view}
    return encode(RANGE, {"header": head("sonar", stamp), **limits, "range": distance})


def grid_message(cells: np.ndarray, frame: str = "odom", stamp: int = 1, resolution: float = 0.1, **origin: float):
    info = {"resolution": resolution, "width": cells.shape[1], "height": cells.shape[0]}
    pose = {"position": origin, "orientation": {"w": 1.0}}
    data = cells.astype(np.int8).ravel().tolist()
    return encode(GRID, {"header": head(frame, stamp), "info": {**info, "origin": pose}, "data": data})


def receiver(pose: Any = None, areas: Any = (), frames: BodyFrames | None = None, **keys: Any) -> SourceReceiver:
    topic = SourceTopic(topic="/x", **{"mount": (0.2, 0.0, 0.1, 0.0, 0.0, 0.0), **keys})
    frames = frames or BodyFrames(FrameTopics(), 0.0, lambda frame: pose if frame == "odom" else None, lambda: 5.0)
    return SourceReceiver(SourceReader(topic, areas, frames), lambda: 5.0)


def only(source: SourceReceiver) -> SourceReading:
    (found,) = source.take_all()
    return found


def ends(reading: SourceReading) -> np.ndarray:
    """Returns (rays, 2) [m] in the body frame."""
    seen = reading.rays
    ranges = np.array(seen.ranges)
    angles = seen.mount[2] + seen.first_angle + seen.angle_step * np.arange(len(ranges))
    hit = (ranges >= seen.nearest) & (ranges < seen.farthest)
    along = np.column_stack([np.cos(angles), np.sin(angles)]) * ranges[:, None]
    return (along + np.array(seen.mount[:2]))[hit]


@settings(max_examples=60, deadline=None)
@given(some.lists(some.tuples(*[some.floats(-5.0, 5.0, width=32)] * 3), min_size=1, max_size=40))
def test_points_of_a_cloud_are_read_as_they_were_written(points: list[tuple[float, float, float]]) -> None:
    wide = [{"name": axis, "offset": 4 + 8 * index, "datatype": 8, "count": 1} for index, axis in enumerate("zyx")]
    table = np.array([(0.0, *reversed(point)) for point in points])
    packed = np.zeros(
        len(points), dtype=np.dtype({"names": ["v"], "formats": ["(3,)>f8"], "offsets": [4], "itemsize": 32})
    )
    packed["v"] = table[:, 1:]
    changes = {"fields": wide, "point_step": 32, "row_step": 32 * len(points), "is_bigendian": True}
    for data in (cloud_of(points), cloud_of(points, **changes, data=list(packed.tobytes()))):
        assert points_of(decode(CLOUD, data)).tolist() == pytest.approx(np.array(points))


@pytest.mark.parametrize(
    "changes",
    [
        {"point_step": 0}, {"point_step": 8}, {"row_step": 4}, {"width": 4_000_000_000}, {"height": 4_000_000_000},
        {"data": [1, 2, 3]}, {"fields": FLOATS[:2]}, {"fields": [{**one, "datatype": 3} for one in FLOATS]},
        {"fields": [{**one, "offset": 4_000_000_000} for one in FLOATS]},
    ],
)  # fmt: skip
def test_a_cloud_that_contradicts_itself_is_refused_with_a_reason(changes: dict[str, Any]) -> None:
    source = receiver(type=CLOUD)
    source.take(cloud_of([[1.0, 0.0, 0.3]] * 3, **changes))
    assert source.take_all() == []
    assert (source.refused, bool(source.why)) == (1, True)


def test_a_cloud_is_cut_to_its_height_band_and_ground_shows_free_space() -> None:
    source = receiver(type=CLOUD, height=(0.1, 1.0))
    source.take(cloud_of([[2.0, 0.0, 0.5], [1.0, 1.0, 1.5], [3.0, 0.5, -0.1], [NAN, 0.0, 0.5], [0.0, INF, 0.5]]))
    reading = only(source)
    assert ends(reading) == pytest.approx(np.array([[2.2, 0.0]]), abs=0.02)
    assert reading.points == pytest.approx(np.array([[2.2, 0.0]]))
    assert max(reading.rays.free) == pytest.approx(math.hypot(3.0, 0.5))


@pytest.mark.parametrize("kind", ["32FC1", "16UC1"])
def test_a_wall_in_a_depth_image_is_where_it_is(kind: str) -> None:
    depth = np.full((60, 80), 2.0)
    depth[:, :5] = NAN
    source = receiver(type=DEPTH_IMAGE, info="/info", mount=(0.1, 0.0, 0.3, 0.0, 0.0, math.pi / 2), height=(0.1, 0.6))
    source.take(image_of(depth, kind))
    assert "CameraInfo" in source.why
    source.take_info(info_of(60, 80))
    source.take(image_of(depth, kind, stamp=2))
    found = ends(only(source))
    assert found[:, 1] == pytest.approx(np.full(len(found), 2.0), abs=0.06)
    assert np.ptp(found[:, 0]) > 2.0
    source = receiver(type=DEPTH_IMAGE, info="/info")
    source.take_info(info_of(60, 80))
    source.take(image_of(depth[:30], kind, stamp=3))
    assert source.why.startswith("it has 30 x 80 pixels, its CameraInfo 60 x 80")


@pytest.mark.parametrize("changes", [{"encoding": "rgb8"}, {"step": 0}, {"step": 4_000_000_000}, {"height": 10**9}])
def test_an_image_that_is_no_depth_or_has_wrong_sizes_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(DecodingError, match="wanted"):
        depth_of(decode(DEPTH_IMAGE, image_of(np.ones((4, 5)), **changes)))


@pytest.mark.parametrize(
    ("message", "distance"),
    [
        (range_of(1.5), 1.5), (range_of(INF), INF), (range_of(9.0), INF), (range_of(-INF), 0.1), (range_of(0.01), 0.1),
        (range_of(-INF, 0.5, 0.5), 0.5), (range_of(INF, 0.5, 0.5), INF),
    ],
)  # fmt: skip
def test_a_range_is_as_the_sensor_means_it(message: bytes, distance: float) -> None:
    assert cone_of(decode(RANGE, message)).distance == pytest.approx(distance)


def test_all_of_the_arc_of_a_range_is_occupied_and_nan_is_no_measurement() -> None:
    source = receiver(type=RANGE, mount=(0.2, 0.0, math.pi / 2))
    source.take(range_of(1.0))
    reading = only(source)
    assert np.hypot(*(ends(reading) - (0.2, 0.0)).T) == pytest.approx(np.ones(9))
    assert len(reading.points) == 19
    source.take(range_of(NAN, stamp=2))
    assert set(only(source).rays.ranges) == {-1.0}
    for bad in (range_of(1.0, 3.0, 1.0), range_of(1.0, view=0.0), range_of(1.0, view=NAN), range_of(1.0, farthest=INF)):
        with pytest.raises(DecodingError):
            cone_of(decode(RANGE, bad))


def test_a_costmap_in_the_frame_of_the_odometry_is_seen_from_the_robot() -> None:
    cells = np.zeros((60, 60), dtype=int)
    cells[40, 30] = 100  # at x 3.05, y 4.05 from the corner
    cells[:, 55:] = -1
    source = receiver(pose=(0.0, 0.0, math.pi / 2), type=GRID, mount=())
    source.take(grid_message(cells, x=-3.0, y=-3.0))
    reading = only(source)
    assert reading.points == pytest.approx(np.array([[1.05, -0.05]]))
    assert ends(reading).mean(axis=0) == pytest.approx([1.05, -0.05], abs=0.08)
    assert 2.3 < reading.rays.free[180] < 2.8, "at the robot's right the grid is known for 2.5 m"
    unknown = receiver(pose=(0.0, 0.0, 0.0), type=GRID, mount=(), unknown_is_occupied=True)
    unknown.take(grid_message(cells, x=-3.0, y=-3.0))
    assert len(only(unknown).points) > 100


def test_a_grid_in_a_frame_that_is_not_known_is_refused_and_so_are_wrong_sizes() -> None:
    source = receiver(type=GRID, mount=())
    source.take(grid_message(np.zeros((5, 5), dtype=int), frame="map"))
    assert source.why == "there is no transform from 'map' to 'base_link' yet"
    good = {"info": {"resolution": 0.05, "width": 5, "height": 5}, "data": [0] * 25}
    for change in ({"data": [0] * 24}, {"info": {**good["info"], "resolution": 0.0}}, {"info": {"width": 10**9}}):
        with pytest.raises(DecodingError):
            grid_of(decode(GRID, encode(GRID, {**good, **change})))


def test_costs_of_nav2_become_those_of_an_occupancy_grid() -> None:
    about = {"resolution": 0.05, "size_x": 5, "size_y": 1}
    message = {"header": head(), "metadata": about, "data": [0, 252, 253, 254, 255]}
    assert grid_of(decode(COSTMAP, encode(COSTMAP, message))).cells.tolist() == [[0, 98, 99, 100, -1]]


def tf_of(parent: str, child: str, x: float, y: float = 0.0, yaw: float = 0.0, **turn: float) -> bytes:
    rotation = turn or {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    pose = {"translation": {"x": x, "y": y}, "rotation": rotation}
    return encode(TRANSFORMS, {"transforms": [{"header": head(parent), "child_frame_id": child, "transform": pose}]})


def test_a_mount_comes_from_a_chain_of_transforms_that_may_arrive_late_and_grow_old() -> None:
    now = [5.0]
    frames = BodyFrames(FrameTopics(largest_age=0.5), 0.1, lambda _: None, lambda: now[0])
    topic = SourceTopic("/scan", mount=())
    source = SourceReceiver(SourceReader(topic, (), frames), lambda: now[0])
    scan = {"angle_min": -0.5, "angle_increment": 0.5, "range_min": 0.1, "range_max": 9.0, "ranges": [1.0] * 3}

    def send(stamp: int) -> list[SourceReading]:
        source.take(encode(LASER, {"header": head("laser", stamp), **scan}))
        return source.take_all()

    frames.take_fixed(tf_of("/mast", "laser", 0.2, yaw=math.pi / 2))
    assert send(1) == []
    assert source.why == "there is no transform from 'laser' to 'base_link' yet"
    frames.take_moving(tf_of("base_link", "mast", 0.0, 0.3))
    assert send(2)[0].rays.mount == pytest.approx((0.3, 0.3, math.pi / 2))
    now[0] += 0.6
    assert send(3) == []
    assert "0.60 s old" in source.why
    frames.take_moving(tf_of("base_link", "mast", NAN, 0.3))
    frames.take_moving(b"junk")
    frames.take_moving(tf_of("mast", "base_link", 1.0))  # a loop
    assert send(4) == []
    assert (frames.refused, frames.tree.refused) == (1, 1)


def test_a_laser_that_is_upside_down_turns_clockwise_and_a_tilted_one_is_cut_to_the_band() -> None:
    scan = {"angle_min": 0.0, "angle_increment": 0.25, "range_min": 0.1, "range_max": 9.0, "ranges": [1.0, 2.0, 3.0]}
    for mount, y in (((0.0, 0.0, 0.2, 0.0, 0.0, 0.0), 0.49), ((0.0, 0.0, 0.2, math.pi, 0.0, 0.0), -0.49)):
        source = receiver(mount=mount)
        source.take(encode(LASER, {"header": head(), **scan}))
        assert ends(only(source))[1] == pytest.approx([2.0 * math.cos(0.25), y], abs=0.01)
    tilted = receiver(mount=(0.0, 0.0, 0.5, 0.0, 0.2, 0.0), height=(0.2, 1.0))
    tilted.take(encode(LASER, {"header": head(), **scan}))
    assert len(only(tilted).points) == 1, "the rays of 2 and 3 m end below the band"


def test_an_exclusion_hides_its_points_and_what_is_behind_them_stays_unknown() -> None:
    area = ExclusionArea("arm", points=((0.5, 0.2), (0.5, -0.2), (0.9, -0.2), (0.9, 0.2)), height=(0.0, 0.4))
    source = receiver(areas=(area,), type=CLOUD, exclusions=("arm",), mount=(0.0, 0.0, 0.0))
    source.take(cloud_of([[0.7, 0.0, 0.3], [0.7, 0.01, 0.45], [0.0, 2.0, 0.3], [2.0, 0.002, 0.3]]))
    reading = only(source)
    assert sorted(reading.points.round(2).tolist()) == [[0.0, 2.0], [0.7, 0.01], [2.0, 0.0]]
    angles = reading.rays.first_angle + reading.rays.angle_step * np.arange(360)
    assert reading.rays.ranges[int(np.abs(angles - 0.001).argmin())] == -1.0
    other = receiver(areas=(area,), type=CLOUD, mount=(0.0, 0.0, 0.0))
    other.take(cloud_of([[0.7, 0.0, 0.3]]))
    assert len(only(other).points) == 1, "the area is that of the source that names it"


SQUARE = ((1.0, -0.2), (1.4, -0.2), (1.4, 0.2), (1.0, 0.2))


def polygon_of(corners: Any, number: int | None = 1, stamp: int = 1, frame: str = "odom") -> bytes:
    polygon = {"points": [{"x": float(x), "y": float(y)} for x, y in corners]}
    if number is None:
        return encode(POLYGON, {"header": head(frame, stamp), "polygon": polygon})
    return encode(POLYGON_INSTANCE, {"header": head(frame, stamp), "polygon": {"polygon": polygon, "id": number}})


def polygons(now: list[float], pose: list[float], **keys: Any) -> SourceReceiver:
    topic = SourceTopic(topic="/x", type=POLYGON_INSTANCE, time_out=0.5, **keys)
    frames = BodyFrames(FrameTopics(), 0.0, lambda frame: tuple(pose) if frame == "odom" else None, lambda: now[0])
    return SourceReceiver(SourceReader(topic, (ExclusionArea("here", radius=1.1),), frames), lambda: now[0])


def test_polygons_of_one_moment_all_count_and_each_until_its_time_out() -> None:
    now, pose = [5.0], [0.0, 0.0, 0.0]
    source = polygons(now, pose)
    source.take(polygon_of(SQUARE, 1))
    source.take(polygon_of([(y, x) for x, y in SQUARE], 2))
    _, both = source.take_all()
    assert ends(both).max(axis=0) == pytest.approx([1.0, 1.0], abs=0.02)
    assert 32 <= len(both.points) <= 40
    assert not both.rays.free, "a polygon does not say what is free"
    source.take(polygon_of(SQUARE, 2))
    assert source.take_all() == [], "the same number and stamp are no newer data"
    now[0], pose[0] = 5.4, 0.5
    source.take(polygon_of(SQUARE, 1, stamp=2))
    moved = only(source)
    assert ends(moved)[:, 0].max() == pytest.approx(0.5, abs=0.02)
    other = ends(moved)[ends(moved)[:, 1] > 0.5]
    assert (other.min(axis=0), other[:, 0].max()) == (
        pytest.approx([-0.7, 1.0], abs=0.02),
        pytest.approx(-0.3, abs=0.02),
    )
    now[0] = 5.8
    source.take(polygon_of(SQUARE, 1, stamp=3))
    assert ends(only(source))[:, 1].max() < 0.3


def test_polygons_that_cannot_be_used_are_refused_and_exclusions_hide_their_part() -> None:
    source = polygons([5.0], [0.0, 0.0, 0.0], exclusions=("here",))
    source.take(polygon_of(SQUARE))
    reading = only(source)
    assert np.hypot(*reading.points.T).min() > 1.1
    assert -1.0 in reading.rays.ranges
    source.take(polygon_of(SQUARE[:2], 2))
    assert "2 corners" in source.why
    source.take(polygon_of(SQUARE, 2, frame="nowhere"))
    assert "no transform from 'nowhere'" in source.why
    for number in range(70):
        source.take(polygon_of(SQUARE, number, stamp=number + 5))
    assert "wanted 64 at most" in source.why


def test_an_exclusion_that_is_switched_off_hides_nothing() -> None:
    switch = ToggleInput(False)
    topic = SourceTopic(topic="/x", type=CLOUD, exclusions=("arm",), mount=(0.0, 0.0, 0.0))
    frames = BodyFrames(FrameTopics(), 0.0, lambda _: None, lambda: 5.0)
    now = [5.0]
    reader = SourceReader(topic, (ExclusionArea("arm", radius=1.0),), frames, switches={"arm": switch})
    source, counts = SourceReceiver(reader, lambda: now[0]), []
    for stamp, on in enumerate((False, True, False), start=1):
        switch.on, now[0] = on, 5.0 + stamp
        source.take(cloud_of([[0.7, 0.0, 0.3]], stamp))
        counts.append(len(only(source).points))
    assert counts == [1, 0, 1]


@settings(max_examples=80, deadline=None)
@given(some.data())
def test_mutated_messages_of_any_source_raise_nothing_and_give_finite_rays(data: some.DataObject) -> None:
    whole = {
        CLOUD: cloud_of(np.ones((6, 3))), DEPTH_IMAGE: image_of(np.ones((4, 6))), RANGE: range_of(1.0),
        GRID: grid_message(np.eye(6, dtype=int) * 100), LASER: encode(LASER, {"ranges": [1.0] * 4}),
        POLYGON_INSTANCE: polygon_of(SQUARE), POLYGON: polygon_of(SQUARE, number=None),
    }  # fmt: skip
    kind = data.draw(some.sampled_from(sorted(whole)))
    message = bytearray(whole[kind])
    for _ in range(data.draw(some.integers(0, 8))):
        message[data.draw(some.integers(0, len(message) - 1))] = data.draw(some.integers(0, 255))
    cut = data.draw(some.integers(0, len(message)))
    grid = kind == GRID
    source = receiver(
        pose=(0.0, 0.0, 0.0), type=kind, info="/i" if kind == DEPTH_IMAGE else "", **({"mount": ()} if grid else {})
    )
    source.take_info(info_of(4, 6))
    source.take(bytes(message[:cut]) if data.draw(some.booleans()) else bytes(message))
    for reading in source.take_all():
        seen = reading.rays
        assert all(map(math.isfinite, (*seen.ranges, *seen.free, *seen.mount)))
        assert np.isfinite(reading.points).all()


@settings(max_examples=60, deadline=None)
@given(some.lists(some.tuples(some.floats(-2.0, 2.0), some.floats(-1.0, 1.0)), min_size=3, max_size=12))
def test_a_capsule_contains_every_corner_of_the_footprint_it_covers(corners: list[tuple[float, float]]) -> None:
    table = np.array(corners)
    rear, front, radius = covering_capsule(table)
    along = np.clip(table[:, 0], -rear, front)
    assert (np.hypot(table[:, 0] - along, table[:, 1]) <= radius + 1e-9).all()
    assert rear + front >= -1e-9


def test_the_largest_footprint_of_the_last_seconds_counts_and_none_is_infinitely_old() -> None:
    now = [5.0]
    found = FootprintInput(lambda _: pose_matrix(0.1, 0.0, 0.0, 0.0, 0.0, 0.0), 2.0, lambda: now[0])
    assert found.read()[1] == INF

    def send(half: float) -> None:
        points = [{"x": x * half, "y": y * half} for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        found.take(encode(POLYGON, {"header": head(), "polygon": {"points": points}}))

    send(0.3)
    now[0] += 1.0
    send(0.2)
    (rear, front, radius), age = found.read()
    assert (age, front > rear) == (0.0, True)
    assert radius >= 0.3
    now[0] += 1.5
    assert found.read()[0][2] < 0.3
    found.take(encode(POLYGON, {"polygon": {"points": [{"x": NAN}] * 4}}))
    assert (found.refused, found.read()[1]) == (1, 1.5)
    with pytest.raises(DecodingError, match="wanted 3 to"):
        corners_of(decode(POLYGON, encode(POLYGON, {"polygon": {"points": [{"x": 1.0}]}})))


def test_points_follow_the_robot_between_a_measurement_and_now() -> None:
    rays = receiver(type=RANGE)
    rays.take(range_of(1.0))
    reading = SourceReading(5.0, only(rays).rays, np.array([[2.0, 0.0]]), (1.0, 1.0, 0.0))
    assert reading.points_at((1.5, 1.0, math.pi / 2)) == pytest.approx(np.array([[0.0, -1.5]]))
    assert reading.points_at(None) == pytest.approx(np.array([[2.0, 0.0]]))


def test_velocity_to_the_left_is_that_of_the_reference_point() -> None:
    from safedpa_services.ros_gateway.sensor_inputs import PoseAndTwist

    odometry = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom", lambda: 5.0)
    odometry.take(encode("nav_msgs/msg/Odometry", odometry_of(head("odom"), "b", 1.0, 0.0, 0.0, 0.5, 0.4, 0.3)))
    pose = PoseAndTwist.of(odometry.read()[0], 0.5)
    assert (pose.speed, pose.aside, pose.yaw_rate) == pytest.approx((0.5, 0.3 - 0.5 * 0.4, 0.4))


@settings(max_examples=60, deadline=None)
@given(*[some.floats(-1.4, 1.4)] * 3)
def test_angles_of_a_pose_are_those_it_was_made_of_and_a_chain_back_is_the_inverse(roll, pitch, yaw):
    matrix = pose_matrix(1.0, -2.0, 0.5, roll, pitch, yaw)
    assert roll_pitch_yaw(matrix) == pytest.approx((roll, pitch, yaw), abs=1e-7)
    tree = TransformTree()
    tree.add("a", "b", matrix)
    tree.add("a", "c", pose_matrix(0.3, 0.0, 0.0, 0.0, 0.0, 1.0))
    there, back = tree.chain("c", "b", 0.0), tree.chain("b", "c", 0.0)
    assert there is not None
    assert back is not None
    assert there.matrix @ back.matrix == pytest.approx(np.eye(4), abs=1e-9)


def test_sources_of_a_bag_are_read_as_while_driving(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    text = """
        format = 2
        robot = "differential_drive"
        [odometry]
        topic = "/odom"
        [command]
        topic = "/cmd_vel"
        [surroundings]
        field = [-9.0, 9.0, -9.0, 9.0]
        footprint = [0.0, 0.0, 0.2]
        [[sources]]
        topic = "points"
        type = "sensor_msgs/msg/PointCloud2"
        name = "cloud"
    """
    (tmp_path / "robot.toml").write_text(text, encoding="utf-8")
    cloud = [[1.0, 0.0, 0.3], [0.0, 2.0, 0.3]]
    sent = [
        ("/points", CLOUD, cloud_of(cloud, 1)), ("/tf_static", TRANSFORMS, tf_of("base_link", "sensor", 0.2)),
        ("/points", CLOUD, cloud_of(cloud, 2)), ("/points", CLOUD, cloud_of(cloud, 3, point_step=1)),
        ("/points", CLOUD, cloud_of(cloud, 4)),
    ]  # fmt: skip
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds = {topic: kind for topic, kind, _ in sent}
        lines = {topic: writer.add_connection(topic, kind, typestore=type_store()) for topic, kind in kinds.items()}
        for number, (topic, _, data) in enumerate(sent):
            writer.write(lines[topic], 200_000_000 * number, data)
    found = list(read_sources(tmp_path / "bag", parse_robot_file(text)))
    assert [isinstance(reading, SourceReading) for _, _, reading in found] == [False, True, False, True]
    assert found[1][2].points == pytest.approx(np.array([[1.2, 0.0], [0.2, 2.0]]))
    assert safedpa.run(["ros", "sources", str(tmp_path / "robot.toml"), str(tmp_path / "bag")]) == 0
    notice = capsys.readouterr().out
    assert "2 of 4 messages can be used, longest gap 0.40 s" in notice
    assert "1 refused: there is no transform from 'sensor' to 'base_link' yet" in notice
    assert safedpa.run(["ros", "sources", str(tmp_path / "robot.toml"), str(tmp_path / "robot.toml")]) == 2
    assert "cannot be read as a rosbag2" in capsys.readouterr().err
