"""Shared by the dashboard's tests: a marker, display settings, a synthetic drive."""

import math
from collections.abc import Callable, Iterator

import pytest
from tests.messages import health_of, latent_of, stamp, state_of, verdict_of

from safedpa.bus import HEALTH, LATENT, STATE, VERDICT, Message, Topic
from safedpa.dynamics import load_model
from safedpa.safety import FilterSettings
from safedpa_services.dashboard.display_settings import DisplaySettings, display_settings

Tick = list[tuple[Topic, Message]]
PERIOD = 0.05


@pytest.fixture(scope="session")
def look() -> DisplaySettings:
    """Display settings of the car."""
    return display_settings(load_model("car"), FilterSettings.for_robot("car"))


@pytest.fixture(scope="session")
def tick_of() -> Callable[..., Tick]:
    """Returns all messages of tick k of a car on a circle of 3 m."""
    return _tick


@pytest.fixture(scope="session")
def drive() -> Callable[[int], Iterator[Tick]]:
    """Returns the messages of the first ticks."""
    return lambda count: (_tick(k) for k in range(count))


def _pose(k: int) -> tuple[float, float, float, float]:
    angle = 0.02 * k
    return 3.0 * math.cos(angle), 3.0 * math.sin(angle), angle + 0.5 * math.pi, 1.2


def _tick(k: int, *, epoch: int = 7, applied_by: str = "filter", status: str = "") -> Tick:
    now = stamp(k, PERIOD, epoch)
    status = status or ("corrected" if k % 100 >= 80 else "passed")
    state = state_of(
        *_pose(k), **now, applied=(1.2, 0.1), applied_by=applied_by, goal=(1.0, 2.0),
        obstacles=((0.5, 0.5, 0.3), (-2.0, 1.0, 0.25)), footprint=(0.6, 0.4, 0.15),
        load_pose=(_pose(k)[0], _pose(k)[1] - 0.5, 0.0, 0.3, 0.3),
    )  # fmt: skip
    latent = latent_of(0.4 + 0.001 * k, 2.5, **now, deviations=(0.1, 0.3))
    verdict = verdict_of(
        status, **now, sentence=f"The nominal action was {status}.", action=(1.2, 0.1), nominal=(1.4, 0.05),
        active=("obstacle 0",), h_now=0.5 + 0.3 * math.sin(0.1 * k), h_next=0.5 + 0.3 * math.sin(0.1 * (k + 1)),
        margin=0.02, solver="solved", microseconds=300.0, predicted=tuple(_pose(k + step) for step in range(1, 11)),
    )  # fmt: skip
    services = ("robot", "adaptation", "policy", "safety_filter")
    health = [health_of(name, **now, step_microseconds=300.0 + k) for name in services]
    return [(STATE, state), (LATENT, latent), (VERDICT, verdict), *((HEALTH, message) for message in health)]
