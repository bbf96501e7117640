"""A car whose commands are late: a filter that knows it keeps it safe, and says so."""

from __future__ import annotations

import pytest

from safedpa.errors import InputError
from safedpa.safety.found_delay import FoundDelay
from safedpa_lab.experiments.delayed_drives import Lateness, delayed_drives, margin_with_delay


@pytest.mark.long
def test_a_known_delay_is_driven_with() -> None:
    """With the margin that belongs to it, which lies where the action begins to act."""
    margin = margin_with_delay(Lateness(0.3), 8, 8.0)
    assert 0.005 < margin.epsilon["obstacle"] < 0.08
    assert set(margin.epsilon) == {"obstacle", "field", "speed"}
    found = delayed_drives(Lateness(0.3), 4, 900, 8.0, margin=margin)
    assert found.collided == 0
    assert found.goals > 0
    assert found.statuses["corrected"] > found.statuses["relaxed"] + found.statuses["violated"]
    assert found.statuses["passed"] > 0.5 * found.statuses.total()


@pytest.mark.long
@pytest.mark.parametrize("channel", ["steer", "drive"])
def test_a_channel_that_is_late_alone(channel: str) -> None:
    """Over twelve drives: in single scenes more is relaxed than corrected, and which ones depends on each decision."""
    found = delayed_drives(Lateness(0.2, channel), 12, 31_000, 8.0)
    assert found.collided == 0
    assert found.goals > 0
    assert found.statuses["corrected"] > found.statuses["relaxed"] + found.statuses["violated"]
    assert found.statuses["fallback"] == 0


@pytest.mark.long
def test_a_delay_that_the_robot_measures_is_driven_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FoundDelay, "observe", lambda *_: None)  # else what nobody tells is found, and looked past too
    told = delayed_drives(Lateness(0.13, told="clock"), 4, 31_000, 8.0)
    assert told.collided == 0
    assert told.goals > 0
    silent = delayed_drives(Lateness(0.13, told="nobody"), 4, 31_000, 8.0)
    assert told.least_h > silent.least_h
    trouble = ("relaxed", "violated")
    assert sum(told.statuses[one] for one in trouble) < sum(silent.statuses[one] for one in trouble)


@pytest.mark.long
def test_an_unknown_delay_causes_no_collision() -> None:
    assert delayed_drives(Lateness(0.15, told="nobody"), 4, 31_000, 8.0).collided == 0


@pytest.mark.long
def test_drives_repeat_exactly() -> None:
    assert delayed_drives(Lateness(0.13), 1, 5, 3.0) == delayed_drives(Lateness(0.13), 1, 5, 3.0)


def test_invalid_delays_are_refused() -> None:
    with pytest.raises(InputError, match="channel: got 'wheel', wanted one of both, drive, steer"):
        Lateness(0.1, "wheel")
    with pytest.raises(InputError, match="told: got 'all', wanted one of model, clock, nobody"):
        Lateness(0.1, told="all")
    with pytest.raises(InputError, match="channel: got 'drive', wanted both"):
        Lateness(0.1, "drive", told="clock")
    for allowed in (Lateness(0.1, "drive"), Lateness(0.1, "steer", "nobody"), Lateness(0.1, told="clock")):
        assert allowed.seconds == 0.1
