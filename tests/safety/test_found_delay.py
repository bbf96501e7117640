"""An unreported delay is found from the robot's motion; none is found where there is none."""

from typing import Any

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety.defaults import settings_named
from safedpa.safety.prediction.command_history import CommandHistory
from safedpa.safety.prediction.delay_estimator import (
    MAX_DELAY,
    STATED_DELAY,
    TOLERATED_DELAY,
    USUAL_DELAY,
    DelayEstimator,
    Transition,
)
from safedpa.safety.prediction.predictor import Prediction
from safedpa_lab.experiments.adversary.drives import hostile_driver
from safedpa_lab.experiments.driving.delayed_drives import Lateness, delayed_drives
from safedpa_sim.closed_loop import drive

CAR = load_model("car")
LATENT_VALUES = tuple(CAR.latent.tolist())
RANGES = (2.6, 0.68)


def way(model: PhysicsModel, delay: int, ticks: int, seed: int = 3, noise: float = 0.0) -> list[Transition]:
    """The periods of a robot whose commands act ``delay`` periods late; commands change every few ticks."""
    random, state, history, found = (
        np.random.default_rng(seed),
        np.array([0.0, 0.0, 0.3, 0.5]),
        CommandHistory(model),
        [],
    )
    commands = [(0.0, 0.0)]
    for tick in range(ticks):
        history.add(tick, tuple(state.tolist()), commands[-1], ())
        passed = history.last_transition(MAX_DELAY)
        if passed is not None:
            found.append(passed)
        new = (float(random.uniform(0.0, 1.5)), float(random.uniform(-0.3, 0.3))) if tick % 4 == 0 else commands[-1]
        commands.append(new)
        state = np.asarray(model.step(state, np.array(commands[max(0, len(commands) - 1 - delay)]), model.latent))
        state = state + noise * random.normal(size=4)
    return found


def after(periods: list[Transition], scale: float = 1.0, ranges: tuple[float, ...] = RANGES) -> DelayEstimator:
    delay = DelayEstimator(Prediction.of_model(CAR), [scale * width for width in ranges], CAR.period)
    for passed in periods:
        delay.observe(passed, LATENT_VALUES)
    return delay


@pytest.mark.parametrize("late", range(MAX_DELAY + 1))
def test_each_delay_is_found_within_a_second(late: int) -> None:
    found = after(way(CAR, late, 20, noise=1e-3))
    assert found.periods == late
    assert found.delay_to_compensate(0.0) == pytest.approx(
        (late - USUAL_DELAY) * CAR.period if late > TOLERATED_DELAY else 0.0
    )
    assert found.delay_to_compensate(late * CAR.period) == late * CAR.period, "reported already"


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_the_unit_of_the_state_does_not_matter(unit: float) -> None:
    delay = DelayEstimator(Prediction(lambda x: (x, np.array([[0.05 * unit]]))), [2.0], 0.05)
    random, x, commands = np.random.default_rng(5), 0.0, [0.0] * (MAX_DELAY + 1)
    for tick in range(60):
        commands.append(float(random.uniform(-1.0, 1.0)) if tick % 3 == 0 else commands[-1])
        before, x = x, x + 0.05 * unit * commands[-4]
        known = tuple(((commands[-1 - n],), None) for n in range(MAX_DELAY + 1))
        delay.observe(Transition((before,), (x,), known), None)
    assert delay.periods == 3


def refuted_by_all_that_was_seen(periods: list[Transition]) -> list[int]:
    """What is to be believed after each period, from the whole past at once.

    Of the periods in which a command differs from another one by more than a hundredth of its range the last counts
    whole and one n of them before by exp(-n period / 2 s); a delay is refuted while another one's likelihood, with
    errors of unknown size in each state, is more than e^24 times its own,
    or e^16 times where it is longer than 0.2 s; nothing is believed before six count.
    """
    errors: list[np.ndarray] = []
    believed, reported = 0, []
    for passed in periods:
        commands = np.array([command for command, _ in passed.commands])
        if (np.ptp(commands, axis=0) > 0.01 * np.array(RANGES)).any():
            reached = [CAR.step(np.array(passed.before), command, CAR.latent) for command in commands]
            errors.append(np.array(passed.now) - np.array(reached))
        weights = np.exp(-np.arange(len(errors))[::-1] * CAR.period / 2.0)
        if weights.sum() >= 6.0:
            variances = np.average(np.array(errors) ** 2, axis=0, weights=weights)
            likelihood = -0.5 * weights.sum() * np.log(variances).sum(axis=1)
            left = np.flatnonzero(likelihood >= likelihood.max() - 24.0)
            believed = believed if believed in left else int(left[0])
            likely = np.flatnonzero(likelihood >= likelihood.max() - 16.0)
            believed = max(believed, int(likely[0])) if likely[0] >= 5 else believed
        reported.append(believed)
    return reported


