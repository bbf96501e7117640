"""A load as a rigid body on a hitch, dragged over the floor."""

from __future__ import annotations

from math import atan, cos, pi, sin, sqrt

import pymunk
from pymunk._chipmunk_cffi import lib

from safedpa_sim.robots.contacts import LOAD
from safedpa_sim.robots.loads import Load

__all__ = ["TowedBody"]

_angle, _position = lib.cpBodyGetAngle, lib.cpBodyGetPosition
_velocity, _set_force = lib.cpBodyGetVelocity, lib.cpBodySetForce

_FEET = 0.45
"""The feet stand at this share of the side from the centre, under the middle of each edge. Under the corners the joints
would hold 10 % too little: an impulse there that stops a foot also turns the body, so that it points beside the motion
when it is cut to the largest force."""
_RUNNER_SLIP = 0.1
"""rad; slip angle scale of the runners."""
_RUNNER_SPEED = 0.3
"""m/s added to the sliding speed in their slip angle, so that it is defined at standstill."""
_STIFF = 1e-9
"""Share of a joint's position error that is left after one second."""


class TowedBody:
    """A load in a pymunk space, hitched to the car until ``unhitch``.

    Ground friction: at each of four feet a joint to the floor that holds with at most mass deceleration / 4, whatever
    the direction: Coulomb friction that sticks, slides and resists turning, solved together with the hitch. Beside it
    the runners resist slip across the load, like a tyre without drive.
    """

    def __init__(self, space: pymunk.Space, car: pymunk.Body, hitch: tuple[float, float], load: Load) -> None:
        self.load = load
        self._space = space
        self.body, self.shape = _body_behind(car, hitch, load)
        self._handle = self.body._body
        grip = self.body.mass * load.grip
        self._hold = -sqrt(grip * grip)
        """N; the largest force of the runners, against the slip."""
        space.add(self.body, self.shape)
        arm = _FEET * load.side
        for place in ((arm, 0.0), (-arm, 0.0), (0.0, arm), (0.0, -arm)):
            space.add(_foot(self.body, space.static_body, place, load))
        # The load's near edge would touch the car's back beyond this angle; the hitch's own stop is there.
        stop = pi / 2 - atan(load.side / 2 / load.drawbar)
        pivot = pymunk.PivotJoint(car, self.body, hitch, (load.length, 0.0))
        limit = pymunk.RotaryLimitJoint(car, self.body, -stop, stop)
        for joint in (pivot, limit):
            joint.error_bias = _STIFF
            joint.collide_bodies = False
        self._joints: tuple[pymunk.Constraint, ...] = (pivot, limit)
        space.add(*self._joints)

    @property
    def hitched(self) -> bool:
        """Whether the car still tows it."""
        return bool(self._joints)

    @property
    def hitch_error(self) -> float:
        """Distance between the two halves of the hitch [m]; 0 when it is let go."""
        for joint in self._joints:
            if isinstance(joint, pymunk.PivotJoint):
                return (joint.a.local_to_world(joint.anchor_a) - joint.b.local_to_world(joint.anchor_b)).length
        return 0.0

    @property
    def pose(self) -> tuple[float, float, float, float, float]:
        """x, y [m] of the centre, yaw [rad], length and width [m]."""
        place, side = _position(self._handle), self.load.side
        return place.x, place.y, _angle(self._handle), side, side

    def apply_runners(self) -> None:
        """Sets the runners' force for the coming substep: ``axle_force`` without drive, written out."""
        handle = self._handle
        angle, velocity = _angle(handle), _velocity(handle)
        cosine, sine = cos(angle), sin(angle)
        vx, vy = velocity.x, velocity.y
        forward, sideways = vx * cosine + vy * sine, vy * cosine - vx * sine
        slip = sideways / (_RUNNER_SLIP * (abs(forward) + _RUNNER_SPEED))
        across = self._hold * slip / sqrt(1.0 + slip * slip)
        _set_force(handle, (-across * sine, across * cosine))

    def unhitch(self) -> None:
        """Lets the load go; it slides to rest and stays where it is. The car can bump into it."""
        self._space.remove(*self._joints)
        self._joints = ()


def _body_behind(car: pymunk.Body, hitch: tuple[float, float], load: Load) -> tuple[pymunk.Body, pymunk.Poly]:
    """A load straight behind the car, moving as the car's hitch does."""
    mass = load.mass_ratio * car.mass
    body = pymunk.Body(mass, mass * load.side**2 / 6)
    x, y = car.local_to_world(hitch)
    body.position = (x - load.length * cos(car.angle), y - load.length * sin(car.angle))
    body.angle = car.angle
    body.velocity = car.velocity_at_world_point(body.position)
    body.angular_velocity = car.angular_velocity
    shape = pymunk.Poly.create_box(body, (load.side, load.side))
    shape.friction, shape.collision_type = 0.5, LOAD
    return body, shape


def _foot(body: pymunk.Body, floor: pymunk.Body, place: tuple[float, float], load: Load) -> pymunk.Constraint:
    joint = pymunk.PivotJoint(body, floor, place, (0.0, 0.0))
    joint.max_bias = 0.0  # only the velocity is held, never the place: friction, not a peg
    joint.max_force = body.mass * load.deceleration / 4
    return joint
