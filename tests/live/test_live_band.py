"""The band that a model's error usually stays in, and the sentence about an error that left it."""

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.live.forecasts import Forecast, ForecastTracker, channel_errors, stretch_error
from safedpa.live.model_monitor import ErrorBand, describe_conditions, has_moved, learned_band

SYSTEM = load_model("car").system
BAND = ErrorBand(scale=np.ones(4), usual=np.ones(2), edges=np.full(4, 0.01), error=0.1)


def forecast(error, yaw=0.0, speed=1.0) -> Forecast:
    """One second of driving in which the measured state exceeds the predicted one by ``error``."""
    began, measured = np.array([0.0, 0.0, yaw, speed]), np.array([1.0, 0.0, yaw, speed])
    return Forecast(0, 20, began, measured, measured - np.array(error), np.array([1.0, 0.0]), np.ones(2))


def one_sided(sign: float, count: int = 40) -> list[Forecast]:
    """Straight drives whose predictions are off to one side by up to 0.2 in each channel, each by another amount."""
    random = np.random.default_rng(2)
    made = []
    for start, size in enumerate(0.02 + 0.18 * random.uniform(0.0, 1.0, (count, 4))):
        measured = np.array([1.0 + 0.01 * start, 0.0, 0.0, 1.0 + 0.02 * (start % 5)])
        began = np.array([0.0, 0.0, 0.0, 1.0])
        made.append(Forecast(start, start + 20, began, measured, measured - sign * size, np.zeros(2), np.ones(2)))
    return made