@pytest.mark.parametrize(("seed", "noise"), list(enumerate((0.01, 0.02, 0.03, 0.03, 0.02, 0.03, 1e-5))))
def test_what_is_believed_is_what_the_whole_past_at_once_says(seed: int, noise: float) -> None:
    """Delays that change, with pauses in which commands tell nothing; noise makes the evidence come slowly."""
    at_rest = Transition((1.0, 0.0, 0.0, 0.7), (1.0, 0.1, 0.0, 0.7), (((0.7, 0.0), None),) * (MAX_DELAY + 1))
    periods = [
        period
        for place, late in enumerate((1, 5, 7, 3))
        for period in [*way(CAR, late, 50, 10 * seed + place, noise)[MAX_DELAY:], *[at_rest] * 9]
    ]
    found, reported = after([]), []
    assert found.periods == 0
    for passed in periods:
        found.observe(passed, LATENT_VALUES)
        reported.append(found.periods)
    assert reported == refuted_by_all_that_was_seen(periods)
    assert len(set(reported)) > 2


def test_three_periods_are_acted_upon_two_are_not_and_the_only_one_that_explains_everything_is_found() -> None:
    """Of 0.05 s each; a delay of 10 is the longest that is looked for. What the robot reports counts as known."""
    found = after([])
    for periods, reported, seconds in ((2, 0.0, 0.0), (3, 0.0, 0.1), (3, 0.05, 0.05), (4, 0.05, 0.15), (8, 0.0, 0.35)):
        found.periods = periods
        assert found.delay_to_compensate(reported) == pytest.approx(seconds)
    assert MAX_DELAY * CAR.period == pytest.approx(0.5)
    # The car stands, exactly, and of the last commands none but the one of so many periods ago is to stand.
    for late in (0, 3):
        commands = tuple(((0.0, 0.0) if n == late else (1.0, 0.0), None) for n in range(MAX_DELAY + 1))
        assert after([Transition((0.0,) * 4, (0.0,) * 4, commands)] * 20).periods == late


