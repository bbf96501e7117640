"""The world of the pymunk car: one rigid body with tyres, what it tows, and solid things, seen from above."""

from __future__ import annotations

from math import ceil, cos, sin, tanh
from typing import Any

import pymunk

from safedpa_sim.robots.actuators import SpeedServo, SteeringActuator
from safedpa_sim.robots.car_parameters import CAR_PARAMETERS, GRAVITY, SUBSTEP, CarParameters
from safedpa_sim.robots.contacts import CAR, OBSTACLE, WALL, Collision, ContactCounter
from safedpa_sim.robots.loads import Load
from safedpa_sim.robots.towing import TowedBody
from safedpa_sim.robots.tyres import axle_force

__all__ = ["CarWorld"]

_set_force: Any = pymunk.Body.force.fset  # type: ignore[attr-defined]
_set_torque: Any = pymunk.Body.torque.fset  # type: ignore[attr-defined]
"""As ``body.force = ...``, without pymunk's look at the attribute's name, which costs as much as the setting."""

_ROLLING_SPEED = 0.02
"""m/s below which rolling resistance fades, so that it cannot push a standing car."""
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
        yaw, (x, y), (vx, vy) = self.body.angle, self.body.position, self.body.velocity
        offset = self.parameters.centre_of_mass
        return x - offset * cos(yaw), y - offset * sin(yaw), yaw, vx * cos(yaw) + vy * sin(yaw)

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
        for _ in range(substeps):
            self._substep(target_speed, steer, seconds / substeps)

    def _substep(self, target_speed: float, steer: float, seconds: float) -> None:
        body = self.body
        yaw, (vx, vy) = body.angle, body.velocity
        cosine, sine = cos(yaw), sin(yaw)
        forward, sideways = vx * cosine + vy * sine, vy * cosine - vx * sine
        drive = self.servo.advance(target_speed, forward, seconds)
        angle = self.steering.advance(steer + self.steering_offset, seconds)
        along, across, torque = self._ground_forces(forward, sideways, drive, angle)
        mass, (east, north) = self.parameters.mass, self.wind
        across_east, across_north = across * sine, across * cosine
        _set_force(body, (along * cosine - across_east + mass * east, along * sine + across_north + mass * north))
        _set_torque(body, torque)
        for load in self._loads:
            load.apply_runners()
        self.time += seconds
        self.contacts.time = self.time
        self.space.step(seconds)

    def _ground_forces(self, forward: float, sideways: float, drive: float, steer: float) -> tuple[float, float, float]:
        """Force along and across the car [N] and torque [N m] about its centre of mass, from tyres and air."""
        car, rate = self.parameters, self.body.angular_velocity
        to_rear, to_front = car.centre_of_mass, car.wheelbase - car.centre_of_mass
        shift = drive * car.centre_height / GRAVITY
        share_front = (to_rear - shift) / car.wheelbase
        share_front = 0.0 if share_front < 0.0 else 1.0 if share_front > 1.0 else share_front
        force, limit = car.mass * drive, car.mass * GRAVITY * car.friction
        front_sideways = sideways + rate * to_front
        cosine, sine = cos(steer), sin(steer)
        front_x, front_y = axle_force(
            forward * cosine + front_sideways * sine,
            front_sideways * cosine - forward * sine,
            force * share_front,
            limit * share_front,
            car.front_slip,
            car.slip_speed,
        )
        rear_x, rear_y = axle_force(
            forward,
            sideways - rate * to_rear,
            force * (1.0 - share_front),
            limit * (1.0 - share_front),
            car.rear_slip,
            car.slip_speed,
        )
        resistance = car.mass * (car.rolling * tanh(forward / _ROLLING_SPEED) + car.drag * abs(forward) * forward)
        turned_x, turned_y = front_x * cosine - front_y * sine, front_x * sine + front_y * cosine
        return turned_x + rear_x - resistance, turned_y + rear_y, turned_y * to_front - rear_y * to_rear


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
