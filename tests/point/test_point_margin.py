"""The margin of each filter: of its own errors, larger where it is wrong about the wind, and what it promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments.seeds import SEEDS
from safedpa_lab.point import margin
from safedpa_lab.point.margin import NEAR, Calibration, measured_margins

NOWHERE = "no weights here"


@pytest.mark.long
def test_a_filter_with_the_wrong_wind_needs_more_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole rule, with a coverage that few drives are enough for."""
    monkeypatch.setattr(margin, "COVERAGE", 0.8)
    found = measured_margins(Calibration("safedpa,mix", NOWHERE, drives=6, steps=60))["margins"]
    assert 0.0 < found["safedpa"]["epsilon"] < found["mix"]["epsilon"] < 0.05
    for row in found.values():
        assert row["drives"] == 6
        assert row["epsilon"] <= row["of_a_drive"]
        assert all(seed in SEEDS["calibration"] for seed in row["seeds"])


def test_errors_are_what_was_hoped_less_what_was_found() -> None:
    """With the truth told the steering's lag alone is left; who knows nothing of the wind is off by more."""
    task = margin._windy(4, 7, 0.008)
    errors = margin._errors(task, Path(NOWHERE), "oracle", 0.0, ("oracle", "physics"), 60)
    told, ignorant = (np.concatenate(errors[name]) for name in ("oracle", "physics"))
    assert (told > -NEAR).sum() > 5
    assert np.abs(told[told > -NEAR]).max() < 0.005
    assert np.median(np.abs(told[told > -NEAR])) < np.median(np.abs(ignorant[ignorant > -NEAR]))


def test_too_few_drives_are_refused_before_any_is_driven() -> None:
    with pytest.raises(InputError, match="--drives: got 20, wanted 99"):
        Calibration("safedpa", NOWHERE, 20, 10)
