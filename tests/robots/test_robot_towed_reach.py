"""Where a load is that was pushed: within what the robot says of it, whatever was driven before."""

from __future__ import annotations

from math import cos, hypot, sin

import numpy as np
import pytest

from safedpa_sim.robots import LOADS, CarRobot, CarWorld, Scene, footprint
from safedpa_sim.robots.footprint import towed_reach

PERIOD = 0.05


def programme(kind: str, seed: int, ticks: int) -> list[tuple[float, float]]:
    """Random stretches of forwards and backwards that turn the load about, after a second straight ahead."""
    draw, actions = np.random.default_rng([seed, len(kind)]), [(1.0, 0.0)] * 20
    speeds = {"rocking": (-0.6, 0.8), "mixed": (-0.6, -0.6, 0.6, 1.8), "backwards": (-0.6, -0.6, -0.6, 1.2)}[kind]
    longest = {"rocking": 24, "mixed": 50, "backwards": 120}[kind]
    while len(actions) < ticks:
        stretch = int(draw.integers(5, longest))
        actions += [(float(draw.choice(speeds)), float(draw.choice((-0.34, 0.34))))] * stretch
    return actions[:ticks]


class Claimed:
    """The regions that the line and the disc around the hitch have claimed so far, and how far the load leaves them."""

    def __init__(self, load: str) -> None:
        self.load, self.world = LOADS[load], CarWorld((0.0, 0.0, 0.0), (-200.0, 200.0, -200.0, 200.0), (), LOADS[load])
        self.rear, self.front, self.radius = footprint(self.load)
        self.begin, self.end, self.reach = towed_reach(self.load)
        self.way = self.end  # unknown at the start
        self.hitches: list[tuple[float, float, float]] = []
        self.lines: list[tuple[float, float, float, float]] = []
        self.claim()

    def claim(self) -> None:
        x, y, yaw, _ = self.world.state
        c, s = cos(yaw), sin(yaw)
        share = min(max((self.way - self.begin) / (self.end - self.begin), 0.0), 1.0)
        self.hitches.append((x - self.rear * c, y - self.rear * s, self.radius + share * (self.reach - self.radius)))
        self.lines.append((x - self.rear * c, y - self.rear * s, x + self.front * c, y + self.front * s))

    def drive(self, action: tuple[float, float]) -> float:
        """One period; by how much the load's farthest point lies outside of everything claimed [m]."""
        x, y, yaw, _ = self.world.state
        self.world.advance(*action, PERIOD)
        now_x, now_y, _, _ = self.world.state
        self.way -= cos(yaw) * (now_x - x) + sin(yaw) * (now_y - y)
        self.way = min(max(self.way, 0.0), self.end)
        self.claim()
        assert self.world.towed is not None
        points = [self.world.towed.body.local_to_world(v) for v in self.world.towed.shape.get_vertices()]
        return max(self.outside(*point) for point in points)

    def outside(self, x: float, y: float) -> float:
        discs, lines = np.array(self.hitches), np.array(self.lines)
        along = lines[:, 2:] - lines[:, :2]
        apart = np.array((x, y)) - lines[:, :2]
        share = np.clip((apart * along).sum(1) / (along**2).sum(1), 0.0, 1.0)
        to_line = np.hypot(*(apart - share[:, np.newaxis] * along).T).min() - self.radius
        return float(min(to_line, (np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2]).min()))


@pytest.mark.long
@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("kind", ["rocking", "mixed", "backwards"])
def test_a_load_that_is_pushed_about_stays_within_what_is_claimed_for_it(load: str, kind: str) -> None:
    worst = -1.0
    for seed in range(4):
        claimed = Claimed(load)
        worst = max(worst, *(claimed.drive(action) for action in programme(kind, 4000 + seed, 240)))
    assert worst <= 0.005, "m; beyond it the clearance of 5 cm begins"


def test_without_the_growth_a_pushed_load_leaves_what_is_claimed() -> None:
    worst = -1.0
    for seed in range(4):
        claimed = Claimed("box")
        claimed.reach = claimed.radius
        worst = max(worst, *(claimed.drive(action) for action in programme("backwards", 4000 + seed, 240)))
    assert worst > 0.05


def test_the_reach_is_that_of_the_farthest_corner() -> None:
    for load in LOADS.values():
        begin, end, reach = towed_reach(load)
        assert 0.0 <= reach - hypot(load.drawbar + load.side, load.side / 2) < 0.01
        assert 0.0 < begin < end < reach
    assert towed_reach(None) == ()


def test_the_robot_tells_what_it_tows_while_it_does() -> None:
    robot = CarRobot(Scene.random(1, "box"), PERIOD)
    assert robot.state_message().towed == towed_reach(LOADS["box"])
    robot.unhitch()
    assert robot.state_message().towed == ()
    robot.hitch(LOADS["chair"])
    assert robot.state_message().towed == towed_reach(LOADS["chair"])
