"""The physics of the simulated car, seen from above: a rigid body with tyres, towed loads and solid objects, in pymunk.

A load is a rigid body on a hitch, dragged over the floor.
"""

from __future__ import annotations

from math import atan, ceil, cos, pi, sin, sqrt

import pymunk
from pymunk._chipmunk_cffi import lib

from safedpa_sim.ground_forces import DrivePeriod, GroundForces, runner_force
from safedpa_sim.robots.car.actuators import SteeringActuator, drive_of
from safedpa_sim.robots.car.contacts import CAR, LOAD, OBSTACLE, WALL, Collision, ContactCounter, OtherBody
from safedpa_sim.robots.car.loads import Load
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS, SUBSTEP, CarParameters

_angle, _position = lib.cpBodyGetAngle, lib.cpBodyGetPosition
_velocity, _rate = lib.cpBodyGetVelocity, lib.cpBodyGetAngularVelocity
_set_force, _set_torque, _step = lib.cpBodySetForce, lib.cpBodySetTorque, lib.cpSpaceStep
"""The C functions behind pymunk's ``body.angle``, ``space.step`` and so on. pymunk's wrappers dominate the time of a
substep, and their bookkeeping of bodies that are added or removed within a step is not needed here."""

_WALL_THICKNESS = 0.2
"""m; far more than the car moves in a substep, so that it cannot pass through."""