def test_a_robot_moved_if_it_or_its_prediction_did():
    def between(measured, predicted):
        return Forecast(0, 20, np.zeros(4), np.array(measured), np.array(predicted), np.zeros(2), np.ones(2))

    assert not has_moved(SYSTEM, between((0.0, 0.0, 0.0, 0.01), (0.01, 0.0, 0.0, 0.0)))
    assert has_moved(SYSTEM, between((0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.5)))
    assert has_moved(SYSTEM, between((0.06, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_band_has_room_for_one_and_a_half_times_every_error_it_was_learned_from(sign):
    """Also for errors of one sign, as a slow servo or a tail wind causes them."""
    seen = one_sided(sign)
    band = learned_band(SYSTEM, seen)
    assert max(np.abs(channel_errors(SYSTEM, item)).max() for item in seen) > 0.1
    ratios = np.array([band.ratios(SYSTEM, item) for item in seen])
    assert ratios.max() == pytest.approx(1.0 / 1.5)


def test_errors_of_either_sign_teach_the_same_band():
    low, high = (learned_band(SYSTEM, one_sided(sign), np.full(4, 0.5)) for sign in (-1.0, 1.0))
    np.testing.assert_allclose(low.edges, high.edges)
    assert low.error == pytest.approx(high.error)


def test_the_band_is_wider_while_commands_change(car, drive_of):
    running = ForecastTracker(car)
    ended = [item for row in drive_of(600) for item in running.observe(*row, None)]
    band = learned_band(car.system, ended)
    assert stretch_error(car.system, ended, band.scale) < band.error
    item = ended[-1]
    rough = Forecast(
        item.start, item.end, item.began, item.measured, item.predicted, item.actions, 5.0 * item.variation
    )
    assert band.ratios(car.system, rough).max() < band.ratios(car.system, item).max()


@pytest.mark.parametrize("size", [0.2, -0.2, 5.0, -5.0])
def test_the_ratio_to_the_band_does_not_depend_on_the_sign(size):
    """The commands varied as usual: 1.5 times the edge of 0.01."""
    ratios = BAND.ratios(SYSTEM, forecast((0.0, 0.0, 0.0, size)))
    np.testing.assert_allclose(ratios, [0.0, 0.0, 0.0, abs(size) / 0.015], atol=1e-12)


def test_a_prediction_that_is_not_a_number_is_far_outside_the_band():
    assert BAND.ratios(SYSTEM, forecast((0.0, 0.0, 0.0, np.nan))).max() > 1000.0


@pytest.mark.parametrize("scale", [(3.0, 1.0), (1.0, 3.0)])
def test_an_error_below_a_twenty_fifth_of_the_usual_change_is_inside_the_band(scale):
    """Along and across the heading share the scale of the position, sqrt((9 + 1) / 2) m."""
    band = learned_band(SYSTEM, [forecast((0.0, 0.0, 0.0, 0.0))] * 12, np.array([*scale, 0.25, 4.0]))
    np.testing.assert_allclose(band.edges, 1.5 / 25.0 * np.array([np.sqrt(5.0), np.sqrt(5.0), 0.25, 4.0]))


def sentence(errors, **more):
    return describe_conditions(SYSTEM, BAND, [forecast((0.0, 0.0, 0.0, error), **more) for error in errors], 1.0)


@pytest.mark.parametrize(
    ("errors", "notice"),
    [
        ((-0.2,) * 6, "speed: 0.2 m/s less than predicted after 1 s"),
        ((-0.5, -0.4, -0.3, -0.2), "speed: 0.35 m/s less than predicted after 1 s"),
        ((0.5, 0.4, 0.3, 0.2), "speed: 0.35 m/s more than predicted after 1 s"),
        ((-0.5, 0.4, -0.3, 0.2), "speed: 0.35 m/s next to the prediction after 1 s"),
        ((0.5, 0.4, 0.3, 0.2, -0.35), "speed: 0.35 m/s more than predicted after 1 s"),
        ((-0.5, -0.4, 0.3, 0.2, -0.35), "speed: 0.35 m/s next to the prediction after 1 s"),
        ((1.0, 1.0, 1.0), ""),
    ],
)
def test_the_sentence_states_the_channel_size_and_side_of_an_error(errors, notice):
    """One-sided is an error of which four of five have one sign; three forecasts are too few."""
    assert sentence(errors).startswith(notice)
    assert bool(sentence(errors)) is bool(notice)


@pytest.mark.parametrize(("one", "other"), [(1, 1), (1, -1), (-1, 1), (-1, -1)], ids=str)
@pytest.mark.parametrize("large_when", ["slow", "fast"])
def test_the_sentence_names_the_side_of_a_variable_where_errors_are_large_whatever_their_signs(one, other, large_when):
    """Errors of 0.3 rad on one side of 1 m/s and of 0.05 rad on the other."""
    large, small = [0.3 * one, 0.3 * other] * 4, [0.05 * other, 0.05 * one] * 4
    slow, fast = (large, small) if large_when == "slow" else (small, large)
    seen = [forecast((0.0, 0.0, error, 0.0), speed=0.5) for error in slow]
    seen += [forecast((0.0, 0.0, error, 0.0), speed=1.5) for error in fast]
    notice = describe_conditions(SYSTEM, BAND, seen, 1.0)
    assert notice.startswith("yaw: ")
    assert notice.endswith(f"speed is {'below 1' if large_when == 'slow' else 'above 1'} m/s")
    alike = [forecast((0.0, 0.0, error, 0.0), speed=speed) for speed in (0.5, 1.5) for error in (0.2, -0.2) * 4]
    assert "most where" not in describe_conditions(SYSTEM, BAND, alike, 1.0)


@pytest.mark.parametrize("size", [0.02, 50.0])
@pytest.mark.parametrize("degrees", [0, 90, 180, -90])
@pytest.mark.parametrize(
    ("turning", "constant", "named"), [(12.0, 5.0, True), (4.0, 2.0, True), (12.0, 8.0, False), (6.0, -5.0, False)]
)
def test_an_error_turns_with_the_heading_where_it_correlates_by_four_fifths(turning, constant, named, degrees, size):
    """Of headings in quarters of a turn: turning / sqrt(turning^2 + 2 constant^2), 0.86, 0.82, 0.73 and 0.65."""
    quarters = np.radians([0.0, 90.0, 180.0, 270.0] * 2)
    errors = size * (turning * np.cos(quarters - np.radians(degrees)) + constant)
    seen = [forecast((0.0, 0.0, 0.0, error), yaw) for error, yaw in zip(errors, quarters, strict=True)]
    notice = describe_conditions(SYSTEM, BAND, seen, 1.0)
    towards = [notice.endswith(f"(most towards {one} degrees)") for one in (degrees, abs(degrees))]
    assert ("turning with the heading" in notice, any(towards)) == (named, named), notice
