"""Readings of any sensor as rays: what is a return, what is free, and what stays unknown."""

from __future__ import annotations

from math import atan2, hypot, inf, nan, pi

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.perception import (
    Camera,
    HeightBand,
    Rays,
    rays_of_depth,
    rays_of_grid,
    rays_of_points,
    rays_of_polygon,
    rays_of_range,
)

CENTRE = (0.0, 0.0, 0.0)


def ends(seen) -> np.ndarray:
    """Returns in the body frame."""
    ranges = np.array(seen.ranges)
    angles = seen.mount[2] + seen.first_angle + seen.angle_step * np.arange(len(ranges))
    hit = (ranges >= seen.nearest) & (ranges < seen.farthest)
    return np.column_stack(
        [seen.mount[0] + (ranges * np.cos(angles))[hit], seen.mount[1] + (ranges * np.sin(angles))[hit]]
    )


def test_each_point_of_a_cloud_is_at_its_distance_in_its_direction() -> None:
    draw = np.random.default_rng(3)
    for _ in range(20):
        x, y = draw.uniform(-4.0, 4.0, 2)
        mount = (*draw.uniform(-0.3, 0.3, 2), draw.uniform(-pi, pi))
        found = ends(rays_of_points([[x, y, 0.4]], mount, rays=1080))
        assert len(found) == 1
        assert np.abs(found[0] - (x, y)).max() < 6.0 * pi / 1080


def test_a_point_above_the_band_is_no_return_and_shows_no_free_space() -> None:
    seen = rays_of_points([[2.0, 0.0, 1.4]], CENTRE, band=HeightBand(0.1, 1.2))
    assert not len(ends(seen))
    assert max(seen.free) == 0.0


def test_ground_shows_free_space_up_to_the_farthest_point_of_its_sector() -> None:
    seen = rays_of_points([[1.0, 0.0, 0.0], [2.5, 0.0, 0.01]], CENTRE)
    assert max(seen.free) == pytest.approx(2.5)
    assert sum(length > 0.0 for length in seen.free) == 1


def test_the_nearest_point_of_a_sector_counts_and_points_that_are_not_finite_do_not() -> None:
    seen = rays_of_points([[3.0, 0.0, 0.5], [2.0, 0.0, 0.5], [nan, 0.0, 0.5], [inf, 0.0, 0.5]], CENTRE)
    assert ends(seen).tolist() == [pytest.approx([2.0, 0.0], abs=1e-9)]


def test_points_outside_the_field_of_view_are_left_out() -> None:
    assert not len(ends(rays_of_points([[-2.0, 0.0], [0.0, 2.0]], CENTRE, field_of_view=1.0)))


@pytest.mark.parametrize("pitch", [0.0, 0.3])
def test_a_wall_in_a_depth_image_is_where_it_is(pitch: float) -> None:
    camera = Camera(60.0, 60.0, 39.5, 29.5, x=0.1, z=0.4, pitch=pitch)
    v, u = np.mgrid[0:60, 0:80]
    left, up = (camera.cx - u) / camera.fx, (camera.cy - v) / camera.fy
    level, down = np.cos(pitch) + up * np.sin(pitch), np.sin(pitch) - up * np.cos(pitch)
    wall = 2.0 / level  # x = 2.1 in the body frame
    with np.errstate(divide="ignore"):
        ground = np.where(down > 0.0, camera.z / down, np.inf)
    seen = rays_of_depth(np.minimum(wall, ground), camera, farthest=5.0)
    found = ends(seen)
    assert len(found) > 40
    assert np.abs(found[:, 0] - 2.1).max() < 0.05
    assert np.ptp(found[:, 1]) > 1.5
    assert left.shape == wall.shape


def test_pixels_without_depth_say_nothing() -> None:
    seen = rays_of_depth(np.full((6, 8), nan), Camera(8.0, 8.0, 3.5, 2.5))
    assert not len(ends(seen))
    assert max(seen.free) == 0.0


def test_a_range_occupies_its_whole_arc_and_a_range_below_the_least_is_not_measured() -> None:
    seen = rays_of_range(1.5, 0.5, (0.2, 0.0, pi / 2), 0.05, 3.0)
    found = ends(seen)
    assert np.hypot(found[:, 0] - 0.2, found[:, 1]) == pytest.approx(1.5)
    turns = [atan2(y, x - 0.2) for x, y in found]
    assert max(turns) - min(turns) == pytest.approx(0.5)
    assert set(rays_of_range(nan, 0.5, CENTRE, 0.05, 3.0).ranges) == {-1.0}
    assert set(rays_of_range(inf, 0.5, CENTRE, 0.05, 3.0).ranges) == {3.0}


def test_a_grid_is_free_up_to_what_is_occupied_or_unknown() -> None:
    cells = np.zeros((80, 80), dtype=int)
    cells[:, 60:] = 100  # x > 1 m in the body frame
    cells[:, :20] = -1  # x < -1 m
    seen = rays_of_grid(cells, 0.05, (-2.0, -2.0, 0.0), rays=360)
    ahead, behind = 180, 0
    assert seen.ranges[ahead] == pytest.approx(1.0, abs=0.06)
    assert seen.ranges[behind] >= seen.farthest - 0.05
    assert seen.free[behind] == pytest.approx(1.0, abs=0.06)
    assert all(x > 0.9 for x, _ in ends(seen))


def test_a_grid_turns_with_its_origin() -> None:
    cells = np.zeros((80, 80), dtype=int)
    cells[:, 60:] = 100
    seen = rays_of_grid(cells, 0.05, (2.0, -2.0, pi / 2), rays=360)
    assert all(y > 0.9 for _, y in ends(seen))


def test_a_polygon_is_hit_on_its_near_side() -> None:
    seen = rays_of_polygon([[1.0, -0.5], [2.0, -0.5], [2.0, 0.5], [1.0, 0.5]])
    assert min(seen.ranges) == pytest.approx(1.0)
    assert all(hypot(x, y) < 1.2 for x, y in ends(seen))


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda: rays_of_points([[1.0]], CENTRE), "points"),
        (lambda: rays_of_points([[1.0, 0.0]], CENTRE, rays=5000), "rays"),
        (lambda: rays_of_points([[1.0, 0.0]], (nan, 0.0, 0.0)), "mount"),
        (lambda: rays_of_grid([[0]], 0.0, CENTRE), "grid"),
        (lambda: rays_of_depth([1.0], Camera(8.0, 8.0, 3.5, 2.5)), "depth image"),
        (lambda: rays_of_polygon([[1.0, nan], [0.0, 1.0]]), "polygon"),
        (lambda: Camera(0.0, 8.0, 3.5, 2.5), "camera"),
        (lambda: HeightBand(1.0, 0.5), "height band"),
    ],
)
def test_readings_of_another_shape_are_refused_by_name(call, names) -> None:
    with pytest.raises(InputError, match=names):
        call()


def test_each_field_of_rays_reaches_the_message() -> None:
    rays = Rays((0.1, 0.2, 0.3), -1.0, 0.25, (1.0, 2.0, 3.0), 0.05, 8.0, (0.5, 0.6, 0.7))
    message = rays.message("laser", 4, 5, 6, 7.5)
    for name in ("mount", "first_angle", "angle_step", "ranges", "nearest", "farthest", "free"):
        assert getattr(message, name) == getattr(rays, name), name
    assert (message.source, message.number, message.epoch, message.tick, message.robot_time) == ("laser", 4, 5, 6, 7.5)
    assert message.publish_time > 1e9
