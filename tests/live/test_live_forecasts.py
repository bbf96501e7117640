"""Forecasts of a running robot are those of a recording of it, and gaps break them."""

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.windows import windows_of
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.live.candidate_forecasts import CandidateForecasts
from safedpa.live.finding import DriveHistory
from safedpa.live.forecasts import Forecast, ForecastTracker, channel_errors, channels, stretch_error

CAR = load_model("car")


def test_a_forecast_is_the_rollout_of_the_recorded_run(car, drive_of):
    """Computed step by step while the robot drives, and over all windows of the excerpt of its history at once."""
    running, history = ForecastTracker(car), DriveHistory(car.system, car.period)
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


def test_a_forecast_begins_in_every_half_of_the_horizon_from_the_first_tick_on(car, drive_of):
    running = ForecastTracker(car)
    spans = [(item.start, row[0]) for row in drive_of(100) for item in running.observe(*row, None)]
    starts = [start for start, _ in spans]
    assert starts[0] <= 1
    assert np.diff(starts).tolist() == [10] * (len(starts) - 1)
    assert {end - start for start, end in spans} == {20}


@pytest.mark.parametrize("broken", ["gap", "state", "action"])
def test_no_forecast_spans_a_gap_or_a_value_that_is_not_a_number(broken):
    forecasts, ended = ForecastTracker(CAR), list[tuple[int, int]]()
    for tick in range(120):
        if broken == "gap" and tick == 50:
            continue
        state = np.full(4, np.nan) if broken == "state" and tick == 50 else np.zeros(4)
        applied = np.full(2, np.nan) if broken == "action" and tick == 50 else np.zeros(2)
        ended += [(item.start, tick) for item in forecasts.observe(tick, state, applied, CAR.latent)]
    assert not [span for span in ended if span[0] <= 50 <= span[1]]
    assert [span for span in ended if span[0] > 50]
    assert [span for span in ended if span[1] < 50]


def test_a_robot_with_another_period_is_predicted_with_its_own(car):
    running, state = ForecastTracker(car, 1.0, period=0.02), np.array([0.0, 0.0, 0.3, 1.0])
    action = np.array([1.5, 0.1])
    memory, ended = car.initial_memory(action), []
    for tick in range(160):
        ended += running.observe(tick, state, action, None)
        state, memory = car.advance(state, action, memory, period=0.02)
    assert {item.end - item.start for item in ended} == {50}
    assert all(item.predicted == pytest.approx(item.measured, abs=1e-9) for item in ended)


class Integrator:
    """A model that adds up what is applied, and records when each of its steps began."""

    period = 0.1

    def __init__(self):
        self.system = SimpleNamespace(is_plausible=CAR.system.is_plausible, action=CAR.system.action)
        self.times = []

    def initial_memory(self, *_):
        return ()

    def advance(self, state, applied, memory, _latent, *, period, time=-1.0):
        self.times.append(time)
        return state + period * applied[0], memory


def test_a_forecast_starts_at_a_measured_state_and_applies_the_actions_reported_since():
    """From tick 5, at a period of 0.25 s and over four ticks: 1 + 2 + 3 + 4 quarters of what is applied."""
    model = Integrator()
    running, ended = ForecastTracker(model, 1.0, 0.25), []
    for tick in range(4, 10):
        ended += running.observe(tick, np.full(4, 0.1 * tick), np.array([tick - 5.0, 0.5 * (-1.0) ** tick]), None)
    (only,) = ended
    assert (only.start, only.end, only.began.tolist()) == (5, 9, [0.5] * 4)
    np.testing.assert_allclose(only.measured, 0.9)
    np.testing.assert_allclose(only.predicted, 0.5 + 0.25 * 10.0)
    np.testing.assert_allclose(only.actions, [2.5, 0.0])
    np.testing.assert_allclose(only.variation, [4.0, 4.0])
    assert model.times[:2] == pytest.approx([0.25 * 5, 0.25 * 6])


def test_a_horizon_of_one_period_is_refused(car):
    with pytest.raises(InputError, match="two periods"):
        ForecastTracker(car, 0.05)


def forecast(error, yaw=0.0):
    began = np.array([0.0, 0.0, yaw, 1.0])
    measured = began + np.array([1.0, 0.0, 0.0, 0.0])
    return Forecast(0, 20, began, measured, measured - np.array(error), np.zeros(2), np.ones(2))


@pytest.mark.parametrize(
    ("yaw", "error", "along", "across"),
    [
        (0.0, (1.0, 2.0), 1.0, 2.0), (np.pi / 2.0, (1.0, 2.0), 2.0, -1.0), (np.pi, (1.0, 2.0), -1.0, -2.0),
        (-np.pi / 2.0, (1.0, 2.0), -2.0, 1.0), (np.pi / 4.0, (1.0, 1.0), np.sqrt(2.0), 0.0),
    ],
)  # fmt: skip
def test_a_position_error_is_split_along_and_across_the_heading(yaw, error, along, across):
    found = channel_errors(CAR.system, forecast((*error, 0.25, -0.5), yaw))
    np.testing.assert_allclose(found, [along, across, 0.25, -0.5], atol=1e-12)
    assert [name for name, _ in channels(CAR.system)][2:] == ["yaw", "speed"]


@pytest.mark.parametrize(
    ("errors", "scale", "size"),
    [
        ([(3.0, 0.0, 0.0, 0.0), (-4.0, 0.0, 0.0, 0.0)], (1.0, 0.0, 0.0, 0.0), np.sqrt(12.5)),
        ([(3.0, 0.0, 0.0, 1.0)], (2.0, 0.0, 0.0, 4.0), 0.875),
        ([(3.0, 2.0, 0.0, 1.0)], (0.0, 0.0, 0.0, 0.0), 0.0),
        ([(np.nan, 0.0, 0.0, 0.0)], (1.0, 1.0, 1.0, 1.0), 1e6),
        ([], (1.0, 1.0, 1.0, 1.0), 0.0),
    ],
)
def test_the_error_of_a_stretch_is_a_root_mean_square_over_the_scale(errors, scale, size):
    found = stretch_error(CAR.system, [forecast(error) for error in errors], np.array(scale))
    assert found == pytest.approx(size)


def test_forecasts_that_are_interrupted_are_not_begun_later() -> None:
    """The worker was given another job, and the candidates are no longer the newest."""
    begun: list[object] = []
    idle = SimpleNamespace(busy=lambda _: False, begin=lambda _, job: begun.append(job), outcome=lambda _: None)
    forecasts = CandidateForecasts()
    forecasts.begin([SimpleNamespace(effect="drag"), SimpleNamespace(effect="lag")])
    forecasts.interrupted()
    forecasts.step("r1", idle)
    assert begun == []
