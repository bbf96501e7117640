"""A filter whose rollout thinks of another backup than its own: that is told, and nothing that only follows from it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.safety.checked import first, made, probe

from safedpa.errors import InputError
from safedpa.safety import RolloutBarrier
from safedpa.safety.check_backup import backup_issues
from safedpa.safety.compatibility import check_backup


def rollout(backup: Any) -> RolloutBarrier:
    return RolloutBarrier(lambda x: (0.5 * x, 0.1 * np.eye(1)), backup, first, 5, ["r"])


@pytest.mark.parametrize(("foreign", "told"), [(False, ["h0"]), (True, ["r"])])
def test_a_condition_that_breaks_is_reported_of_the_right_backup_only(foreign: bool, told: list[str]) -> None:
    """From 0.5 with -1 to 0.4: a condition of 0.9 x 0.5 + 0.002 is missed, by whichever backup the rollout thinks of.

    But with another one than the filter's, every condition of the rollout is about something that is not done.
    """
    own = [-1.0]
    checked = made(first, rollout([0.5] if foreign else own), backup=lambda x: own)
    near = probe(0.5, h=[0.5, 9.0])
    found = backup_issues(checked, [near], stands=True)
    assert [name for issue in found for name in issue.names if name in told] == told
    assert all("the same; give the filter" in issue.sentence for issue in found) is foreign
    assert any("misses its condition" in issue.sentence for issue in found) is not foreign
    unasked = backup_issues(checked, [near], stands=False)
    assert len(unasked) == foreign, "a robot without a stand is not asked, and another backup is told all the same"


@pytest.mark.parametrize("backup", ["stop", 0.0, (0.0, 0.0), [0.0, 0.0], np.zeros(2)])
def test_a_backup_that_cannot_be_called_is_refused_when_it_is_given(backup: Any) -> None:
    """Else it would be found out when it is needed."""
    with pytest.raises(InputError, match=rf"backup: got {type(backup).__name__}, wanted a function of the state"):
        check_backup(backup, 2)


@pytest.mark.parametrize("answer", [[0.0], [0.0, 0.0, 0.0], [[0.0, 0.0]], [np.nan, 0.0], [np.inf, 0.0], 0.0])
def test_a_backup_that_answers_no_action_is_refused_when_it_is_given(answer: Any) -> None:
    with pytest.raises(InputError, match="wanted 2 finite numbers, one for each action"):
        check_backup(lambda _: answer, 2)


def test_a_backup_that_needs_a_state_is_taken() -> None:
    check_backup(lambda x: x[0], 2)
    check_backup(lambda _: [0.0, 0.0], 2)
    check_backup(None, 2)
