"""The equations of the car's body: a capsule that the stopping distance stretches, and the room that a load claims.

The body is the segment from p - rear e to p + front e, e = (cos yaw, sin yaw), thickened by a radius. Driving forwards
stretches its front end by the stopping distance D, reversing its rear end. Braking straight ahead moves both ends
inwards only, so that no h falls under the braking action (the docs page on safety has the proof).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from safedpa.equations import Given
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.stopping import stopping_distance

__all__ = ["SweptBody", "body_of", "hitch_of", "steepest", "to_segment"]

_LENGTHS = 4


class SweptBody(NamedTuple):
    """Where the swept segment lies at a state."""

    cosine: Scalar
    sine: Scalar
    rear: Scalar
    """m along the heading, negative behind."""
    front: Scalar
    stretch: Scalar
    """D [m]"""


def body_of(given: Given, operations: Operations) -> SweptBody:
    """At a state (x, y, yaw, speed, ...), with the shared numbers rear, front [m], b [m/s2] and k [1/s]."""
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
    """Distance [m] of a place from the segment from ``low`` to ``high`` [m] along the heading."""
    apart_x, apart_y = place[0] - given.state[0], place[1] - given.state[1]
    along = body.cosine * apart_x + body.sine * apart_y
    across = body.cosine * apart_y - body.sine * apart_x
    return operations.hypot(along - operations.clip(along, low, high), across)


def hitch_of(body: SweptBody, given: Given, operations: Operations) -> tuple[Scalar, Scalar] | None:
    """Where the hitch is along the heading, and by how much the radius around it is larger [m]; None: nothing towed.

    Seen from the hitch, a load that is pulled is drawn into line, one that is pushed is turned away from it. How far it
    is turned is not measured; how far the robot was driven backwards is, and it bounds where the load can be. Let w be
    the way driven backwards, net of what was driven forwards since, at the pose p0, e0 = (cos yaw0, sin yaw0). At a
    state near it, and at the end of the stop from there if the robot is reversing (D <= 0),

        w' = max(0, w - e0'(p - p0)) + max(0, -D(speed)),
        growth = most clip((w' - begin) / (end - begin), 0, 1).

    Braking straight while reversing moves w - e0'p up by no more than -D comes down, so that growth does not rise under
    the brake.
    """
    if len(given.shared) == _LENGTHS:
        return None
    begin, rate, most, way, x0, y0, cosine, sine = given.shared[_LENGTHS:]
    moved = cosine * (given.state[0] - x0) + sine * (given.state[1] - y0)
    after = operations.maximum(0.0, way - moved) + operations.maximum(0.0, -body.stretch)
    return -given.shared[0], operations.clip((after - begin) * rate, 0.0, most)


def steepest(given: Given, operations: Operations) -> list[Any]:
    """What no slope of a distance to the body exceeds.

    1 over a place, the longer arm over yaw, D' = max(1/k, |v|/b) over the speed.
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
