"""What another filter is shown of a recorded drive."""

from typing import Any

import pytest

from safedpa.bus import ACTION, ActionMessage, StateMessage
from safedpa.replay.what_if import _Hypothetical


def stamp(tick: int, epoch: int = 3) -> dict[str, Any]:
    return {"epoch": epoch, "tick": tick, "robot_time": 0.5 * tick, "publish_time": 7.0}


def state_of(tick: int, applied: tuple[float, ...], epoch: int = 3) -> StateMessage:
    return StateMessage(
        **stamp(tick, epoch), values=(0.0, 0.0, 0.0, 1.0), applied=applied, applied_by="filter", period=0.5,
        lockstep=True, goal=(), obstacles=(), field=(-4.0, 4.0, -4.0, 4.0), footprint=(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("action", "applied", "obeyed"),
    [
        (None, (1.0, 0.0), True),
        ((1.0, 0.0), (1.0, 0.0), True),
        ((1.0, 0.5), (1.0, 0.0), False),
        ((1.0,), (1.0, 0.0), True),
        ((1.0,), (1.0, 0.5), False),
        ((), (), True),
    ],
)
def test_a_filter_sees_whether_the_robot_applied_its_action_of_the_tick_before(action, applied, obeyed):
    shown = _Hypothetical({})
    if action is not None:
        shown.done(state_of(6, (1.0, 0.0)), {ACTION: ActionMessage(**stamp(6), values=action)})
    assert shown.state(state_of(7, applied)).applied_by == ("filter" if obeyed else "recorded")
    assert shown.state(state_of(8, applied)).applied_by == "filter", "of two ticks before"
    assert shown.state(state_of(7, applied, epoch=4)).applied_by == "filter", "in another epoch"
