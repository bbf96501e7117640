"""The margin of each filter: of its own errors, larger where it is wrong about the wind, and what it promises."""

from __future__ import annotations

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


def test_errors_are_what_was_predicted_less_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the truth known the steering's lag alone is left; without the wind the filter is off by more."""
    monkeypatch.setattr(margin, "COVERAGE", 0.6)
    found = measured_margins(Calibration("oracle,physics", NOWHERE, drives=4, steps=60))["margins"]
    told, ignorant = found["oracle"], found["physics"]
    assert (told["drives"], told["steps"]) == (4, 60)
    assert 5 < told["transitions"] < 4 * 60, "those near hazards alone"
    assert abs(told["largest_error"]) < 0.005
    assert told["median_error"] < ignorant["median_error"] < NEAR


def test_too_few_drives_are_refused_before_any_is_driven() -> None:
    with pytest.raises(InputError, match="--drives: got 20, wanted 99"):
        Calibration("safedpa", NOWHERE, 20, 10)
