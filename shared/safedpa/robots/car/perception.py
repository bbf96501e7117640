"""The learned policy's observation of one car, computed from its state message; compiled by mypyc.

``observe_one`` has the equations of ``safedpa.robots.car.observation.observe`` over plain floats, without the overhead
of small arrays, and agrees with it up to rounding. A ray is checked only against obstacles that it can hit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from safedpa.arrays import AnyFloatArray
from safedpa.bus import StateMessage
from safedpa.errors import MessageError
from safedpa.policy.perception import ObservationModel, checked_state
from safedpa.robots.car.observation import (
    FAR_AWAY,
    FULL_RADIUS,
    FULL_SPEED,
    FULL_STEER,
    NEAR,
    OBSTACLES,
    RAYS,
    TOUCHING,
    observation_length,
)

_STEP = 2.0 * math.pi / RAYS
_COSINES = [math.cos(_STEP * ray) for ray in range(RAYS)]
_SINES = [math.sin(_STEP * ray) for ray in range(RAYS)]
_HALF = RAYS // 2
_STEEPEST = 1e-4
_FARTHEST = FAR_AWAY[0]

Row = Sequence[float]


def observe_one(
    state: Row, applied: Row, goal: Row, obstacles: Sequence[Row], field: Row, footprint: Row, latent: Row
) -> list[float]:
    """Returns the observation of one car, as ``observe`` does; any number of obstacles is accepted.

    Raises ValueError or OverflowError for values that are not finite.
    """
    x, y, yaw, speed = state
    cosine, sine = math.cos(yaw), math.sin(yaw)
    own = []
    for east, north, radius in [*obstacles, *[FAR_AWAY] * (OBSTACLES - len(obstacles))]:
        aside, ahead = north - y, east - x
        own.append((cosine * ahead + sine * aside, cosine * aside - sine * ahead, radius))
    east, north = goal[0] - x, goal[1] - y
    return [
        *_goal(cosine * east + sine * north, cosine * north - sine * east),
        *(speed / FULL_SPEED, applied[0] / FULL_SPEED, applied[1] / FULL_STEER, footprint[2] / FULL_RADIUS),
        *_nearest(own, footprint),
        *_rays((x, y, cosine, sine), own, field, footprint),
        *latent,
    ]


def _goal(ahead: float, aside: float) -> tuple[float, ...]:
    distance = math.sqrt(ahead * ahead + aside * aside)
    least = max(distance, 1e-6)
    far = 4.0 * NEAR
    return ahead / least, aside / least, NEAR / (NEAR + distance), far / (far + distance), aside / (NEAR + distance)


def _nearest(own: Sequence[tuple[float, float, float]], footprint: Row) -> list[float]:
    rear, front, own_radius = footprint
    reported = []
    for ahead, aside, radius in own:
        offset = ahead - min(max(ahead, -rear), front)
        length = math.sqrt(offset * offset + aside * aside)
        reported.append((length - radius - own_radius, length, offset, aside, ahead))
    reported.sort()
    values: list[float] = []
    for room, length, offset, aside, ahead in reported[:OBSTACLES]:
        gap = max(room, 0.0)
        near, least = NEAR / (NEAR + gap), max(length, 1e-6)
        reach = near / (NEAR + math.sqrt(ahead * ahead + aside * aside))
        values += (near * (offset / least), near * (aside / least), ahead * reach, aside * reach)
        values.append(TOUCHING / (TOUCHING + gap))
    return values


def _rays(
    pose: tuple[float, float, float, float], own: Sequence[tuple[float, float, float]], field: Row, footprint: Row
) -> list[float]:
    rear, front, own_radius = footprint
    middle = 0.5 * (front - rear)
    nearest = _to_walls(pose, middle, own_radius, field)
    for centre, aside, radius in own:
        ahead, reach = centre - middle, radius + own_radius
        distance = math.sqrt(ahead * ahead + aside * aside)
        for ray in _rays_towards(ahead, aside, reach, distance):
            cosine, sine = _COSINES[ray], _SINES[ray]
            along, across = ahead * cosine + aside * sine, aside * cosine - ahead * sine
            inside = reach * reach - across * across
            if inside > 0.0 and along > 0.0:
                hit = along - math.sqrt(inside)
                if hit < nearest[ray]:
                    nearest[ray] = max(hit, 0.0)
    return [NEAR / (NEAR + distance) for distance in nearest]


def _rays_towards(ahead: float, aside: float, reach: float, distance: float) -> Sequence[int]:
    """Those that may meet a disc of radius ``reach``: one more on either side than its angle spans."""
    if distance <= reach:
        return range(RAYS)
    middle, half = math.atan2(aside, ahead) / _STEP, math.asin(reach / distance) / _STEP
    first, last = math.floor(middle - half), math.ceil(middle + half)
    return [ray % RAYS for ray in range(first, last + 1)]


def _to_walls(pose: tuple[float, float, float, float], middle: float, radius: float, field: Row) -> list[float]:
    """Returns how far [m] the disc gets along each ray before it touches a wall; opposite rays share their slopes."""
    x, y, cosine, sine = pose
    west, east, south, north = field
    x, y = x + middle * cosine, y + middle * sine
    to_east, to_west = max(east - radius - x, 0.0), max(x - west - radius, 0.0)
    to_north, to_south = max(north - radius - y, 0.0), max(y - south - radius, 0.0)
    there, back = [], []
    for turned, aside in zip(_COSINES[:_HALF], _SINES[:_HALF], strict=True):
        along_x, along_y = cosine * turned - sine * aside, sine * turned + cosine * aside
        steep_x, steep_y = max(abs(along_x), _STEEPEST), max(abs(along_y), _STEEPEST)
        ways_x = (to_east / steep_x, to_west / steep_x) if along_x > 0.0 else (to_west / steep_x, to_east / steep_x)
        ways_y = (to_north / steep_y, to_south / steep_y) if along_y > 0.0 else (to_south / steep_y, to_north / steep_y)
        there.append(min(ways_x[0], ways_y[0], _FARTHEST))
        back.append(min(ways_x[1], ways_y[1], _FARTHEST))
    return there + back


def _observed_car(state: StateMessage, latent: AnyFloatArray) -> AnyFloatArray:
    checked_state(state, values=4, applied=2, goal=2, field=4, footprint=3)
    if any(len(row) != 3 for row in state.obstacles):
        raise MessageError("state.obstacles: got rows of another length, wanted 3 numbers in each: x, y, radius")
    try:
        seen = observe_one(
            state.values, state.applied, state.goal, state.obstacles, state.field, state.footprint, latent.tolist()
        )
    except (ValueError, OverflowError) as error:
        raise MessageError(f"state: got numbers that are not finite in {state.values}, wanted finite ones") from error
    return np.array(seen)


PERCEPTION = ObservationModel(observation_length, _observed_car)
