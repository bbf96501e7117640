"""Goals over those of PPO in the same episodes, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import point
from safedpa_lab.experiments.statistics import ratio_interval


@pytest.mark.parametrize("ppo", [[0, 3, 0, 5], [2, 2, 1, 1], [0, 0, 0, 0], None])
def test_goals_over_those_of_ppo_are_told_where_it_reached_any(ppo: list[int] | None) -> None:
    tables: dict[str, dict[str, Any]] = {
        "own": {"safedpa": {"goals_each": [2, 3, 4, 5]}}, "same": {"safedpa": {"goals_each": [1, 1, 2, 2]}}
    }  # fmt: skip
    if ppo is not None:
        tables["own"]["ppo"] = {"goals_each": ppo}
    point._beside_ppo(tables)
    rows = [tables["own"]["safedpa"], tables["same"]["safedpa"]]
    if not ppo or sum(ppo) == 0:
        assert all("of_ppo" not in row for row in rows)
    else:
        goals = np.array([[2.0, 3.0, 4.0, 5.0], [1.0, 1.0, 2.0, 2.0]])
        assert [row["of_ppo"] for row in rows] == [ratio_interval(own, np.array(ppo, dtype=float)) for own in goals]
        assert [row["of_ppo"][0] for row in rows] == pytest.approx((goals.sum(axis=1) / sum(ppo)).tolist())