class CarWorld:
    """Simulates the car and everything around it, in SI units and radians, in the frame of the field."""

    def __init__(
        self,
        start: tuple[float, float, float],
        field: tuple[float, float, float, float],
        obstacles: tuple[tuple[float, float, float], ...] = (),
        load: Load | None = None,
        parameters: CarParameters = CAR_PARAMETERS,
        polygons: tuple[tuple[tuple[float, float], ...], ...] = (),
    ) -> None:
        self.parameters = parameters
        self.time = 0.0
        self.drive = drive_of(parameters)
        self.steering = SteeringActuator(parameters)
        self.space = pymunk.Space()
        self.space.collision_slop = 0.0005  # m; the default of 0.1 is meant for pixels
        self.contacts = ContactCounter(self.space)
        _add_solids(self.space, self.contacts, field, obstacles, polygons)
        self.body, self._shape = self._add_car(start)
        self._handle = self.body._body
        self._ground = GroundForces(parameters)
        self.wind = (0.0, 0.0)
        """Force of a steady wind over the car's mass, m/s2 along the field's x and y."""
        self.steering_offset = 0.0
        """rad that are added to every steering command."""
        self.towed: TowedBody | None = None
        self.others: list[OtherBody] = []
        """Bodies of other cars on the same field."""
        self._loads: list[TowedBody] = []
        if load is not None:
            self.hitch(load)

    def _add_car(self, start: tuple[float, float, float]) -> tuple[pymunk.Body, pymunk.Poly]:
        car = self.parameters
        x, y, yaw = start
        body = pymunk.Body(car.mass, car.inertia)
        body.position = (x + car.centre_of_mass * cos(yaw), y + car.centre_of_mass * sin(yaw))
        body.angle = yaw
        back, nose, side = -car.rear - car.centre_of_mass, car.front - car.centre_of_mass, car.width / 2
        shape = pymunk.Poly(body, [(back, -side), (nose, -side), (nose, side), (back, side)])
        shape.friction, shape.collision_type = 0.5, CAR
        self.contacts.name(shape, "car")
        self.space.add(body, shape)
        return body, shape

    @property
    def state(self) -> tuple[float, float, float, float]:
        """x, y [m], yaw [rad] (not wrapped) and forward speed [m/s] of the middle of the rear axle."""
        handle, offset = self._handle, self.parameters.centre_of_mass
        yaw, position, velocity = _angle(handle), _position(handle), _velocity(handle)
        cosine, sine = cos(yaw), sin(yaw)
        return position.x - offset * cosine, position.y - offset * sine, yaw, velocity.x * cosine + velocity.y * sine

    @property
    def collisions(self) -> list[Collision]:
        """Every collision so far, in order."""
        return self.contacts.collisions

    def add_person(self, x: float, y: float, radius: float, name: str) -> pymunk.Body:
        """Adds a disc that moves with its velocity until it touches car or load; contacts count under ``name``."""
        body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        body.position = (x, y)
        shape = pymunk.Circle(body, radius)
        shape.friction, shape.collision_type = 0.6, OBSTACLE
        self.contacts.name(shape, name)
        self.space.add(body, shape)
        return body

    @property
    def bodies(self) -> list[tuple[str, pymunk.Poly]]:
        """The car's body and every load that it has towed so far, each with the name of the part in collisions."""
        return [("car", self._shape), *(("load", load.shape) for load in self._loads)]

    def add_other(self, shape: pymunk.Poly, name: str) -> None:
        """Adds the body of another car to this world; contacts count under ``name``."""
        other = OtherBody(self.space, shape, OBSTACLE, name)
        self.others.append(other)
        self.contacts.name(other.shape, name)

    def hitch(self, load: Load) -> None:
        """Hitches a load straight behind the car, moving at the car's speed; a load that is already there is unhitched.

        The space behind the car must be free, because the contact solver pushes overlapping bodies apart.
        """
        self.unhitch()
        car = self.parameters
        self.towed = TowedBody(self.space, self.body, (-car.rear - car.centre_of_mass, 0.0), load)
        self._loads.append(self.towed)
        self.contacts.name(self.towed.shape, "load")

    def unhitch(self) -> None:
        """Unhitches the load, if any; it stays in the world."""
        if self.towed is not None:
            self.towed.unhitch()
            self.towed = None

    def advance(self, command: float, steer: float, seconds: float) -> None:
        """Simulates ``seconds`` under one action, in equal substeps of at most 1/400 s.

        ``command`` is a target speed [m/s], or the throttle of a car with a throttle.
        """
        substeps = ceil(seconds / SUBSTEP - 1e-9)
        if substeps <= 0:
            return
        pace, now, motor = seconds / substeps, self.time, self.drive
        space, handle, loads, contacts = self.space._space, self._handle, self._loads, self.contacts
        pull, share = motor.pull(command), motor.share(pace)
        drive = DrivePeriod(self._ground, pull, motor.limit, share, motor.acceleration, self.wind)
        forces = drive.substep
        for angle in self.steering.angles(steer + self.steering_offset, pace, substeps):
            velocity = _velocity(handle)
            to_east, to_north, torque = forces(_angle(handle), velocity.x, velocity.y, _rate(handle), angle)
            _set_force(handle, (to_east, to_north))
            _set_torque(handle, torque)
            for load in loads:
                load.apply_runners()
            now += pace
            contacts.time = now
            _step(space, pace)
        self.time, motor.acceleration = now, drive.acceleration


def _add_solids(
    space: pymunk.Space,
    contacts: ContactCounter,
    field: tuple[float, float, float, float],
    obstacles: tuple[tuple[float, float, float], ...],
    polygons: tuple[tuple[tuple[float, float], ...], ...],
) -> None:
    west, east, south, north = field
    depth = _WALL_THICKNESS
    walls = {
        "west": (west - depth, south - depth, west, north + depth),
        "east": (east, south - depth, east + depth, north + depth),
        "south": (west - depth, south - depth, east + depth, south),
        "north": (west - depth, north, east + depth, north + depth),
    }
    for name, (left, bottom, right, top) in walls.items():
        box = [(left, bottom), (right, bottom), (right, top), (left, top)]
        _add_solid(space, contacts, pymunk.Poly(space.static_body, box), WALL, f"wall {name}")
    for index, (x, y, radius) in enumerate(obstacles):
        circle = pymunk.Circle(space.static_body, radius, (x, y))
        _add_solid(space, contacts, circle, OBSTACLE, f"obstacle {index}")
    for index, corners in enumerate(polygons):
        polygon = pymunk.Poly(space.static_body, corners)
        _add_solid(space, contacts, polygon, OBSTACLE, f"polygon {index}")


