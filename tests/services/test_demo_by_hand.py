"""The demonstration where it ends before anything was driven."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_services.command_line.demo import _Demonstration


def test_one_that_ended_before_its_robot_was_started_has_nothing_to_report() -> None:
    plan: Any = None
    stop: Any = None
    with pytest.raises(SafedpaError, match="ended before the robot was started; nothing was driven"):
        _Demonstration(plan, stop, {"seed": 1, "picture": None}).result({"changed": 0})


SUMMARY = {"robot_seconds": 61.0, "goals_reached": 4, "collisions": 0, "standstills": [], "recording": "a.mcap"}


def ended(taken: float | None, fall: float | None, *, photographed: bool, trouble: str) -> dict[str, Any]:
    """What is told of a drive whose model was mended at ``taken`` [s], or never, and whose error fell so far."""
    nobody: Any = None
    made = _Demonstration(nobody, nobody, {"seed": 1, "picture": "page.png"})
    told = SimpleNamespace(taken=taken, fall=fall)
    story: Any = SimpleNamespace(told=told, document=lambda: {"fall": fall}, report=None)
    made.story = story
    if photographed:
        made._picture = threading.Thread()
    made._trouble = trouble
    made.plan = SimpleNamespace(folder=None)  # type: ignore[assignment]
    return made.result({"changed": 9.0, **SUMMARY})


@pytest.mark.parametrize(
    ("photographed", "trouble", "picture"),
    [(True, "", "page.png"), (True, "page.png: no picture could be made", ""), (False, "", ""), (False, "no page", "")],
)
def test_a_picture_is_told_of_where_it_was_made_and_what_went_wrong_is_the_failure(
    photographed: bool, trouble: str, picture: str
) -> None:
    found = ended(30.0, 0.9, photographed=photographed, trouble=trouble)
    assert (found["picture"], found["failure"]) == (picture, trouble)


@pytest.mark.parametrize(
    ("taken", "fall", "failure"),
    [
        (30.0, 0.9, ""),
        (None, None, "the model was not changed"),
        (30.0, None, "ended before the error"),
        (30.0, 0.01, "the error fell by 1 %"),
    ],
)
def test_a_demonstration_that_does_not_mend_the_model_has_failed(
    taken: float | None, fall: float | None, failure: str
) -> None:
    """With or without a picture of it."""
    found = ended(taken, fall, photographed=True, trouble="")
    assert failure in found["failure"]
    assert bool(found["failure"]) is bool(failure)
    assert (found["seed"], found["goals_reached"], found["changed"]) == (1, 4, 9.0)
