"""The three services of a fleet in one process: the same decisions, the robots shared, the whole thing for real."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa_lab.benchmarks.fleet import FleetTrial, fleet_benchmark
from safedpa_services.stack.__main__ import assigned_robots

Make = Callable[..., Any]


def test_in_one_process_every_trajectory_is_the_same(stack: Make, undisturbed: dict[str, str]) -> None:
    fleet = stack(tuple(undisturbed), joint=("latent", "nominal"))
    fleet.drive(2.0)
    assert fleet.fleet.late == 0
    assert {name: car.trajectory_hash for name, car in fleet.cars.items()} == undisturbed


@given(robot=st.text(min_size=1), of=st.integers(1, 9))
def test_every_robot_is_served_by_exactly_one_stack(robot: str, of: int) -> None:
    assert sum(assigned_robots(f"{number}/{of}")(robot) for number in range(1, of + 1)) == 1


def test_the_shares_of_a_fleet_are_alike() -> None:
    names = [f"car{index:04d}" for index in range(200)]
    shares = [sum(map(assigned_robots(f"{number}/2"), names)) for number in (1, 2)]
    assert sum(shares) == 200
    assert min(shares) >= 80


@pytest.mark.parametrize("share", ["", "1", "0/2", "3/2", "a/b", "1/0", "-1/2", "1/2/3"])
def test_a_malformed_share_is_refused(share: str) -> None:
    with pytest.raises(InputError, match="wanted NUMBER/COUNT"):
        assigned_robots(share)


@pytest.mark.long
@pytest.mark.processes
def test_two_stacks_drive_ten_robots_in_batches() -> None:
    result = fleet_benchmark(FleetTrial(robots=10, seconds=2.0, loads="none,box", stacks=2))
    assert set(result["processes"]) == {"robots", "stack_1", "stack_2"}
    assert result["robot_ticks"] > 200, "they stood most of the time"
    assert result["late_ticks"] < result["robot_ticks"], "not one action came in time"
    assert result["collision_list"] == []
