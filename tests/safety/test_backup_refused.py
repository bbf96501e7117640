"""A backup that could never act is refused when the filter is made, not found out when it is needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter

SETTINGS = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), epsilon=0.0)


def made(backup: Any) -> SafetyFilter:
    return SafetyFilter(lambda x: (x, np.eye(2)), [FunctionBarrier(lambda x: 5.0 - x[0])], SETTINGS, backup=backup)


@pytest.mark.parametrize(
    "backup",
    [np.array([0.5, -0.5]), [0.5, -0.5], (0.5, -0.5), 0.5, "brake", object(), {}],
    ids=lambda one: repr(one)[:9],
)
def test_what_cannot_be_called_is_no_backup(backup: Any) -> None:
    """Its action looks like one; nobody would ask it, and the robot would rest where it was to be steered away."""
    assert not callable(backup)
    with pytest.raises(
        InputError, match=f"backup: got {type(backup).__name__}, wanted a function of the state or None"
    ):
        made(backup)


@pytest.mark.parametrize("answer", [[0.5], [0.5, -0.5, 0.0], [0.5, np.nan], [np.inf, 0.0], [[0.5, -0.5]]])
def test_nor_is_what_answers_something_else_than_one_number_for_each_action(answer: Any) -> None:
    with pytest.raises(InputError, match="backup: got"):
        made(lambda state: answer)


def test_what_wants_a_state_is_one() -> None:
    safe = made(lambda state: np.array([0.25, state[0]]) if state is not None else state[0])
    assert safe.decide(np.zeros(2), [0.1, 0.1]).action.tolist() == [0.1, 0.1]


@pytest.mark.parametrize(("backup", "wanted"), [(lambda state: [0.5, -0.5], [0.5, -0.5]), (None, [0.0, 0.0])])
def test_a_backup_that_was_taken_is_what_acts_where_no_state_is_known(backup: Any, wanted: list[float]) -> None:
    assert made(backup).decide(None, None).action.tolist() == wanted