def _add_solid(space: pymunk.Space, contacts: ContactCounter, shape: pymunk.Shape, kind: int, name: str) -> None:
    shape.friction, shape.collision_type = 0.6, kind
    contacts.name(shape, name)
    space.add(shape)


_FEET = 0.45
"""Distance of the feet from the centre, as a share of the side: under the middle of each edge. Under the corners
friction would be 10 % too small: an impulse that stops a corner also turns the body, so that the clipped force is not
parallel to the motion."""
_STIFF = 1e-9
"""Share of a joint's position error that remains after one second."""


class TowedBody:
    """A load in a pymunk space, hitched to the car until ``unhitch``.

    Ground friction: each of four feet has a joint to the floor with a force of at most mass deceleration / 4 in any
    direction. This is Coulomb friction that sticks, slides and resists turning, solved together with the hitch. In
    addition, the runners resist lateral slip, like a tyre without drive.
    """

    def __init__(self, space: pymunk.Space, car: pymunk.Body, hitch: tuple[float, float], load: Load) -> None:
        self.load = load
        self._space = space
        self.body, self.shape = _body_behind(car, hitch, load)
        self._handle = self.body._body
        grip = self.body.mass * load.grip
        self._hold = -sqrt(grip * grip)
        """N; the largest force of the runners, negative because it opposes the slip."""
        space.add(self.body, self.shape)
        arm = _FEET * load.side
        for position in ((arm, 0.0), (-arm, 0.0), (0.0, arm), (0.0, -arm)):
            space.add(_foot(self.body, space.static_body, position, load))
        # Beyond this angle the load's near edge would touch the car's back, so the hitch has its stop there.
        stop = pi / 2 - atan(load.side / 2 / load.drawbar)
        pivot = pymunk.PivotJoint(car, self.body, hitch, (load.length, 0.0))
        limit = pymunk.RotaryLimitJoint(car, self.body, -stop, stop)
        for joint in (pivot, limit):
            joint.error_bias = _STIFF
            joint.collide_bodies = False
        self._joints: tuple[pymunk.Constraint, ...] = (pivot, limit)
        space.add(*self._joints)

    @property
    def hitch_error(self) -> float:
        """Distance between the two halves of the hitch [m]; 0 when unhitched."""
        for joint in self._joints:
            if isinstance(joint, pymunk.PivotJoint):
                return (joint.a.local_to_world(joint.anchor_a) - joint.b.local_to_world(joint.anchor_b)).length
        return 0.0

    @property
    def pose(self) -> tuple[float, float, float, float, float]:
        """x, y [m] of the centre, yaw [rad], length and width [m]."""
        position, side = _position(self._handle), self.load.side
        return position.x, position.y, _angle(self._handle), side, side

    def apply_runners(self) -> None:
        """Sets the runners' force for the next substep."""
        handle = self._handle
        velocity = _velocity(handle)
        _set_force(handle, runner_force(_angle(handle), velocity.x, velocity.y, self._hold))

    def unhitch(self) -> None:
        """Unhitches the load; it slides to rest and remains as an obstacle that the car can hit."""
        self._space.remove(*self._joints)
        self._joints = ()


def _body_behind(car: pymunk.Body, hitch: tuple[float, float], load: Load) -> tuple[pymunk.Body, pymunk.Poly]:
    """Returns the body of a load straight behind the car, moving with the car."""
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


def _foot(body: pymunk.Body, floor: pymunk.Body, position: tuple[float, float], load: Load) -> pymunk.Constraint:
    joint = pymunk.PivotJoint(body, floor, position, (0.0, 0.0))
    joint.max_bias = 0.0  # no position correction: the joint is friction, not a peg
    joint.max_force = body.mass * load.deceleration / 4
    return joint
