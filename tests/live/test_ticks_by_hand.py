"""What is counted in ticks while a robot drives: what is kept, who strays from the model, when forecasts begin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.bus import HealthMessage
from safedpa.dynamics import load_model
from safedpa.live.finding import History
from safedpa.live.forecasts import Forecasts
from safedpa.live.under_way import Strays

CAR = load_model("car")
STILL = np.zeros(4)


@pytest.mark.parametrize(("tick", "seconds"), [(0, 0.5), (3, 0.35), (9, 0.05), (10, 0.0)])
def test_of_the_time_from_a_tick_on_as_much_is_kept_as_has_rows(tick: int, seconds: float) -> None:
    history = History(CAR.system, 0.05)
    for number in range(10):
        history.add(number, STILL, np.zeros(2))
    assert history.seconds_since(tick) == pytest.approx(seconds)


def state(tick: int, epoch: int = 7) -> Any:
    known = {"tick": tick, "epoch": epoch}
    return type("State", (), known)()


def health(tick: int, model: str, service: str = "policy", epoch: int = 7) -> HealthMessage:
    return HealthMessage(
        epoch=epoch, tick=tick, robot_time=0.0, publish_time=0.0, service=service, pid=1, state="running", model=model
    )


@pytest.mark.parametrize(("said_at", "believed"), [(100, False), (109, False), (110, True), (500, True)])
def test_who_uses_another_model_is_believed_ten_ticks_after_a_change(said_at: int, believed: bool) -> None:
    strays = Strays()
    strays.settle(state(100), anew=True)
    strays.hear(health(said_at, "old"))
    strays.hear(health(said_at, "new", "adaptation"))
    assert strays.found("new") == ("policy uses old" if believed else "")
    assert strays.found("new") == "", "told once for what was said once"


def test_what_was_said_in_another_drive_or_before_any_is_no_stray() -> None:
    strays = Strays()
    strays.hear(health(200, "old"))
    assert strays.found("new") == ""
    strays.settle(state(0, epoch=8), anew=False)
    assert strays.found("new") == ""
    strays.hear(health(200, "old", epoch=8))
    assert strays.found("new") == "policy uses old"


def test_after_a_repair_that_came_to_nothing_the_next_waits_twice_as_long_each_time() -> None:
    strays, waited = Strays(), list[int]()
    strays.settle(state(0), anew=False)
    for repair in range(5):
        strays.not_mended()
        if repair == 3:
            strays.mended()
        count = 0
        while True:
            count += 1
            strays.settle(state(count), anew=False)
            strays.hear(health(10_000, "old"))
            if strays.found("new"):
                break
        waited.append(count)
    assert waited == [200, 400, 800, 1600, 200]


def test_a_forecast_begins_as_soon_as_it_may_and_ends_after_its_horizon() -> None:
    """Of one second at 20 Hz; never more of them side by side than there is room for, evenly spread."""
    forecasts = Forecasts(CAR, 1.0)
    ended = [
        (item.start, tick) for tick in range(200) for item in forecasts.observe(tick, STILL, np.zeros(2), CAR.latent)
    ]
    starts = [start for start, _ in ended]
    assert all(tick - start == 20 for start, tick in ended)
    assert starts[0] <= 1
    apart = set(np.diff(starts).tolist())
    assert len(apart) == 1
    assert 1 <= min(apart) <= 20


def test_after_a_gap_or_what_cannot_be_believed_forecasts_begin_anew() -> None:
    """A number that is none, or a tick that is missing, is in no forecast."""
    for broken in ("gap", "state", "applied"):
        forecasts, ended = Forecasts(CAR, 1.0), list[tuple[int, int]]()
        for tick in range(120):
            if broken == "gap" and tick == 50:
                continue
            lost = np.full(4, np.nan) if broken == "state" and tick == 50 else STILL
            unknown = np.full(2, np.nan) if broken == "applied" and tick == 50 else np.zeros(2)
            ended += [(item.start, tick) for item in forecasts.observe(tick, lost, unknown, CAR.latent)]
        assert not [span for span in ended if span[0] < 50 <= span[1]], broken
        assert [span for span in ended if span[0] > 50], broken
        assert [span for span in ended if span[1] < 50], broken
