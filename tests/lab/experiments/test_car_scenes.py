"""The scenes of the car experiment are what its docs say."""

from __future__ import annotations

from math import hypot, pi
from pathlib import Path

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import FilterSettings
from safedpa_lab.experiments.car_orders import FIRST_SEEDS, earnest_orders, hitching_orders, open_orders
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS, car_scene

SEEDS = range(25)


@pytest.mark.parametrize("load", CONFIGURATIONS)
def test_start_goal_and_obstacles_are_as_declared(load):
    for seed in SEEDS:
        scene = car_scene(seed, load)
        x, y, yaw = scene.start
        assert abs(x) <= 0.2
        assert y == -2.0
        assert abs(yaw - pi / 2) <= 0.3
        assert next(scene.goals()) == (0.0, 2.0)
        assert scene.field == (-4.0, 4.0, -4.0, 4.0)
        assert 3 <= len(scene.obstacles) <= 5
        assert all(0.2 <= radius <= 0.35 and abs(ox) <= 2.2 and abs(oy) <= 1.2 for ox, oy, radius in scene.obstacles)


@pytest.mark.parametrize("load", CONFIGURATIONS)
def test_the_footprint_fits_through_every_passage_and_start_and_goal_are_free(load):
    for seed in SEEDS:
        scene = car_scene(seed, load)
        _, front, radius = scene.footprint
        gap = 2 * radius + 0.4
        nose = scene.start[0] + front * np.cos(scene.start[2]), scene.start[1] + front * np.sin(scene.start[2])
        for index, (x, y, size) in enumerate(scene.obstacles):
            assert 4.0 - abs(x) - size >= gap
            assert all(hypot(x - a, y - b) >= gap + size + other for a, b, other in scene.obstacles[:index])
            assert all(hypot(x - a, y - b) >= size + radius + 0.35 for a, b in (scene.start[:2], nose, (0.0, 2.0)))


@pytest.mark.parametrize("load", CONFIGURATIONS)
def test_an_obstacle_blocks_the_straight_way(load):
    for seed in SEEDS:
        scene = car_scene(seed, load)
        x, y, size = scene.obstacles[0]
        way = scene.start[0] * (1.0 - (y + 2.0) / 4.0)
        assert abs(x - way) <= size + scene.footprint[2]


def test_a_seed_is_a_scene_and_seeds_differ():
    assert car_scene(5, "box") == car_scene(5, "box")
    assert len({car_scene(seed).obstacles for seed in SEEDS}) == len(SEEDS)
    assert {len(car_scene(seed, passage=0.05).obstacles) for seed in SEEDS} == {3, 4, 5}


def test_an_unknown_load_is_refused():
    with pytest.raises(InputError, match="did you mean 'chair'"):
        car_scene(0, "chiar")


def test_no_seed_serves_two_ends():
    loads = tuple(CONFIGURATIONS)
    earnest = [earnest_orders(loads, 20, kind, "physics", Path(), FilterSettings()) for kind in ("margin", "fresh")]
    opened = [open_orders(loads, 20, 400, kind) for kind in ("errors", "latent")]
    kinds = [*earnest, *opened, hitching_orders(loads, 20, 400)]
    seeds = [{order.seed for order in orders} for orders in kinds]
    assert sum(len(own) for own in seeds) == len(set().union(*seeds))
    assert min(set().union(*seeds)) >= min(FIRST_SEEDS.values()) > 1000


def test_a_hitching_drive_begins_and_ends_without_load():
    for order in hitching_orders(tuple(CONFIGURATIONS), 2, 400):
        (hitched, load), (released, nothing) = order.events
        assert order.load == nothing == "none"
        assert load != "none"
        assert 50 < hitched < released < 400 - 50