def test_commands_of_either_sign_are_as_informative_and_less_than_a_hundredth_of_their_range_is_not() -> None:
    periods = way(CAR, 4, 40, noise=1e-3)
    assert after(periods, scale=200.0).periods == 0, "1.5 of a range of 520"
    assert after(periods, scale=50.0).periods == 4
    # Forwards and backwards alike, so that their largest and least sum up to nothing.
    periods, state = [], np.array([0.0, 0.0, 0.3, 0.0])
    speeds = [0.5 if tick // 3 % 2 else -0.5 for tick in range(60)]
    for tick in range(MAX_DELAY + 4, 60):
        commands = tuple(((speeds[tick - n], 0.0), None) for n in range(MAX_DELAY + 1))
        reached = np.asarray(CAR.step(state, np.array(commands[4][0]), CAR.latent))
        periods.append(Transition(tuple(state.tolist()), tuple(reached.tolist()), commands))
        state = reached
    assert after(periods).periods == 4


def test_what_is_believed_is_doubted_at_the_ends_and_a_longer_delay_is_taken_for_the_longest() -> None:
    found = after(way(CAR, MAX_DELAY, 40, noise=1e-3))
    assert found.periods == MAX_DELAY
    for passed in way(CAR, MAX_DELAY - 1, 120, 4, noise=1e-3)[MAX_DELAY:]:
        found.observe(passed, LATENT_VALUES)
    assert found.periods == MAX_DELAY - 1
    for passed in way(CAR, 1, 60, 5, noise=1e-3)[MAX_DELAY:]:
        found.observe(passed._replace(commands=passed.commands[:3]), LATENT_VALUES)
    assert found.periods == 1
    assert after(way(CAR, MAX_DELAY + 1, 40, noise=1e-3)).periods == MAX_DELAY


@pytest.mark.parametrize("seed", range(10))
def test_without_a_delay_none_is_found_however_noisy_the_measurement(seed: int) -> None:
    assert after(way(CAR, 0, 120, seed, noise=0.02)).periods <= TOLERATED_DELAY


def test_what_is_believed_stays_until_it_is_refuted() -> None:
    found = after(way(CAR, 4, 40, noise=1e-3))
    assert found.periods == 4
    at_rest = ((0.0, 0.0), None)
    still = Transition((0.0,) * 4, (0.0,) * 4, (at_rest,) * (MAX_DELAY + 1))
    for _ in range(200):
        found.observe(still, LATENT_VALUES)
    assert found.periods == 4, "commands that do not differ tell nothing"
    for passed in way(CAR, 0, 120, noise=1e-3)[MAX_DELAY:]:
        found.observe(passed, LATENT_VALUES)
    assert found.periods == 0


def test_after_ten_seconds_behind_one_delay_another_one_is_found_within_three() -> None:
    """What was seen long ago is forgotten, or a delay that changes would be found too late."""
    found = after(way(CAR, 4, 200, noise=1e-3))
    for passed in way(CAR, 0, MAX_DELAY + 60, 5, noise=1e-3)[MAX_DELAY:]:
        found.observe(passed, LATENT_VALUES)
    assert found.periods == 0


@pytest.mark.parametrize("broken", [np.nan, np.inf, 1e300])
def test_one_broken_number_says_nothing_and_spoils_nothing(broken: float) -> None:
    periods = way(CAR, 4, 40, noise=1e-3)
    bad = periods[8]._replace(now=(broken, *periods[8].now[1:]))
    assert after([*periods[:8], bad, *periods[8:]]).periods == 4
    for place in range(4):
        before = (*periods[8].before[:place], broken, *periods[8].before[place + 1 :])
        assert after([*periods[:8], periods[8]._replace(before=before), *periods[8:]]).periods == 4


def test_what_does_not_fit_says_nothing() -> None:
    periods = way(CAR, 4, 40, noise=1e-3)
    for bad in (
        periods[8]._replace(now=(*periods[8].now, 1.0)),
        periods[8]._replace(commands=(((1.0,), None), *periods[8].commands[1:])),
    ):
        assert after([bad, *periods]).periods == 4


def test_the_commands_of_before_a_gap_are_not_known() -> None:
    history = CommandHistory(CAR)
    for tick in range(3):
        history.add(tick, (0.0, 0.0, 0.0, 0.5), (0.0, 0.0), ())
    for tick in range(7, 12):
        history.add(tick, (0.0, 0.0, 0.0, 0.5), (float(tick), 0.0), ())
        assert history.last_transition(4) is None, "what was sent before the gap is not known"
    history.add(12, (0.0, 0.0, 0.0, 0.5), (12.0, 0.0), ())
    passed = history.last_transition(4)
    assert passed is not None
    assert [command[0] for command, _ in passed.commands] == [12.0, 11.0, 10.0, 9.0, 8.0]


def test_a_filtered_robot_looks_past_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_named("car")
    held = CalibratedModel(CAR, "m", uncalibrated(settings, "m"))
    robot = RobotSession.create(held, settings)
    assert robot.delay.delay_to_compensate(0.0) == 0.0
    monkeypatch.setattr(robot.delay, "periods", 4)
    drives = Lateness(0.15, reported="none").robot(900, "none")
    robot.observe_state(drives.state_message())
    assert robot.until_action == pytest.approx(3 * CAR.period)
    assert robot.pending.queue, "the commands in flight are known"


def test_a_reported_delay_is_not_counted_twice_and_the_verdict_reports_what_was_found() -> None:
    nodes = [AdaptationNode(CAR), PolicyNode(CAR), SafetyFilterNode(CAR, settings_named("car"))]
    ticks = list(drive(Lateness(0.2, reported="clock").robot(905, "box"), nodes, 60))
    assert "later than reported" not in ticks[-1].verdict.sentence
    nodes = [AdaptationNode(CAR), PolicyNode(CAR), SafetyFilterNode(CAR, settings_named("car"))]
    ticks = list(drive(Lateness(0.2, reported="none").robot(905, "box"), nodes, 30))
    assert "later than reported" not in ticks[3].verdict.sentence
    assert "later than reported" in ticks[-1].verdict.sentence
    assert ticks[-1].verdict.status == "fallback"


def decided(late: float, *, fails: bool) -> list[tuple[str, tuple[float, ...], str]]:
    """Status, action and sentence of 20 decisions, before which the 30th step failed or not."""
    node = SafetyFilterNode(CAR, settings_named("car"))
    robot, found = Lateness(late, reported="none").robot(905, "box"), []
    for tick in drive(robot, [AdaptationNode(CAR), PolicyNode(CAR), node], 50):
        if fails and tick.state.tick == 29:
            assert node.newest("r1") is not None
            node.rescue("r1", tick.state, "broken")
        found.append((tick.verdict.status, tick.verdict.action, tick.verdict.sentence))
    return found[30:]


@pytest.mark.parametrize("late", [0.0, 0.15, 0.2])
def test_a_failed_step_forgets_no_delay_no_command_and_no_state(late: float) -> None:
    assert decided(late, fails=True) == decided(late, fails=False)


@pytest.mark.parametrize("late", [0, 2, 3, 4])
def test_every_delay_up_to_the_stated_one_is_possible_until_the_motion_rules_it_out(late: int) -> None:
    found, stated = after([]), round(STATED_DELAY / CAR.period)
    assert found.possible_delays(0.0) == pytest.approx((CAR.period, stated * CAR.period))
    assert found.possible_delays(0.1) == pytest.approx((0.15, 0.25)), "beyond what is reported"
    found = after(way(CAR, late, 40, noise=1e-3))
    base = found.delay_to_compensate(0.0)
    within = {round(delay / CAR.period) for delay in (base, *found.possible_delays(0.0))}
    assert max(0, late - USUAL_DELAY) in within
    assert max(within) <= late, "longer ones are ruled out"


def test_periods_at_rest_make_a_delay_possible_and_only_those_in_motion_make_it_found() -> None:
    """A heavy load sticks for a while, as if its command came late."""
    found = after([])
    for passed in way(CAR, 6, 40, noise=1e-3):
        found.observe(passed, LATENT_VALUES, stationary=True)
    assert found.periods == 0
    assert max(found.possible_delays(0.0)) >= 5 * CAR.period


def test_the_message_says_that_predictions_hold_only_where_coverage_shows_it() -> None:
    found = after(way(CAR, 3, 40, noise=1e-3))
    assert "99.5 % of the last predictions held" in found.remark(0.995, 0.99)
    for coverage, promised in ((0.98, 0.99), (-1.0, 0.99), (1.0, -1.0)):
        assert "not confirmed" in found.remark(coverage, promised)


@pytest.mark.parametrize(("late", "brakes"), [(3, False), (4, False), (6, True), (8, True)])
def test_a_robot_brakes_for_a_delay_beyond_the_stated_one_until_it_is_reported(late: int, brakes: bool) -> None:
    found = after(way(CAR, late, 40, noise=1e-3))
    assert bool(found.too_long(0.0)) is brakes
    assert not found.too_long(late * CAR.period)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.1, 0.15, 0.2])
