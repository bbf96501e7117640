"""The world of the pymunk car: one rigid body with tyres, what it tows, and solid things, seen from above."""

from __future__ import annotations

from math import ceil, cos, sin

import pymunk
from pymunk._chipmunk_cffi import lib

from safedpa_sim.robots.actuators import SpeedServo, SteeringActuator
from safedpa_sim.robots.car_parameters import CAR_PARAMETERS, SUBSTEP, CarParameters
from safedpa_sim.robots.contacts import CAR, OBSTACLE, WALL, Collision, ContactCounter
from safedpa_sim.robots.ground_forces import ground_forces
from safedpa_sim.robots.loads import Load
from safedpa_sim.robots.towing import TowedBody

__all__ = ["CarWorld"]

_angle, _position = lib.cpBodyGetAngle, lib.cpBodyGetPosition
_velocity, _rate = lib.cpBodyGetVelocity, lib.cpBodyGetAngularVelocity
_set_force, _set_torque, _step = lib.cpBodySetForce, lib.cpBodySetTorque, lib.cpSpaceStep
"""What pymunk's own ``body.angle``, ``space.step`` and so on call, without what stands around it: a substep asks for
little, and its housekeeping for bodies that are added or removed within a step concerns nothing here."""

_WALL_THICKNESS = 0.2
"""m; more than the car moves in a substep by far, so that it cannot pass through."""


class CarWorld:
    """Steps the physics; every number is a float, in SI units and radians, in the frame of the field."""

    def __init__(
        self,
        start: tuple[float, float, float],
        field: tuple[float, float, float, float],
        obstacles: tuple[tuple[float, float, float], ...] = (),
        load: Load | None = None,
        parameters: CarParameters = CAR_PARAMETERS,
    ) -> None:
        self.parameters = parameters
        self.time = 0.0
        self.servo = SpeedServo(parameters)
        self.steering = SteeringActuator(parameters)
        self.space = pymunk.Space()
        self.space.collision_slop = 0.0005  # m; the default of 0.1 is meant for pixels
        self.contacts = ContactCounter(self.space)
        _add_solids(self.space, self.contacts, field, obstacles)
        self.body = self._add_car(start)
        self._handle = self.body._body
        self._ground_forces = ground_forces(parameters)
        self.wind = (0.0, 0.0)
        """Push of a steady wind over the car's mass, m/s2 along the field's x and y."""
        self.steering_offset = 0.0
        """rad by which the steering actuator misunderstands every command."""
        self.towed: TowedBody | None = None
        self._loads: list[TowedBody] = []
        if load is not None:
            self.hitch(load)

    def _add_car(self, start: tuple[float, float, float]) -> pymunk.Body:
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
        return body

    @property
    def state(self) -> tuple[float, float, float, float]:
        """x, y [m], yaw [rad] (not wrapped) and forward speed [m/s] of the middle of the rear axle."""
        handle, offset = self._handle, self.parameters.centre_of_mass
        yaw, place, velocity = _angle(handle), _position(handle), _velocity(handle)
        cosine, sine = cos(yaw), sin(yaw)
        return place.x - offset * cosine, place.y - offset * sine, yaw, velocity.x * cosine + velocity.y * sine

    @property
    def collisions(self) -> list[Collision]:
        """Every collision so far, in order."""
        return self.contacts.collisions

    def hitch(self, load: Load) -> None:
        """Puts a load behind the car, straight and at the car's speed; a load that hangs there is let go first.

        The place behind the car must be free: what stands there is pushed away by the contact.
        """
        self.unhitch()
        car = self.parameters
        self.towed = TowedBody(self.space, self.body, (-car.rear - car.centre_of_mass, 0.0), load)
        self._loads.append(self.towed)
        self.contacts.name(self.towed.shape, "load")

    def unhitch(self) -> None:
        """Lets go what the car tows, if anything; it stays in the world."""
        if self.towed is not None:
            self.towed.unhitch()
            self.towed = None

    def advance(self, target_speed: float, steer: float, seconds: float) -> None:
        """Holds an action for ``seconds``, in equal substeps of at most 1/400 s."""
        substeps = ceil(seconds / SUBSTEP - 1e-9)
        if substeps <= 0:
            return
        pace, now, mass, (east, north) = seconds / substeps, self.time, self.parameters.mass, self.wind
        space, handle, loads, contacts = self.space._space, self._handle, self._loads, self.contacts
        servo, forces = self.servo, self._ground_forces
        gain, limit, share, drive = servo.gain, servo.limit, servo.share(pace), servo.acceleration
        for angle in self.steering.angles(steer + self.steering_offset, pace, substeps):
            yaw, velocity = _angle(handle), _velocity(handle)
            cosine, sine = cos(yaw), sin(yaw)
            vx, vy = velocity.x, velocity.y
            forward, sideways = vx * cosine + vy * sine, vy * cosine - vx * sine
            wanted = gain * (target_speed - forward)  # SpeedServo.advance, written out
            drive += ((-limit if wanted < -limit else limit if wanted > limit else wanted) - drive) * share
            along, across, torque = forces(forward, sideways, _rate(handle), drive, angle)
            to_east = along * cosine - across * sine + mass * east
            _set_force(handle, (to_east, along * sine + across * cosine + mass * north))
            _set_torque(handle, torque)
            for load in loads:
                load.apply_runners()
            now += pace
            contacts.time = now
            _step(space, pace)
        self.time, servo.acceleration = now, drive


def _add_solids(
    space: pymunk.Space,
    contacts: ContactCounter,
    field: tuple[float, float, float, float],
    obstacles: tuple[tuple[float, float, float], ...],
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


def _add_solid(space: pymunk.Space, contacts: ContactCounter, shape: pymunk.Shape, kind: int, name: str) -> None:
    shape.friction, shape.collision_type = 0.6, kind
    contacts.name(shape, name)
    space.add(shape)
