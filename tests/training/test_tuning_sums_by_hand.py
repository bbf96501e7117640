"""How errors of tuned models are summed over drives, and how drives are divided, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import tuning_errors
from safedpa_lab.experiments.tuning_real import parts_of
from safedpa_sim.training.tuning_data import Drive


def test_means_of_drives_that_a_draw_picks_count_every_step() -> None:
    """Two seeds of two drives and one, with 2, 3 and 5 steps; a seed may be picked twice."""

    def drive(count: int, *squares: float) -> dict[str, Any]:
        return {"count": count, "squares": list(squares)}

    groups = [[drive(2, 4.0, 1.0), drive(3, 6.0, 2.0)], [drive(5, 5.0, 7.0)]]
    found = tuning_errors._means(groups, np.array([[0, 1], [0, 0], [1, 1]]))
    np.testing.assert_allclose(found, [[1.5, 1.0], [2.0, 0.6], [1.0, 1.4]])
    metrics = tuning_errors._metrics(np.array([[4.0, 9.0], [0.0, 1.0]]), np.array([1.0, 2.0]))
    assert {name: value.tolist() for name, value in metrics.items()} == {
        "root_mean_square": [1.75, 0.25], "mean_square": [3.125, 0.125], "squared_norm": [13.0, 1.0],
    }  # fmt: skip


@pytest.mark.parametrize(("share", "cuts"), [(0.5, (5, 2)), (0.25, (2, 1)), (1.0, (10, 4))])
def test_parts_of_drives_share_the_state_at_the_cut(share: float, cuts: tuple[int, int]) -> None:
    drives = [Drive(np.arange(n + 1.0)[:, None], np.arange(float(n))[:, None]) for n in (10, 4)]
    first, rest = parts_of(drives, share)
    assert [len(one.actions) for one in first] == list(cuts)
    assert [len(one.actions) for one in rest] == [10 - cuts[0], 4 - cuts[1]]
    for before, after in zip(first, rest, strict=True):
        assert before.states[-1] == after.states[0] == len(before.actions)
