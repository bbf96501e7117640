"""What a session remembers: it believes plausible states, predicts lost ones, and reports why a robot stays."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa import InputError
from safedpa.dynamics import load_model
from safedpa.safety import (
    Evidence,
    FilterSession,
    FilterSettings,
    FunctionBarrier,
    SafetyFilter,
    StateLimits,
    check_filter,
    limits_from_evidence,
)
from safedpa.safety.session.plausibility import ClockMonitor, StateMonitor
from safedpa.systems import System, Variable

PERIOD = 0.05
A = np.array([[1.0, PERIOD], [0.0, 1.0]])
B = np.array([[0.5 * PERIOD**2], [PERIOD]])
MASS = System(
    "mass", (Variable("x", "m", -50.0, 50.0), Variable("v", "m/s", -5.0, 5.0)), (Variable("a", "m/s2", -2.0, 2.0),)
)
LIMITS = StateLimits(jump={"m": 0.05, "m/s": 0.3}, drift={"m": 0.08}, unanswered={"m": 0.05})


def brake(x: Any) -> list[float]:
    return [0.0 if x is None else float(np.clip(-x[1] / PERIOD, -2.0, 2.0))]


def filter_of_the_mass(backup: Any = brake) -> SafetyFilter:
    """A wall at 3 m; h is the room that is left after braking."""
    wall = FunctionBarrier(lambda x: 3.0 - x[0] - 0.1 * max(x[1], 0.0) - max(x[1], 0.0) ** 2 / 3.6, kind="wall")
    settings = FilterSettings(action_low=(-2.0,), action_high=(2.0,), epsilon={"wall": 0.01})
    return SafetyFilter(lambda x: (A @ x, B), [wall], settings, backup=backup)


def session_of_the_mass(limits: StateLimits | None = LIMITS, backup: Any = brake) -> FilterSession:
    return FilterSession(filter_of_the_mass(backup), period=PERIOD, system=MASS, limits=limits)


def drive(
    decide: Callable[..., Any], measure: Callable[[int, np.ndarray], Any], ticks: int = 160
) -> Iterator[tuple[int, np.ndarray, Any]]:
    """The true state and the verdict of each tick; the nominal action asks for full thrust towards the wall."""
    x = np.zeros(2)
    for tick in range(ticks):
        verdict = decide(measure(tick, x), [2.0])
        yield tick, x, verdict
        x = A @ x + B @ verdict.action


def from_tick(begin: int, wrong: Callable[[int, np.ndarray], Any]) -> Callable[[int, np.ndarray], Any]:
    return lambda tick, x: wrong(tick - begin, x) if tick >= begin else x


FAULTS: dict[str, tuple[int, Callable[[int, np.ndarray], Any], tuple[str, ...]]] = {
    "jump": (20, lambda _, x: x - [0.8, 0.0], ("jumped by 0.8 m",)),
    "restart": (20, lambda k, x: x - [0.9, 0.0], ("jumped",)),
    "frozen while moving": (20, lambda k, x: np.array([1.0, 2.0]), ("does not change", "rates differ")),
    "frozen at rest": (0, lambda k, x: np.zeros(2), ("does not change although the commands should have moved it",)),
    "drift": (20, lambda k, x: x - [0.05 * PERIOD * k, 0.0], ("its position and its rates differ",)),
    "speed": (20, lambda k, x: x * [1.0, 0.5], ("jumped by",)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_state_that_contradicts_the_ones_before_stops_the_robot_until_it_is_confirmed(fault: str) -> None:
    begin, wrong, reasons = FAULTS[fault]
    session, furthest, speed = session_of_the_mass(), 0.0, 0.0
    for tick, x, verdict in drive(session.decide, from_tick(begin, wrong)):
        assert session.latched == "" or tick >= begin
        assert not session.latched or verdict.status.value == "fallback"
        furthest, speed = max(furthest, x[0]), x[1]
    assert any(reason in session.latched for reason in reasons), session.latched
    assert furthest < 3.0
    assert abs(speed) < 0.05
    session.confirm()
    assert session.decide([0.0, 0.0], [1.0]).status.value == "passed"
    assert session.decide([0.00125, 0.05], [1.0]).status.value == "passed"


def test_without_limits_the_same_faults_are_believed_and_hit_the_wall() -> None:
    session = session_of_the_mass(None)
    assert max(x[0] for _, x, _ in drive(session.decide, from_tick(20, FAULTS["jump"][1]))) > 3.0


def test_healthy_states_are_decided_as_without_a_session() -> None:
    session, plain = session_of_the_mass(), filter_of_the_mass()
    for _, x, verdict in drive(session.decide, lambda _, x: x):
        assert verdict.action.tolist() == plain.decide(x, [2.0]).action.tolist()
    assert (session.latched, session.problem, session.lost) == ("", "", 0)


@pytest.mark.parametrize("seconds", [0.25, 1.0, 5.0])
@pytest.mark.parametrize("nothing", [None, [np.nan, np.nan]])
def test_a_lost_state_is_predicted_and_the_robot_brakes_along_it(seconds: float, nothing: Any) -> None:
    """Lost where the mass must brake to stay clear of the wall; the plain filter lets it coast."""
    first, last = 30, 30 + round(seconds / PERIOD)

    def measured(tick: int, x: np.ndarray) -> Any:
        return nothing if first <= tick < last else x

    session = session_of_the_mass()
    found = list(drive(session.decide, measured))
    assert max(x[0] for _, x, _ in found) < 3.0
    assert found[-1][1][0] > 2.5, "it drives on when the state is back"
    assert session.latched == ""
    if seconds > 1.0:
        assert max(x[0] for _, x, _ in drive(filter_of_the_mass().decide, measured)) > 3.0
        assert abs(found[last - 1][1][1]) < 0.01, "at rest before the state returns"


def throttle_session() -> FilterSession:
    def backup(x: Any) -> Any:
        return np.array([0.0 if x is None else np.clip(-5.0 * x[3], -1.0, 1.0), 0.0])

    settings = FilterSettings(action_low=(-1.0, -0.4), action_high=(1.0, 0.4), epsilon={"wall": 0.0})
    wall = FunctionBarrier(lambda x: 50.0 - x[0], kind="wall")
    safe = SafetyFilter.for_model(load_model("dart_car"), settings, [wall], backup=backup)
    return FilterSession(safe, limits=StateLimits(jump={"m": 0.3, "rad": 0.5, "m/s": 0.8}))


def throttle_drive(measured_until: int, estimate: Callable[[int], float], *, frozen: bool = False) -> list[float]:
    """The speeds of a car with a throttle, whose state is measured for some ticks and then lost or frozen."""
    session, model = throttle_session(), load_model("dart_car")
    x, seen, speeds = np.array([0.0, 0.0, 0.0, 1.5]), np.zeros(4), []
    for tick in range(measured_until + 60):
        seen = x if tick < measured_until else seen
        state = seen if frozen or tick < measured_until else None
        verdict = session.decide(state, [0.0, 0.0], [estimate(tick)])
        x = model.step(x, verdict.action)
        speeds.append(float(x[3]))
    return speeds


def test_a_weak_estimate_does_not_make_a_robot_without_a_state_brake_until_it_reverses() -> None:
    speeds = throttle_drive(20, lambda tick: 1.0)
    assert speeds[19] > 1.0
    assert speeds[-1] == pytest.approx(0.0, abs=0.3)
    assert min(speeds) > -0.3


def test_a_robot_that_starts_while_its_state_is_lost_is_braked() -> None:
    """It was at rest when it was last measured, and followed its nominal action for ``GRACE``."""
    session, x, actions = throttle_session(), np.zeros(4), []
    for tick in range(30):
        verdict = session.decide(x if tick < 2 else None, [0.8 if tick else 0.0, 0.0], [3.0])
        actions.append(float(verdict.action[0]))
        x = load_model("dart_car").step(x, verdict.action)
    assert min(actions) < -0.5
    assert abs(x[3]) < 0.3


def test_a_robot_without_a_state_brakes_whatever_its_latent_is() -> None:
    for wrong in ([4.48], ["a"], [np.nan], [1.0, 2.0], 4.48, object()):
        session, x = throttle_session(), [0.0, 0.0, 0.0, 1.5]
        session.decide(x, [0.0, 0.0], [4.48])
        for _ in range(6):
            verdict = session.decide(None, [0.0, 0.0], wrong)
        assert verdict.status.value == "fallback"
        assert verdict.action[0] < 0.0


def test_an_estimate_from_frozen_states_is_not_used() -> None:
    """Frozen states say that no command moves the robot; ``model.latent`` is right here."""
    speeds = throttle_drive(20, lambda tick: 4.48 if tick < 22 else 0.5, frozen=True)
    assert speeds[19] > 1.0
    assert speeds[-1] == pytest.approx(0.0, abs=0.3)
    assert min(speeds) > -0.3


def test_the_margin_grows_with_each_lost_state() -> None:
    session = session_of_the_mass()
    session.decide([0.0, 0.5], [0.0])
    grown = []
    for _ in range(3):
        session.decide(None, [0.0])
        grown.append(session.epsilon["wall"])
    assert grown == pytest.approx([0.02, 0.03, 0.04])


def test_a_session_that_never_had_a_state_takes_the_fallback() -> None:
    verdict = session_of_the_mass().decide(None, [1.0])
    assert (verdict.status.value, verdict.action.tolist()) == ("fallback", [0.0])


def test_a_unicycle_with_a_plain_distance_is_reported_within_two_seconds() -> None:
    def affine(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x.copy(), PERIOD * np.array([[np.cos(x[2]), 0.0], [np.sin(x[2]), 0.0], [0.0, 1.0]])

    ahead = FunctionBarrier(lambda x: np.hypot(x[0] - 2.0, x[1]) - 0.5, kind="disc")
    settings = FilterSettings(action_low=(-1.0, -2.0), action_high=(1.0, 2.0), epsilon={"disc": 0.01})
    session = FilterSession(SafetyFilter(affine, [ahead], settings), period=PERIOD, states=3)
    x, slow, reported = np.zeros(3), 0.0, -1.0
    for tick in range(200):
        verdict = session.decide(x, [1.0, 0.0])
        f, g = affine(x)
        following = f + g @ verdict.action
        if not slow and np.hypot(*(following - x)[:2]) < 0.1 * PERIOD:
            slow = tick * PERIOD
        if reported < 0.0 and session.stationary_because:
            reported = tick * PERIOD
            assert "boxed in" in verdict.reason
        x = following
    assert 0.0 <= reported - slow <= 2.0


def test_a_repeated_message_is_predicted_through_and_a_state_that_stays_so_is_frozen() -> None:
    session, held = session_of_the_mass(), np.array([0.5, 1.0])
    session.decide([0.45, 1.0], [0.0])
    session.decide(held, [0.0])
    assert "repeats the one before" in session.decide(held, [0.0]).reason
    assert session.decide([0.6, 1.0], [0.0]).status.value == "passed", "the source goes on"
    for _ in range(3):
        session.decide([0.6, 1.0], [0.0])
    assert "its own rates say that it moves" in session.latched


def test_a_state_that_says_that_it_has_become_older_is_no_frozen_one() -> None:
    session = session_of_the_mass()
    for age in (0.0, 0.05, 0.1, 0.15):
        session.decide([0.5, 1.0], [0.0], until_action=age)
    assert session.latched == ""


def test_rates_that_commands_should_have_caused_find_a_frozen_state_before_the_position_does() -> None:
    found = []
    for rates in ({}, {"m/s": 0.2}):
        session = session_of_the_mass(replace(LIMITS, unanswered={"m": 0.05, **rates}))
        found.append([x[0] for _, x, _ in drive(session.decide, lambda *_: np.zeros(2)) if not session.latched][-1])
    assert found[1] < 0.75 * found[0]


@pytest.mark.parametrize(("noise", "found"), [(0.005, True), (0.0005, False), (0.0, False)])
def test_equal_states_are_frozen_sooner_if_the_source_has_shown_its_noise_at_rest(noise: float, found: bool) -> None:
    """Otherwise they may be those of a robot whose commands act late."""
    monitor = StateMonitor(MASS, StateLimits(jump={"m": 0.05, "m/s": 0.3}, unanswered={"m/s": 0.5}), PERIOD)
    before = (0.0, 0.0)
    for tick in range(60):
        values = (noise * (-1) ** tick, 0.0)
        monitor.accept(values, monitor.observe(values, before, before, before))
        before = values
    commanded = (before[0], 0.8 * 0.5)
    evidence = monitor.observe(before, before, before, commanded)
    assert bool(monitor.problem(evidence).text) is found


def test_a_robot_that_brakes_harder_than_its_model_is_believed_again_after_lost_states() -> None:
    """The true brake is twice as strong: without the limit, the next measured state contradicts the prediction."""
    latched = []
    for overbraking in (0.0, 0.2):
        limits = replace(LIMITS, jump={"m": 0.02, "m/s": 0.05}, overbraking={"m/s": overbraking})
        session = session_of_the_mass(limits)
        x = np.zeros(2)
        for tick in range(40):
            verdict = session.decide(None if 20 <= tick < 30 else x, [2.0 if tick < 20 else 0.0])
            x = A @ x + B @ (verdict.action * (2.0 if verdict.action[0] < 0.0 else 1.0))
        latched.append(bool(session.latched))
    assert latched == [True, False]


def test_after_a_pause_a_resting_robot_has_the_same_heading() -> None:
    car = System(
        "own",
        (Variable("x", "m", -9.0, 9.0), Variable("yaw", "rad", -4.0, 4.0), Variable("v", "m/s", -2.0, 2.0)),
        (Variable("a", "m/s2", -2.0, 2.0),),
    )
    safe = SafetyFilter(
        lambda x: (x.copy(), np.array([[0.0], [0.0], [PERIOD]])),
        [FunctionBarrier(lambda x: 3.0 - x[0], kind="wall")],
        FilterSettings(action_low=(-2.0,), action_high=(2.0,), epsilon={"wall": 0.0}),
    )
    limits = StateLimits(jump={"m": 0.1, "rad": 0.1, "m/s": 0.3})
    for speed, turned in ((0.0, True), (1.0, False)):
        session = FilterSession(safe, period=PERIOD, system=car, limits=limits)
        session.decide([0.0, 0.0, speed], [0.0], time=0.0)
        session.decide([0.0, 1.0, speed], [0.0], time=1.0)
        assert ("it moved by 1 rad" in session.latched) is turned


# clocks
@pytest.mark.parametrize(("rate", "wrong"), [(0.3, True), (3.0, True), (0.8, False), (1.0, False), (1.25, False)])
def test_stamps_at_another_rate_than_the_arrivals_stop_the_robot(rate: float, wrong: bool) -> None:
    session, ticks = session_of_the_mass(), 0
    while not session.latched and ticks < 100:
        session.decide([0.0, 0.0], [0.0], time=PERIOD * ticks, arrived=7.0 + PERIOD * ticks / rate)
        ticks += 1
    assert ("its stamps advance" in session.latched) is wrong
    assert not wrong or ticks * PERIOD <= 1.0


@pytest.mark.parametrize("held_up", [0.3, 1.0, 4.0])
def test_a_robot_that_was_held_up_and_catches_up_has_no_other_clock(held_up: float) -> None:
    monitor, late = ClockMonitor(), 0.0
    for tick in range(300):
        late = held_up if tick == 100 else max(0.0, late - 0.8 * PERIOD)
        assert monitor.observe(PERIOD * tick, PERIOD * tick + late) == ""


@pytest.mark.parametrize("rate", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("interval", [0.02, 0.05, 0.16])
def test_states_that_fall_behind_are_reported_within_0_3_s_of_their_arrivals(rate: float, interval: float) -> None:
    monitor, arrived = ClockMonitor(), 0.0
    while not monitor.behind:
        assert arrived - interval <= max(0.3, 0.21 / (1.0 - rate))
        arrived += interval
        monitor.observe(rate * arrived, arrived)
    assert monitor.lag == pytest.approx((1.0 - rate) * (arrived - interval))
    for _ in range(200):  # the clock is right again
        arrived += interval
        monitor.observe(arrived, arrived)
    assert (monitor.behind, monitor.lag) == ("", 0.0)


def test_a_state_that_was_held_up_is_as_old_as_its_stamp_says_until_the_source_has_caught_up() -> None:
    monitor = ClockMonitor()
    for tick, late in enumerate([0.0, 0.0, 1.3, 1.28, 1.24, 1.24]):
        monitor.observe(PERIOD * tick, PERIOD * tick + late)
        assert monitor.lag == pytest.approx(late)


@given(st.lists(st.floats(0.0, 0.3), min_size=20, max_size=60), st.integers(1, 8))
def test_late_messages_and_bursts_are_no_other_rate(late: list[float], burst: int) -> None:
    """Each message arrives after its measurement, up to 0.3 s late and never before an earlier one."""
    monitor, arrived = ClockMonitor(), 0.0
    for tick, seconds in enumerate(late):
        sent = PERIOD * (burst * (tick // burst) + burst)
        arrived = max(arrived + 1e-4, sent + 0.1 * seconds)
        if burst * PERIOD < 0.2:
            assert monitor.observe(PERIOD * tick, arrived) == ""


@pytest.mark.parametrize("stamps", [[0.0, 1e9, 1e9 + 0.05, 0.1, 0.15], [0.0] * 20, [5.0, 4.0, 3.0, 2.0, 1.0]])
def test_a_clock_that_is_set_shows_no_rate(stamps: list[float]) -> None:
    monitor = ClockMonitor()
    assert not any(monitor.observe(stamp, PERIOD * tick) for tick, stamp in enumerate(stamps))


@pytest.mark.parametrize("interval", [0.02, 0.05])
def test_a_fast_clock_brakes_the_robot_within_0_3_s_of_its_stamps(interval: float) -> None:
    monitor, stamp, arrived = ClockMonitor(), 0.0, 0.0
    while stamp < 3.0:
        stamp, arrived = stamp + interval, arrived + interval
        monitor.observe(stamp, arrived)
        assert monitor.ahead == ""
    while not monitor.ahead:
        assert stamp <= 3.3
        stamp, arrived = stamp + interval, arrived + interval / 3.0
        monitor.observe(stamp, arrived)
    assert monitor.ahead.startswith("its stamps advance 3 times as fast")
    for _ in range(round(2.0 / interval) + 1):  # the clock is right again
        stamp, arrived = stamp + interval, arrived + interval
        monitor.observe(stamp, arrived)
    assert monitor.ahead == ""


@pytest.mark.parametrize("held_up", [0.3, 1.0, 4.0])
def test_a_robot_that_was_late_and_catches_up_is_not_ahead(held_up: float) -> None:
    monitor, late = ClockMonitor(), 0.0
    for tick in range(300):
        late = held_up if tick == 100 else max(0.0, late - 0.8 * PERIOD)
        monitor.observe(PERIOD * tick, PERIOD * tick + late)
        assert monitor.ahead == ""


@pytest.mark.parametrize(("speed", "found"), [(0.05, True), (0.01, False)])
def test_a_position_that_drifts_slowly_is_found_while_the_robot_rests(speed: float, found: bool) -> None:
    """Within two seconds it drifts by less than the limit."""
    session = session_of_the_mass(replace(LIMITS, drift={"m": 0.15}))
    random = np.random.default_rng(5)
    for tick in range(200):
        session.decide([speed * PERIOD * tick + 0.005 * random.normal(), 0.005 * random.normal()], [0.0])
        if session.latched:
            break
    assert ("while it rests" in session.latched) is found
    assert not found or tick * PERIOD <= 4.0


@pytest.mark.parametrize(("speed", "found"), [(0.05, True), (0.01, False)])
def test_a_position_that_drifts_slowly_is_found_while_the_robot_moves(speed: float, found: bool) -> None:
    """It drifts by less than the limit within two seconds, and with noise; without a rate it could be any motion."""
    session = session_of_the_mass(replace(LIMITS, jump={"m": 0.1, "m/s": 0.3}, drift={"m": 0.16}))
    random, x = np.random.default_rng(7), np.array([-40.0, 0.5])
    for tick in range(200):
        late = max(0, tick - 40) * PERIOD
        verdict = session.decide(
            x + [speed * late, 0.0] + [0.01, 0.02] * random.normal(size=2), [0.3 - 0.6 * (tick % 2)]
        )
        if session.latched:
            break
        x = A @ x + B @ verdict.action
    assert ("within 4 s" in session.latched) is found
    assert not found or late <= 3.0


# limits
def test_limits_from_healthy_drives_believe_them_and_their_file_reads_back(tmp_path: Path) -> None:
    rows = [Evidence({"m": size}, {"m": (2.0 * size, way)}, {"m": 0.0}) for size, way in ((0.01, 0.0), (0.02, 3.0))]
    limits = limits_from_evidence(rows, reserve=1.0)
    assert limits.jump == {"m": 0.02}
    assert limits.drift["m"] >= 0.02
    assert limits.drift["m"] + limits.drift_share["m"] * 3.0 >= 0.04
    assert limits_from_evidence(rows[:1]).drift_share == {"m": 0.0}
    file = tmp_path / "limits.toml"
    file.write_text(limits.text("two states"), encoding="utf-8")
    assert StateLimits.load(file) == limits


@pytest.mark.parametrize(
    ("text", "notice"),
    [
        ("format = 2\n", "format"),
        ("format = 1\n[jumps]\nm = 1.0\n", "jumps: unknown key"),
        ("format = 1\n[jump]\nm = -1.0\n", "wanted a number >= 0"),
        ('format = 1\njump = "far"\n', "wanted numbers by unit"),
    ],
)
def test_a_file_that_holds_no_limits_is_refused_by_key(text: str, notice: str, tmp_path: Path) -> None:
    file = tmp_path / "limits.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=notice):
        StateLimits.load(file)


def test_the_bounds_of_a_system_imply_how_far_a_position_moves_in_a_period() -> None:
    assert StateLimits.of_system(MASS, 0.1).jump == {"m": 0.5}


@pytest.mark.parametrize(
    ("arguments", "notice"), [({}, "period"), ({"period": -1.0}, "period"), ({"period": 0.1}, "states")]
)
def test_a_session_of_functions_asks_for_what_it_cannot_know(arguments: dict[str, float], notice: str) -> None:
    with pytest.raises(InputError, match=notice):
        FilterSession(filter_of_the_mass(), **arguments)  # type: ignore[arg-type]


def test_a_fallback_that_coasts_without_a_state_is_an_issue_of_a_filter_and_none_of_a_session() -> None:
    states = [[0.0, 0.0], [0.0, 1.0]]
    assert "lost state" in check_filter(filter_of_the_mass(), states).subjects
    assert "lost state" not in check_filter(session_of_the_mass(), states).subjects


@pytest.mark.parametrize(("speed", "moved", "latched"), [(4.0, 7.0, False), (4.0, 11.0, True), (0.0, 0.8, True)])
def test_after_a_pause_a_state_is_believed_as_far_away_as_the_rates_allow(
    speed: float, moved: float, latched: bool
) -> None:
    session = session_of_the_mass()
    session.decide([-44.8 - PERIOD * speed, speed], [0.0], time=0.0)
    session.decide([-44.8, speed], [0.0], time=PERIOD)
    session.decide([-44.8 + moved, 0.0], [0.0], time=2.0)
    assert bool(session.latched) is latched


@pytest.mark.parametrize("lost", [0, 3])
@pytest.mark.parametrize(("late", "latched"), [(0, False), (3, False), (8, True)])
def test_commands_that_act_up_to_an_allowed_delay_later_are_no_jump(late: int, latched: bool, lost: int) -> None:
    """Also if every so many states are lost."""
    session = session_of_the_mass(StateLimits(jump={"m/s": 0.02}))
    sent, x = [0.0] * 8, np.array([-40.0, 0.5])
    for tick in range(40):
        given_state = None if lost and tick % lost == 1 else x
        sent.append(float(session.decide(given_state, [2.0 if tick // 8 % 2 else -2.0]).action[0]))
        x = A @ x + B @ [sent[-1 - late]]
    assert bool(session.latched) is latched


@pytest.mark.parametrize("backup", [brake, lambda x: [50.0 * value for value in brake(x)]])
def test_a_robot_that_braked_by_itself_during_a_pause_is_not_braked_into_reverse_without_a_state(backup: Any) -> None:
    """Its backup may ask for more than the bounds."""
    session = session_of_the_mass(backup=backup)
    for tick in range(2):
        session.decide([-40.0 + PERIOD * tick, 1.0], [0.0], time=PERIOD * tick)
    for tick in range(30, 40):
        verdict = session.decide(None, [2.0], time=PERIOD * tick, applied=[-0.5] if tick == 30 else None)
        assert abs(verdict.action[0]) <= 0.5, "it rests since half a second after the pause began"
    session.decide([-39.5, 0.0], [2.0], time=PERIOD * 40)
    assert session.latched == ""


def test_commands_from_before_a_pause_have_acted_when_it_ends() -> None:
    """The mass braked by itself in the pause, and rests when it is asked again."""
    session = session_of_the_mass(StateLimits(jump={"m": 1.0}, unanswered={"m/s": 0.2}))
    for tick in range(10):
        session.decide([-40.0 + 0.5 * 2.0 * (PERIOD * tick) ** 2, 2.0 * PERIOD * tick], [2.0], time=PERIOD * tick)
    for tick in range(40, 44):
        applied = [0.0] if tick == 40 else None
        session.decide([-39.5, 0.0], [2.0], time=PERIOD * tick, applied=applied)
    assert session.latched == ""
