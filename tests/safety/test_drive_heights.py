"""The errors of h along a recorded drive: which steps count, and what a believable history of a drive holds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, SETTINGS, latent_at, state_at

from safedpa.live.finding import History
from safedpa.safety.drive_heights import DrivenTick, drive_heights

ALL = range(1, 6)


def drive(**changed: Any) -> list[DrivenTick]:
    """Six ticks of a car that drives straight on at 0.5 m/s; ``changed`` is what is different at the third."""
    ticks = []
    for tick in range(6):
        state = state_at(tick, (0.025 * tick, 0.0, 0.0, 0.5), applied=(0.5, 0.0))
        ticks.append(DrivenTick(state, latent_at(state)))
    latent = ticks[3].latent if changed.pop("adapted", True) else None
    ticks[3] = DrivenTick(replace(ticks[3].state, **changed), latent)
    return ticks


def reached(ticks: list[DrivenTick]) -> list[int]:
    """Ticks whose measured h was compared with a prediction; the car comes 0.025 m nearer to the wall in each."""
    found = drive_heights(CAR, SETTINGS, ticks)["obstacle"]
    assert found.shape[1] == 4
    first = drive_heights(CAR, SETTINGS, drive())["obstacle"][0, 1]
    return [round(1 + (first - measured) / 0.025) for measured in found[:, 1]]


@pytest.mark.parametrize(
    ("changed", "counted"),
    [
        ({}, [1, 2, 3, 4, 5]),
        ({"applied_by": "watchdog"}, [1, 2, 4, 5]),
        ({"applied_by": "none"}, [1, 2, 4, 5]),
        ({"tick": 7}, [1, 2, 5]),
        ({"goal": ()}, [1, 2, 3, 4, 5]),
        ({"adapted": False}, [1, 2, 3, 4, 5]),
        ({"footprint": ()}, [1, 2, 5]),
    ],
    ids=str,
)
def test_only_steps_under_the_filters_own_action_count(changed: dict[str, Any], counted: list[int]) -> None:
    assert reached(drive(**changed)) == counted


def test_what_the_recorded_action_leads_to_is_compared_with_what_came() -> None:
    heights = drive_heights(CAR, SETTINGS, drive())
    assert set(heights) >= {"obstacle", "speed"}
    np.testing.assert_allclose(heights["obstacle"][:, 0], heights["obstacle"][:, 1], atol=1e-9)
    faster = [tick._replace(state=replace(tick.state, applied=(1.5, 0.0))) for tick in drive()]
    hoped, came = drive_heights(CAR, SETTINGS, faster)["obstacle"][:, :2].T
    assert (hoped < came - 1e-3).all(), "a car that is told to drive faster is expected nearer to the wall"


def test_without_ticks_there_are_no_errors() -> None:
    assert drive_heights(CAR, SETTINGS, []) == {}
    assert drive_heights(CAR, SETTINGS, [DrivenTick(tick.state, None) for tick in drive()]) == {}


@pytest.mark.parametrize(
    ("state", "applied", "kept"),
    [
        ((0.0, 0.0, 0.0, 0.5), (0.1, 0.1), True),
        ((0.0, 0.0, 0.0, 1e6), (0.1, 0.1), False),
        ((np.nan, 0.0, 0.0, 0.5), (0.1, 0.1), False),
        ((0.0, 0.0, 0.0, 0.5), (np.nan, 0.1), False),
        ((0.0, 0.0, 0.0, 0.5), (0.1, -np.inf), False),
    ],
)
def test_a_tick_that_cannot_be_believed_leaves_a_gap_in_the_history_of_a_drive(
    state: tuple[float, ...], applied: tuple[float, ...], kept: bool
) -> None:
    history = History(CAR.system, 0.05, longest=0.15)
    history.add(7, np.array(state), np.array(applied))
    assert [tick for tick, *_ in history.last(10.0)] == ([7] if kept else [])
    assert history.seconds_since(7) == pytest.approx(0.05 if kept else 0.0)
    assert history.seconds_since(8) == 0.0
    for tick in (8, 9, 10):  # three rows at most: the oldest one goes
        history.add(tick, np.zeros(4), np.zeros(2))
    assert [[tick for tick, *_ in history.last(seconds)] for seconds in (10.0, 0.1, 0.0)] == [[8, 9, 10], [9, 10], [10]]
