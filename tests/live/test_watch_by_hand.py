"""What the watch counts, from ticks and forecasts that are written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.live import watch
from safedpa.live.forecasts import Forecast, Forecasts, channel_errors, stretch_error
from safedpa.live.watch import Band, VerdictFacts, Watch, place_in_words

CAR = load_model("car")


def facts(h_now: float, h_next: float = 0.5, margin: float = 0.125) -> VerdictFacts:
    return VerdictFacts(h_now, h_next, margin)


@pytest.mark.parametrize(
    ("h_after", "covered"), [(0.5, True), (0.375, True), (0.37, False), (0.625, True), (-0.5, False), (2.0, True)]
)
def test_a_step_is_covered_where_h_fell_by_no_more_than_the_margin(h_after: float, covered: bool) -> None:
    """0.5 was foreseen with a margin of 0.125."""
    made = Watch(CAR)
    made.judge_margin(7, facts(9.0))
    made.judge_margin(8, facts(h_after))
    assert made.coverage == float(covered)


@pytest.mark.parametrize(("tick", "counted"), [(8, True), (7, False), (9, False), (6, False), (-6, False), (0, False)])
def test_what_was_foreseen_is_held_against_the_next_tick_alone(tick: int, counted: bool) -> None:
    made = Watch(CAR)
    made.judge_margin(7, facts(9.0))
    made.judge_margin(tick, facts(0.0))
    assert made.coverage == (0.0 if counted else 1.0)


def test_coverage_is_the_share_of_the_steps_that_can_be_judged() -> None:
    """Of ten ticks one has no verdict and one obeyed another: of the six that are left two are not covered."""
    made = Watch(CAR)
    heights = [9.0, 0.5, 0.0, 0.4, None, 0.0, 0.5, 0.0, 0.1, 0.5]
    for tick, height in enumerate(heights):
        made.judge_margin(tick, None if height is None else facts(height), obeyed=tick != 7)
    assert made.coverage == pytest.approx(4.0 / 6.0)


def test_of_steps_longer_ago_than_twenty_seconds_none_counts() -> None:
    made = Watch(CAR, period=0.05)
    for tick in range(100):
        made.judge_margin(tick, facts(0.0))
    for tick in range(100, 499):
        made.judge_margin(tick, facts(0.5))
    assert made.coverage == pytest.approx(399 / 400)
    made.judge_margin(499, facts(0.5))
    assert made.coverage == 1.0


def forecast(error: tuple[float, ...], yaw: float = 0.0, start: int = 0, change: float = 1.0) -> Forecast:
    """One second of driving, of which the model is off by so much."""
    began = np.array([0.0, 0.0, yaw, 1.0])
    measured = began + np.array([change, 0.0, 0.0, 0.0])
    return Forecast(start, start + 20, began, measured, measured - np.array(error), np.zeros(2), np.ones(2))


@pytest.mark.parametrize("old", [0, 3, 40])
def test_the_error_is_that_of_the_last_stretch(old: int) -> None:
    """On a scale of 0.5 m and 2 m/s: 0.1 m and 0.2 m/s are 0.2 and 0.1."""
    made = Watch(CAR, scale=np.array([0.5, 0.0, 0.0, 2.0]))
    for _ in range(old):
        made._seen.append(forecast((7.0, 0.0, 0.0, 7.0)))
    assert made.error == (0.0 if old == 0 else pytest.approx(0.5 * (14.0 + 3.5)))
    for number in range(watch._STRETCH):
        sign = 1.0 if number % 2 else -1.0
        made._seen.append(forecast((0.1 * sign, 0.0, 0.0, -0.2 * sign)))
    assert made.error == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("errors", "scale", "size"),
    [
        ([(3.0, 0.0, 0.0, 0.0), (-4.0, 0.0, 0.0, 0.0)], (1.0, 0.0, 0.0, 0.0), np.sqrt(12.5)),
        ([(3.0, 0.0, 0.0, 1.0)], (2.0, 0.0, 0.0, 4.0), 0.875),
        ([(3.0, 2.0, 0.0, 1.0)], (0.0, 0.0, 0.0, 0.0), 0.0),
        ([], (1.0, 1.0, 1.0, 1.0), 0.0),
    ],
)
def test_an_error_of_a_stretch_is_a_root_mean_square_over_the_scale(
    errors: list[tuple[float, ...]], scale: tuple[float, ...], size: float
) -> None:
    found = stretch_error(CAR.system, [forecast(error) for error in errors], np.array(scale))
    assert found == pytest.approx(size)


@pytest.mark.parametrize(
    ("yaw", "error", "along", "across"),
    [
        (0.0, (1.0, 2.0), 1.0, 2.0), (np.pi / 2.0, (1.0, 2.0), 2.0, -1.0), (np.pi, (1.0, 2.0), -1.0, -2.0),
        (-np.pi / 2.0, (1.0, 2.0), -2.0, 1.0), (np.pi / 4.0, (1.0, 1.0), np.sqrt(2.0), 0.0),
    ],
)  # fmt: skip
def test_a_place_is_off_along_and_across_the_heading(
    yaw: float, error: tuple[float, float], along: float, across: float
) -> None:
    found = channel_errors(CAR.system, forecast((*error, 0.25, -0.5), yaw))
    np.testing.assert_allclose(found, [along, across, 0.25, -0.5], atol=1e-12)


BAND = Band(scale=np.ones(4), usual=np.ones(2), edges=np.full(4, 0.01), error=0.1)


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ((-0.5, -0.4, -0.3, -0.2), "speed: 0.35 m/s less than predicted after 1 s"),
        ((0.5, 0.4, 0.3, 0.2), "speed: 0.35 m/s more than predicted after 1 s"),
        ((-0.5, 0.4, -0.3, 0.2), "speed: 0.35 m/s beside the prediction after 1 s"),
        ((-0.5, -0.4, -0.3, -0.2, 0.35), "speed: 0.35 m/s less than predicted after 1 s"),
        ((0.5, 0.4, 0.3, 0.2, -0.35), "speed: 0.35 m/s more than predicted after 1 s"),
        ((0.5, 0.4, 0.3, -0.2, -0.35), "speed: 0.35 m/s beside the prediction after 1 s"),
        ((-0.5, -0.4, 0.3, 0.2, -0.35), "speed: 0.35 m/s beside the prediction after 1 s"),
    ],
)
def test_words_tell_the_size_and_the_side_of_an_error(errors: tuple[float, ...], said: str) -> None:
    seen = [forecast((0.0, 0.0, 0.0, error)) for error in errors]
    assert place_in_words(CAR.system, BAND, seen, 1.0).startswith(said)


def test_of_three_forecasts_nothing_is_said() -> None:
    assert place_in_words(CAR.system, BAND, [forecast((0.0, 0.0, 0.0, 1.0))] * 3, 1.0) == ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("size", [0.2, 5.0])
def test_an_error_to_either_side_is_as_far_beyond_the_band(sign: float, size: float) -> None:
    """The commands varied as usual: 1.5 times the edge of 0.01."""
    ratios = BAND.ratios(CAR.system, forecast((0.0, 0.0, 0.0, sign * size)))
    np.testing.assert_allclose(ratios, [0.0, 0.0, 0.0, size / 0.015], atol=1e-12)


@pytest.mark.parametrize("scale", [(3.0, 1.0), (1.0, 3.0)])
def test_along_and_across_count_on_the_root_mean_square_of_the_places_scale(scale: tuple[float, float]) -> None:
    """Errors are no concern below a twenty-fifth: sqrt((9 + 1) / 2) m for both directions, their own for the others."""
    seen = [forecast((0.0, 0.0, 0.0, 0.0))] * watch._STRETCH
    band = watch.learned_band(CAR.system, seen, np.array([*scale, 0.25, 4.0]))
    np.testing.assert_allclose(band.edges, 1.5 / 25.0 * np.array([np.sqrt(5.0), np.sqrt(5.0), 0.25, 4.0]))


@pytest.mark.parametrize("size", [0.02, 1.0, 50.0])
@pytest.mark.parametrize("degrees", [0, 90, 180, -90])
@pytest.mark.parametrize(
    ("turning", "constant", "told"), [(12.0, 5.0, True), (4.0, 2.0, True), (12.0, 8.0, False), (6.0, -5.0, False)]
)
def test_an_error_turns_with_the_heading_where_it_correlates_by_four_fifths(
    turning: float, constant: float, told: bool, degrees: int, size: float
) -> None:
    """Of headings in quarters of a turn: turning / sqrt(turning^2 + 2 constant^2), 0.86, 0.82, 0.73 and 0.65."""
    quarters = np.radians([0.0, 90.0, 180.0, 270.0] * 2)
    errors = size * (turning * np.cos(quarters - np.radians(degrees)) + constant)
    seen = [forecast((0.0, 0.0, 0.0, error), yaw) for error, yaw in zip(errors, quarters, strict=True)]
    said = place_in_words(CAR.system, BAND, seen, 1.0)
    towards = [said.endswith(f"(most towards {one} degrees)") for one in (degrees, abs(degrees))]
    assert ("turning with the heading" in said, any(towards)) == (told, told), said


class Model:
    """Remembers when each step began, and goes on by what is applied."""

    period = 0.1

    def __init__(self) -> None:
        known = CAR.system
        self.system: Any = SimpleNamespace(is_plausible=known.is_plausible, action=known.action)
        self.times: list[float] = []

    def initial_memory(self, *_: Any) -> tuple[()]:
        return ()

    def advance(self, state: Any, applied: Any, memory: Any, _: Any, *, period: float, time: float = -1.0) -> Any:
        self.times.append(time)
        return state + period * applied[0], memory


def test_a_step_begins_where_the_tick_before_was_and_goes_on_by_what_was_applied_since() -> None:
    """From tick 5, at a period of 0.25 s and over four ticks: 1 + 2 + 3 + 4 quarters of what is applied."""
    model: Any = Model()
    made = Forecasts(model, 1.0, 0.25)
    found = []
    for tick in range(4, 10):
        found += made.observe(tick, np.full(4, 0.1 * tick), np.array([tick - 5.0, 0.5]), None)
    (only,) = found
    assert (only.start, only.end) == (5, 9)
    assert only.began.tolist() == [0.5] * 4
    np.testing.assert_allclose(only.measured, 0.9)
    np.testing.assert_allclose(only.predicted, 0.5 + 0.25 * 10.0)
    np.testing.assert_allclose(only.actions, [2.5, 0.5])
    np.testing.assert_allclose(only.variation, [4.0, 0.0])
    assert model.times[:2] == pytest.approx([0.25 * 5, 0.25 * 6])
