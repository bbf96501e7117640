"""What the pages say of the pendulum is what its recorded result says, and the result says it of its own flags."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from safedpa_lab.experiments.advantages import advantages
from safedpa_lab.experiments.seeds import SEEDS
from safedpa_lab.experiments.statistics import wilson_interval


@pytest.fixture
def result(repository: Path) -> Any:
    return json.loads((repository / "docs" / "results" / "pendulum.json").read_text(encoding="utf-8"))


def test_its_counts_are_those_of_its_flags(result: Any) -> None:
    for table in result["tables"].values():
        for rows in table.values():
            for row in rows.values():
                assert row["episodes"] == len(row["safe_each"]) == result["directions"] * result["episodes"]
                assert row["safe"] == row["safe_each"].count("1")
                assert row["interval_safe"] == pytest.approx(wilson_interval(row["safe"], row["episodes"]))
                if "success_each" in row:
                    pairs = list(zip(row["safe_each"], row["success_each"], strict=True))
                    assert row["both"] == pairs.count(("1", "1"))


def test_its_significance_follows_from_its_flags(result: Any) -> None:
    for name, table in result["tables"].items():
        assert advantages(table, result["directions"]) == result["advantages"][name]


def test_it_was_counted_on_seeds_of_its_own(result: Any) -> None:
    assert result["evaluation_seed"] in SEEDS["evaluation"]
    assert result["seed"] >= 100, "below 100 one develops"
    assert result["penalty"]["seed"] in SEEDS["development"]
    margins = result["margins"].values()
    assert all(seed in SEEDS["calibration"] for row in margins for seed in row["seeds"])
    assert len({(row["drives"], row["transitions"], row["coverage"]) for row in margins}) == 1
    assert result["provenance"]["command"].startswith("safedpa experiment pendulum --seed 2100")


def test_the_claims_are_its_figures(repository: Path, result: Any) -> None:
    own, same = result["tables"]["own"], result["tables"]["same"]
    others = [name for name in own["balancing"] if name.startswith("fix_")] + ["mix"]
    count = own["balancing"]["safedpa"]["episodes"]
    claims = " ".join((repository / "docs" / "claims.md").read_text(encoding="utf-8").split())
    assert all(own["balancing"][name]["safe"] == count for name in ("safedpa", *others))
    upright = [own["hazard"][name]["both"] for name in others]
    kept = [same["balancing"][name]["safe"] for name in others]
    both = own["hazard"]["safedpa"]["both"]
    assert f"every filter with its own margin {count} of {count} without a violation" in claims
    assert f"with SafeDPA's margin for all the others {min(kept)} to {max(kept)}" in claims
    assert f"SafeDPA {both} of {count} upright and never in the hazard" in claims
    assert f"filters that do not adapt {min(upright)} to {max(upright)}" in claims
