"""Diagnostics and markers of the gateway: which verdicts have a path, and how often."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import pytest
from tests.messages import verdict_of

from safedpa.robots.car.adapters.ros import CarFace
from safedpa_services.ros_gateway.gateway import HealthPublisher

STATES = ((1.0, 2.0, 0.5, 0.1), (1.5, 2.5, 0.5, 0.1))


class Heard:
    def __init__(self) -> None:
        self.messages: list[Mapping[str, Any]] = []

    def put(self, values: Mapping[str, Any]) -> None:
        self.messages.append(values)


class Reported:
    """A publisher with a clock that the test sets, and its messages."""

    def __init__(self, diagnostics: bool = True, markers: bool = True) -> None:
        self.now, self.diagnostics, self.markers = 100.0, Heard(), Heard()
        self.health_publisher = HealthPublisher(
            "r1",
            "odom",
            CarFace(),
            self.diagnostics if diagnostics else None,  # type: ignore[arg-type]
            self.markers if markers else None,  # type: ignore[arg-type]
            lambda: self.now,
        )

    def hears(self, predicted: tuple[tuple[float, ...], ...], at: float = 100.0) -> None:
        self.now = at
        reported = {"nominal": (0.6, 0.1), "sentence": "corrected", "h_now": 0.25, "margin": 0.05, "active": ("box",)}
        self.health_publisher.verdict(verdict_of("corrected", action=(0.5, 0.1), **reported, predicted=predicted))

    @property
    def paths(self) -> list[list[tuple[float, float]]]:
        markers = [marker for message in self.markers.messages for marker in message["markers"]]
        return [[(point["x"], point["y"]) for point in marker["points"]] for marker in markers]


def test_the_predicted_path_of_a_verdict_is_published_in_the_frame_of_the_surroundings() -> None:
    reported = Reported()
    reported.hears(STATES)
    assert reported.paths == [[(1.0, 2.0), (1.5, 2.5)]]
    assert reported.markers.messages[0]["markers"][0]["header"]["frame_id"] == "odom"


@pytest.mark.parametrize("predicted", [(), ((1.0,),), ((1.0, 2.0, 0.5, 0.1), ())])
def test_without_a_path_of_its_own_model_only_the_verdict_is_published(predicted: tuple[tuple[float, ...], ...]):
    reported = Reported()
    reported.hears(predicted)
    assert not reported.markers.messages
    assert [message["status"][0]["message"] for message in reported.diagnostics.messages] == ["corrected"]


def test_a_verdict_without_a_path_does_not_delay_the_next_marker() -> None:
    reported = Reported()
    reported.hears((), 100.0)
    reported.hears(STATES, 100.01)
    assert len(reported.paths) == 1


def test_paths_are_drawn_ten_times_a_second_and_every_verdict_is_published() -> None:
    """Two seconds with fifty verdicts per second, with times of actual arrival."""
    reported = Reported()
    drawn = []
    for tick in range(100):
        before = len(reported.paths)
        reported.hears(STATES, 100.0 + 0.02 * tick + 1e-6 * (tick % 3))
        drawn += [reported.now] if len(reported.paths) > before else []
    assert len(reported.diagnostics.messages) == 100
    assert 16 <= len(drawn) <= 20
    assert all(0.1 <= later - earlier < 0.13 for earlier, later in pairwise(drawn))


@pytest.mark.parametrize("diagnostics", [True, False])
@pytest.mark.parametrize("markers", [True, False])
def test_topics_that_the_file_does_not_name_are_not_published(diagnostics: bool, markers: bool) -> None:
    reported = Reported(diagnostics, markers)
    reported.hears(STATES)
    reported.health_publisher.gateway("", {"tick": "3"})
    reported.health_publisher.gateway("no action came", {"tick": "4"})
    assert len(reported.paths) == markers
    levels = [message["status"][0]["level"] for message in reported.diagnostics.messages]
    assert levels == ([0, 0, 2] if diagnostics else [])


@pytest.mark.parametrize("nanoseconds", [1_700_000_000_123_456_789, 1])
def test_a_header_has_the_given_time(nanoseconds: int) -> None:
    stamp = Reported().health_publisher.head(nanoseconds)["stamp"]
    assert (stamp["sec"], stamp["nanosec"]) == divmod(nanoseconds, 10**9)
    assert Reported().health_publisher.head()["stamp"]["sec"] > 1_700_000_000
