"""The equations of the car's body: a capsule extended by the stopping distance, and the space that a load may take.

The body is the segment from p - rear e to p + front e, e = (cos yaw, sin yaw), thickened by a radius. Driving forwards
extends its front end by the stopping distance D, reversing its rear end. Straight braking only moves both ends inwards,
so that no h decreases under the braking action (the docs page on safety has the proof).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import Any, NamedTuple, final

from safedpa.equations import Given
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.stopping import stopping_distance

_LENGTHS = 4


class SweptBody(NamedTuple):
    """The swept segment at a state."""

    cosine: Scalar
    sine: Scalar
    rear: Scalar
    """m along the heading, negative behind."""
    front: Scalar
    stretch: Scalar
    """D [m]"""


def body_of(given: Given, operations: Operations) -> SweptBody:
    """Returns the swept segment at a state (x, y, yaw, speed, ...) for shared rear, front [m], b [m/s2] and k [1/s]."""
    yaw, speed = given.state[2], given.state[3]
    rear, front, deceleration, gain = given.shared[:_LENGTHS]
    stretch = stopping_distance(speed, deceleration, gain, operations)
    return SweptBody(
        operations.cos(yaw),
        operations.sin(yaw),
        -rear + operations.minimum(stretch, 0.0),
        front + operations.maximum(stretch, 0.0),
        stretch,
    )


def to_segment(
    body: SweptBody, given: Given, low: Scalar, high: Scalar, place: tuple[Scalar, Scalar], operations: Operations
) -> Scalar:
    """Returns the distance [m] of a position from the segment from ``low`` to ``high`` [m] along the heading."""
    apart_x, apart_y = place[0] - given.state[0], place[1] - given.state[1]
    along = body.cosine * apart_x + body.sine * apart_y
    across = body.cosine * apart_y - body.sine * apart_x
    return operations.hypot(along - operations.clip(along, low, high), across)


def hitch_of(body: SweptBody, given: Given, operations: Operations) -> tuple[Scalar, Scalar] | None:
    """Returns the hitch's position along the heading and the growth of the radius around it [m]; None without a load.

    A load that is pulled aligns with the car, one that is pushed turns away. Its angle is not measured, but the
    distance driven backwards is, and it bounds where the load can be. Let w be this distance, net of forward motion
    since, at the pose p0, e0 = (cos yaw0, sin yaw0). At a state near it, and at the end of the stop if the car is
    reversing (D <= 0),

        w' = max(0, w - e0'(p - p0)) + max(0, -D(speed)),
        growth = most clip((w' - begin) / (end - begin), 0, 1).

    Straight braking while reversing increases w - e0'p by no more than -D decreases, so that growth does not increase
    under braking.
    """
    if len(given.shared) == _LENGTHS:
        return None
    begin, rate, most, way, x0, y0, cosine, sine = given.shared[_LENGTHS:]
    moved = cosine * (given.state[0] - x0) + sine * (given.state[1] - y0)
    after = operations.maximum(0.0, way - moved) + operations.maximum(0.0, -body.stretch)
    return -given.shared[0], operations.clip((after - begin) * rate, 0.0, most)


def grad_bound(given: Given, operations: Operations) -> list[Any]:
    """Returns upper bounds of the partial derivatives of a distance to the body.

    1 with respect to a position, the longer arm to yaw, D' = max(1/k, |v|/b) to the speed; larger with a load.
    """
    body = body_of(given, operations)
    _, _, deceleration, gain = given.shared[:_LENGTHS]
    change = operations.maximum(1.0 / gain, operations.absolute(given.state[3]) / deceleration)
    arm = operations.maximum(operations.absolute(body.rear), operations.absolute(body.front))
    place: Scalar = 1.0
    if len(given.shared) > _LENGTHS:
        place = 1.0 + given.shared[_LENGTHS + 1]
        change = change * place
    return [place, place, arm, change, *(0.0 for _ in given.state[4:])]


@final
@dataclass(frozen=True)
class TrailerEnvelope:
    """The parameters of the equations of ``hitch_of``; all lengths [m].

    After driving backwards by ``begin`` a load may start to leave the footprint, after ``end`` > ``begin`` it may be at
    any angle and then needs ``most`` beyond the footprint's radius. ``way`` is the distance driven backwards at
    ``pose`` (x, y, yaw). docs/reference/robot.md has measurements.
    """

    begin: float
    end: float
    most: float
    way: float
    pose: tuple[float, float, float]

    @property
    def numbers(self) -> tuple[float, ...]:
        """begin, growth per distance, most, way, x, y, cos yaw, sin yaw."""
        x, y, yaw = self.pose
        rate = self.most / (self.end - self.begin)
        return self.begin, rate, self.most, self.way, x, y, cos(yaw), sin(yaw)
