"""The observation of a learned policy: goal and free space around the car, in its own frame, for batches of cars.

Training uses this module. A service, which has one car at a time, uses ``safedpa.robots.car.perception``, the same
equations over plain floats.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safedpa.arrays import AnyFloatArray

RAYS = 16
"""Number of rays, evenly spaced around the car; the first points straight ahead."""
OBSTACLES = 4
"""Number of nearest obstacles that are observed individually."""

FAR_AWAY = (1e4, 1e4, 0.0)
"""Padding for unused obstacle rows: an obstacle far away."""
FULL_SPEED = 2.0
FULL_STEER = 0.34
FULL_RADIUS = 0.45
NEAR = 1.0
"""m; distance at which the closeness near / (near + distance) is 0.5."""
TOUCHING = 0.2
"""m; the same for the clearance of the nearest obstacles, where centimetres matter."""
_GOAL = 5
_OWN = 4
_PER_OBSTACLE = 5
_ANGLES = 2.0 * np.pi / RAYS * np.arange(RAYS)


def observation_length(latents: int) -> int:
    """Returns the number of entries of an observation."""
    return _GOAL + _OWN + _PER_OBSTACLE * OBSTACLES + RAYS + latents


def observe(
    state: AnyFloatArray,
    applied: AnyFloatArray,
    goal: AnyFloatArray,
    obstacles: AnyFloatArray,
    field: AnyFloatArray,
    footprint: AnyFloatArray,
    latent: AnyFloatArray,
) -> AnyFloatArray:
    """Returns observations (..., observation_length) of cars: goal, own motion, nearest obstacles, rays, latent.

    State (..., 4) and the current action ``applied`` (..., 2) are in SI units, goal (..., 2) [m], obstacles (..., m, 3)
    x, y, radius [m] with m >= OBSTACLES (see ``padded``), field (..., 4) lowest x, highest x, lowest y, highest y,
    footprint (..., 3) rear, front, radius, latent (..., latents). Distances d are encoded as closeness near / (near +
    d). Rays start at the footprint's centre and measure how far a disc of the footprint's radius can move, so that the
    car fits through wherever a ray is free.
    """
    cosine, sine = np.cos(state[..., 2]), np.sin(state[..., 2])
    own = _own_frame(obstacles[..., :2] - state[..., np.newaxis, :2], cosine[..., np.newaxis], sine[..., np.newaxis])
    parts = (
        _goal(_own_frame(goal - state[..., :2], cosine, sine)),
        _motion(state, applied, footprint),
        _nearest(own, obstacles[..., 2], footprint),
        _rays(state, own, obstacles[..., 2], field, footprint),
        latent,
    )
    return np.concatenate(parts, axis=-1)


def padded(obstacles: Sequence[Sequence[float]], least: int = OBSTACLES) -> AnyFloatArray:
    """Pads obstacles (m, 3) with far-away ones to at least ``least`` rows."""
    rows = [tuple(row) for row in obstacles]
    return np.array(rows + [FAR_AWAY] * (least - len(rows)), dtype=np.float64)


def clearances(
    own: AnyFloatArray, radii: AnyFloatArray, footprint: AnyFloatArray
) -> tuple[AnyFloatArray, AnyFloatArray]:
    """Returns the clearance [m] of the capsule to obstacles (..., m), negative inside, and vectors (..., m, 2) to them.

    ``own`` holds the obstacles' centres (..., m, 2) in the car's frame. The vectors point from the closest point of the
    capsule's axis to the centres, in the same frame.
    """
    rear, front, radius = (footprint[..., index, np.newaxis] for index in range(3))
    offset = own.copy()
    offset[..., 0] -= np.minimum(np.maximum(own[..., 0], -rear), front)
    return _length(offset) - radii - radius, offset


def _goal(own: AnyFloatArray) -> AnyFloatArray:
    distance = _length(own)
    direction = own / np.maximum(distance, 1e-6)[..., np.newaxis]
    scaled = np.stack((_closeness(distance, NEAR), _closeness(distance, 4.0 * NEAR)), axis=-1)
    aside = own[..., 1:] / (NEAR + distance[..., np.newaxis])
    return np.concatenate((direction, scaled, aside), axis=-1)


def _motion(state: AnyFloatArray, applied: AnyFloatArray, footprint: AnyFloatArray) -> AnyFloatArray:
    radius = np.broadcast_to(footprint[..., 2], state.shape[:-1])
    entries = (
        state[..., 3] / FULL_SPEED,
        applied[..., 0] / FULL_SPEED,
        applied[..., 1] / FULL_STEER,
        radius / FULL_RADIUS,
    )
    return np.stack(entries, axis=-1)


def _nearest(own: AnyFloatArray, radii: AnyFloatArray, footprint: AnyFloatArray) -> AnyFloatArray:
    """Returns five entries for each of the nearest obstacles, nearest first.

    Direction to the surface times closeness (2), direction to the centre times closeness (2), closeness of the
    clearance.
    """
    room, offset = clearances(own, radii, footprint)
    order = np.argsort(room, axis=-1)[..., :OBSTACLES]
    room = np.take_along_axis(room, order, axis=-1)
    offset = np.take_along_axis(offset, order[..., np.newaxis], axis=-2)
    centre = np.take_along_axis(own, order[..., np.newaxis], axis=-2)
    near = _closeness(np.maximum(room, 0.0), NEAR)[..., np.newaxis]
    touching = _closeness(np.maximum(room, 0.0), TOUCHING)[..., np.newaxis]
    direction = offset / np.maximum(_length(offset), 1e-6)[..., np.newaxis]
    towards = centre / (NEAR + _length(centre))[..., np.newaxis]
    reported = np.concatenate((near * direction, near * towards, touching), axis=-1)
    return reported.reshape(*reported.shape[:-2], -1)


def _rays(
    state: AnyFloatArray, own: AnyFloatArray, radii: AnyFloatArray, field: AnyFloatArray, footprint: AnyFloatArray
) -> AnyFloatArray:
    """Returns for each ray the closeness of what stops a disc of the footprint's radius from the footprint's centre."""
    middle = 0.5 * (footprint[..., 1] - footprint[..., 0])
    radius = footprint[..., 2]
    cosine, sine = (turn(_ANGLES).astype(state.dtype) for turn in (np.cos, np.sin))
    nearest = _to_walls(state, middle, radius, field)
    for index in range(own.shape[-2]):  # one at a time keeps the intermediate arrays in the cache
        ahead = (own[..., index, 0] - middle)[..., np.newaxis]
        aside = own[..., index, 1, np.newaxis]
        along = ahead * cosine + aside * sine
        across = aside * cosine - ahead * sine
        inside = np.square(radii[..., index] + radius)[..., np.newaxis] - across * across
        hit = np.maximum(along - np.sqrt(np.maximum(inside, 0.0)), 0.0)
        met = (inside > 0.0) & (along > 0.0)
        nearest = np.where(met, np.minimum(nearest, hit), nearest)
    return _closeness(nearest, NEAR)


def _to_walls(
    state: AnyFloatArray, middle: AnyFloatArray, radius: AnyFloatArray, field: AnyFloatArray
) -> AnyFloatArray:
    """Returns how far [m] the same disc moves along each ray before it touches a wall, (..., RAYS)."""
    angle = state[..., 2, np.newaxis] + _ANGLES.astype(state.dtype)
    nearest: AnyFloatArray = np.full(angle.shape, FAR_AWAY[0], dtype=state.dtype)
    for axis, slope in ((0, np.cos(angle)), (1, np.sin(angle))):
        heading = np.cos(state[..., 2]) if axis == 0 else np.sin(state[..., 2])
        start = state[..., axis] + middle * heading
        up = np.maximum(field[..., 2 * axis + 1] - radius - start, 0.0)[..., np.newaxis]
        down = np.maximum(start - field[..., 2 * axis] - radius, 0.0)[..., np.newaxis]
        room = np.where(slope > 0.0, up, down) / np.maximum(np.abs(slope), 1e-4)
        nearest = np.minimum(nearest, room)
    return nearest


def _own_frame(offset: AnyFloatArray, cosine: AnyFloatArray, sine: AnyFloatArray) -> AnyFloatArray:
    x, y = offset[..., 0], offset[..., 1]
    return np.stack((cosine * x + sine * y, cosine * y - sine * x), axis=-1)


def _length(offset: AnyFloatArray) -> AnyFloatArray:
    length: AnyFloatArray = np.sqrt(np.square(offset[..., 0]) + np.square(offset[..., 1]))
    return length


def _closeness(distance: AnyFloatArray, near: float) -> AnyFloatArray:
    closeness: AnyFloatArray = near / (near + distance)
    return closeness