def test_hostile_drives_behind_an_unknown_delay_do_not_collide(seconds: float) -> None:
    found = delayed_drives(Lateness(seconds, reported="none"), 4, 900, 8.0, policy=hostile_driver)
    assert found.collided == 0
    assert found.statuses["corrected"] > 0


@pytest.mark.parametrize("broken", [1e200, -1e200])
def test_a_number_whose_square_is_none_spoils_nothing_however_early_it_comes(broken: float) -> None:
    """It is finite, and its square is not: a sum that is infinite once would stay so."""
    periods = way(CAR, 4, 40, noise=1e-3)
    for place in range(4):
        now = (*periods[0].now[:place], broken, *periods[0].now[place + 1 :])
        assert after([periods[0]._replace(now=now), *periods]).periods == 4


FAR = 1e6
"""m; a billionth of it is a millimetre."""


SHORT = 1e-18
"""s; over periods of it nothing is forgotten."""


def moved(state: Any, action: Any) -> Any:
    """A point that an action moves by itself. Refuses what is not finite, as a function of a user's may."""
    if not np.isfinite([*state, *action]).all():
        raise InputError("not finite")
    return np.array([entry + action[0] for entry in state])


def delay(period: float = 0.05, width: float = 1e-6) -> DelayEstimator:
    return DelayEstimator(Prediction(lambda state: (state, np.ones((len(state), 1))), moved), [width], period)


