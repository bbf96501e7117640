"""Forecasts of a running robot are those of a recording of it, and gaps break them."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.compare.rollout import rollout_at
from safedpa.compare.windows import windows_of
from safedpa.errors import InputError
from safedpa.live.finding import History
from safedpa.live.forecasts import Forecast, Forecasts, channel_errors, channels, stretch_error
from safedpa.live.watch import learned_band, moved


def test_a_forecast_is_the_rollout_of_the_recorded_run(car, drive_of):
    """Two roads: step by step while the robot drives, and all windows at once over the excerpt of its history."""
    running, history = Forecasts(car), History(car.system, car.period)
    ended = []
    for tick, state, applied in drive_of(200):
        history.add(tick, state, applied)
        ended += running.observe(tick, state, applied, None)
    windows = windows_of([history.excerpt(0, "r1")], 1.0, stride=1)
    predicted = rollout_at(car, windows, [windows.end])[0]
    known = {round(t / car.period): row for t, row in zip(windows.t[windows.start], predicted, strict=True)}
    late = [item for item in ended if item.start >= 20 and item.start in known]
    assert len(late) >= 10
    for item in late:
        assert item.end - item.start == 20
        # the recording's first window knows nothing of the actuators' past; a second later that is forgotten
        assert car.system.difference(item.predicted, known[item.start]) == pytest.approx(np.zeros(4), abs=1e-4)


def test_one_begins_in_every_half_of_the_horizon(car, drive_of):
    running = Forecasts(car)
    starts = [item.start for row in drive_of(100) for item in running.observe(*row, None)]
    assert np.diff(starts).tolist() == [10] * (len(starts) - 1)


def test_nothing_is_carried_across_a_gap_or_a_state_that_cannot_be_believed(car, drive_of):
    for spoil in ("gap", "nan"):
        running, ended = Forecasts(car), []
        for tick, state, applied in drive_of(120):
            if tick != 50:
                ended += running.observe(tick, state, applied, None)
            elif spoil == "nan":
                ended += running.observe(tick, np.full(4, np.nan), applied, None)
        assert ended
        assert not any(item.start <= 50 <= item.end for item in ended)


def test_a_robot_with_another_period_is_predicted_with_its_own(car):
    running, state = Forecasts(car, 1.0, period=0.02), np.array([0.0, 0.0, 0.3, 1.0])
    action = np.array([1.5, 0.1])
    memory, ended = car.initial_memory(action), []
    for tick in range(160):
        ended += running.observe(tick, state, action, None)
        state, memory = car.advance(state, action, memory, period=0.02)
    assert {item.end - item.start for item in ended} == {50}
    assert all(item.predicted == pytest.approx(item.measured, abs=1e-9) for item in ended)


def test_a_horizon_of_one_period_is_refused(car):
    with pytest.raises(InputError, match="two periods"):
        Forecasts(car, 0.05)


def forecast(measured, predicted, began=(0.0, 0.0, 0.0, 1.0), variation=(1.0, 1.0)):
    return Forecast(0, 20, *(np.array(v, dtype=float) for v in (began, measured, predicted, (1.0, 0.0), variation)))


def test_errors_of_the_place_are_told_along_and_across_the_heading(car):
    north = forecast((0.0, 1.2, 1.57, 1.0), (0.1, 1.0, 1.57, 1.0), began=(0.0, 0.0, np.pi / 2, 1.0))
    assert channel_errors(car.system, north) == pytest.approx([0.2, 0.1, 0.0, 0.0])
    assert [name for name, _ in channels(car.system)][2:] == ["yaw", "speed"]


def test_the_error_of_a_stretch_is_scaled_and_its_states_that_never_move_do_not_count(car):
    one = forecast((1.0, 0.0, 0.0, 1.0), (1.1, 0.0, 0.0, 1.2))
    assert stretch_error(car.system, [one], np.array([1.0, 0.0, 0.0, 0.4])) == pytest.approx((0.1 + 0.5) / 2)
    assert stretch_error(car.system, [], np.ones(4)) == 0.0


def test_what_stands_still_and_should_says_nothing(car):
    assert not moved(car.system, forecast((0.0, 0.0, 0.0, 0.01), (0.01, 0.0, 0.0, 0.0), began=(0.0,) * 4))
    assert moved(car.system, forecast((0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.5), began=(0.0,) * 4))


def test_the_band_holds_what_it_was_learned_from_and_is_wider_in_transients(car, drive_of):
    running = Forecasts(car)
    ended = [item for row in drive_of(600) for item in running.observe(*row, None)]
    band = learned_band(car.system, ended)
    assert max(band.ratios(car.system, item).max() for item in ended) <= 1.0 / 1.5 + 1e-9
    assert stretch_error(car.system, ended, band.scale) < band.error
    item = ended[-1]
    rough = Forecast(
        item.start, item.end, item.began, item.measured, item.predicted, item.actions, 5.0 * item.variation
    )
    assert band.ratios(car.system, rough).max() < band.ratios(car.system, item).max()


def test_the_history_is_bounded_and_cut_where_ticks_are_missing(car, drive_of):
    history = History(car.system, car.period, longest=5.0)
    rows = list(drive_of(200))
    for row in rows:
        if row[0] != 150:
            history.add(*row)
    run = history.excerpt(120, "r1")
    assert history.seconds_since(0) == pytest.approx(5.0)
    assert [(round(run.t[p.start] / 0.05), round(run.t[p.stop - 1] / 0.05)) for p in run.stretches] == [
        (120, 148),
        (151, 198),
    ]
    for t, states, actions in run.parts():
        for row, (time, state, action) in enumerate(zip(t, states, actions, strict=True)):
            tick = round(time / car.period)
            assert state == pytest.approx(rows[tick][1]), row
            assert action == pytest.approx(rows[tick + 1][2]), row