def stayed(place: float, away: float, late: int = 3) -> Transition:
    """A period in which the point stayed, as the command of ``late`` periods before alone says: the others move it."""
    return Transition((place,), (place,), tuple(((0.0 if n == late else away,), None) for n in range(5)))


@pytest.mark.parametrize(
    ("before", "now", "speeds", "stood"),
    [
        ((9.0, 0.0), (9.0, 0.0), (1,), True),
        ((9.0, 0.1), (9.0, -0.1), (1,), True),
        ((9.0, -0.09), (9.0, 0.09), (1,), True),
        ((9.0, 0.11), (9.0, 0.0), (1,), False),
        ((9.0, 0.0), (9.0, -0.11), (1,), False),
        ((9.0, 0.5), (9.0, 0.5), (1,), False),
        ((9.0, 0.05, 0.0), (9.0, 0.05, 0.0), (1, 2), True),
        ((9.0, 0.05, 0.0), (9.0, 0.05, 0.2), (1, 2), False),
        ((9.0, 0.2, 0.0), (9.0, 0.05, 0.0), (1, 2), False),
        ((9.0, 0.0), (9.0, 0.0), (), False),
        ((9.0, 0.0), (9.0, 0.0, 0.0), (1,), False),
        ((9.0, 0.0, 0.0), (9.0, 0.0), (1,), False),
        ((9.0, 0.0), (9.0, 0.0), (2,), False),
        ((9.0, 0.0), (9.0, 0.0), (1, 2), False),
    ],
)
def test_a_robot_below_a_tenth_of_a_metre_per_second_at_both_ends_was_stationary(before, now, speeds, stood):
    """Of what has no speeds, or is no state, that is not known."""
    assert Transition(before, now, ()).is_stationary(speeds) is stood


def test_six_periods_that_count_are_enough_where_one_delay_alone_explains_them() -> None:
    found, reported = delay(SHORT), list[int]()
    for _ in range(8):
        found.observe(stayed(0.0, 1.0), None)
        reported.append(found.periods)
    assert reported == [0, 0, 0, 0, 0, 3, 3, 3]


@pytest.mark.parametrize(("away", "reports"), [(1.0, False), (-1.0, False), (1.0 + 1e-9, True), (-1.0 - 1e-9, True)])
def test_commands_have_to_differ_by_more_than_a_hundredth_of_their_range(away: float, reports: bool) -> None:
    found = delay(width=100.0)
    for _ in range(20):
        found.observe(stayed(0.0, away), None)
    assert found.periods == (3 if reports else 0)


@pytest.mark.parametrize(("place", "periods"), [(0.0, 3), (FAR, 0), (-FAR, 0)])
def test_an_error_of_a_billionth_of_the_state_is_no_evidence(place: float, periods: int) -> None:
    """Far from the origin the numbers say no more; at the origin the same error refutes all delays but one."""
    found = delay()
    for _ in range(200):
        found.observe(stayed(place, 1.05e-9 * FAR), None)
    assert found.periods == periods


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_model_that_refuses_numbers_is_not_asked_about_what_is_not_finite(broken: float) -> None:
    found = delay()
    period = stayed(0.0, 1.0)._replace(before=(0.0, 0.0), now=(0.0, 0.0))
    for _ in range(5):
        found.observe(period, None)
    for place in range(2):
        bad = tuple(broken if index == place else 0.0 for index in range(2))
        found.observe(period._replace(before=bad), None)
        found.observe(period._replace(now=bad), None)
    assert found.periods == 0, "five periods count, and the broken ones do not"
    for _ in range(2):
        found.observe(period, None)
    assert found.periods == 3
