"""Who stands in the margin's layer is led out by an action that is held, where the predictions say so."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety import FilterSettings, Status, Verdict
from safedpa.safety.deadlock.escape import DeadlockEscape, TickContext
from safedpa.safety.defaults import settings_named
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.verdict import resting_verdict
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(0.0,), eta=0.5)
PERIOD = 0.1

HValues = Callable[[float, int], list[float]]
"""h after so many ticks under an action."""


def way_out() -> DeadlockEscape:
    low, high = SETTINGS.low, SETTINGS.high
    return DeadlockEscape(SETTINGS, QuadraticProgram(low, high, SETTINGS.weight_vector))


def here(
    tick: int, heights: HValues, known: int = 99, fails: float = 0.0, now: int = 0, margins: list[float] | None = None
) -> TickContext:
    """At the ``now``-th tick of a manoeuvre; the model has numbers for ``known`` ticks."""

    def ahead(action: Sequence[float]) -> Iterator[list[float]]:
        return (heights(action[0], now + index + 1) for index in range(known))

    at = heights(0.0, 0) if now == 0 else heights(1.0, now)
    return TickContext(tick, PERIOD, at, margins or [0.1] * len(at), ahead, lambda action: abs(action[0]) <= fails)


def verdict(status: Status = Status.relaxed, nominal: float = -1.0) -> Verdict:
    return replace(resting_verdict(np.zeros(1), "none"), status=status, nominal=np.array([nominal]), h_next=0.19)


def led(out: DeadlockEscape, heights: HValues, ticks: int = 3, stood: float = 1.0, **known: float) -> Verdict:
    """The verdict after so many ticks of standing."""
    for tick in range(ticks):
        found = out.replace_verdict(verdict(), here(tick, heights, **known), stood)  # type: ignore[arg-type]
    return found


def dips(action: float, ticks: int) -> list[float]:
    """0.19 now; forwards it falls by 0.001 a tick for three ticks, then rises with the action."""
    return [0.19 - 0.001 * min(ticks, 3) + 0.01 * max(0.0, action) * max(0, ticks - 3)]


def test_a_manoeuvre_that_raises_h_later_is_held() -> None:
    found = led(way_out(), dips)
    assert found.status is Status.relaxed
    assert found.action[0] == 1.0, "the one that leads furthest"
    assert found.h_next == pytest.approx(0.189)
    assert found.slack == pytest.approx(0.5 * 0.19 + 0.1 - 0.189)
    assert "leads out" in found.reason
    assert not found.action.flags.writeable


def test_it_is_judged_again_in_every_tick_and_ends_where_its_predictions_do() -> None:
    out = way_out()
    led(out, dips, ticks=1)
    taken = [out.replace_verdict(verdict(), here(tick, dips, now=tick), 0.0).action[0] for tick in range(1, 20)]
    assert taken == [1.0] * 14 + [0.0] * 5, "for 1.5 s at most"


@pytest.mark.parametrize(
    "changed",
    [
        lambda action, ticks: [0.09 - 0.001 * ticks],  # h measured lower than half the layer, and falling
        lambda action, ticks: [0.19 - 0.001 * ticks],  # it leads nowhere any more
    ],
)
def test_it_ends_if_the_measured_state_contradicts_the_prediction(changed: HValues) -> None:
    out = way_out()
    led(out, dips, ticks=1)
    assert out.replace_verdict(verdict(), here(1, dips, now=1), 1.0).action[0] == 1.0
    assert out.replace_verdict(verdict(), here(2, changed, now=2), 0.0).action[0] == 0.0
    assert out.replace_verdict(verdict(), here(3, dips, now=3), 0.0).action[0] == 0.0, "and is not taken up again"


@pytest.mark.parametrize("tick", [0, 2])
def test_it_ends_where_a_tick_is_missing(tick: int) -> None:
    out = way_out()
    led(out, dips, ticks=1)
    assert out.replace_verdict(verdict(), here(tick, dips, now=1), 0.0).action[0] == 0.0


def test_nothing_is_taken_that_leads_through_less_than_half_of_the_layer() -> None:
    """Not even where it leads far out; from further down, nothing below what h is now."""
    for start, lowest, wanted in ((0.19, 0.1, True), (0.19, 0.099, False), (0.05, 0.0485, True), (0.05, 0.047, False)):
        found = led(way_out(), lambda action, ticks, a=start, b=lowest: [[a, b, b, 1.0][min(ticks, 3)]])  # type: ignore[misc]
        assert (abs(found.action[0]) == 1.0) == wanted, (start, lowest)
    found = led(way_out(), lambda action, ticks: [[0.001, -0.0005, 1.0][min(ticks, 2)]])
    assert found.action[0] == 0.0, "h is predicted below 0"


def test_the_barriers_that_are_not_short_keep_their_conditions_all_along() -> None:
    """The other one falls from 0.5; the condition allows (1 - eta) 0.5 + epsilon = 0.35 in the first tick."""
    for after, kept in ((0.36, True), (0.34, False)):
        found = led(way_out(), lambda action, ticks, b=after: [*dips(action, ticks), 0.5 if ticks == 0 else b])  # type: ignore[misc]
        assert (found.action[0] != 0.0) == kept
    sinks = led(way_out(), lambda action, ticks: [*dips(action, ticks), 0.5 - 0.05 * ticks])
    assert "held for 0.5 s" in sinks.reason, "from 0.25 it may fall to 0.225, and would fall to 0.2"


def test_of_those_that_lead_far_the_nearest_to_the_nominal_action() -> None:
    def far(action: float, ticks: int) -> list[float]:
        return [0.19 + (0.8 if action > 0.0 else 0.3) * (abs(action) >= 0.25 and ticks > 4) - 0.0001 * min(ticks, 4)]

    found = led(way_out(), far)
    assert found.action[0] == -1.0, "twice the depth of the layer is far enough"
    assert "held for 0.5 s" in found.reason, "no longer than that takes"


def test_only_a_standing_robot_is_led_and_only_by_an_action_that_gains_something_and_moves_it() -> None:
    assert led(way_out(), lambda action, ticks: [0.15 + 0.003 * (ticks > 1)]).action[0] == 0.0
    assert led(way_out(), lambda action, ticks: [0.15 + 0.005 * (ticks > 1)]).action[0] != 0.0
    assert led(way_out(), dips, stood=0.4).action[0] == 0.0
    assert led(way_out(), dips, fails=1.0).action[0] == 0.0
    assert led(way_out(), dips, known=0).action[0] == 0.0, "the model has no numbers"


def test_a_correction_is_replaced_only_by_what_keeps_every_condition() -> None:
    def rises(action: float, ticks: int) -> list[float]:
        return [0.19 + (0.05 * ticks * action if ticks > 1 else 0.0)]

    for then, kept in ((rises, True), (dips, False)):
        out = way_out()
        assert not out.may_replace(Status.corrected)
        led(out, rises, ticks=1)
        assert out.may_replace(Status.corrected)
        now = here(1, then, now=1)
        found = out.replace_verdict(verdict(Status.corrected), now, 1.0)
        assert (found.action[0] != 0.0) == kept
        assert found.status is Status.corrected
        assert out.may_replace(Status.corrected) is kept


def test_neither_passed_nor_violated_is_replaced() -> None:
    out = way_out()
    led(out, dips, ticks=1)
    assert not any(out.may_replace(status) for status in Status if status not in (Status.relaxed, Status.corrected))


def test_actions_are_looked_at_all_over_the_range_finer_near_rest_and_eight_in_a_tick() -> None:
    settings = FilterSettings(action_low=(-0.6, -1.0), action_high=(2.0, 1.0), backup_action=(0.4, 0.0), eta=0.5)
    out = DeadlockEscape(settings, QuadraticProgram(settings.low, settings.high, settings.weight_vector))
    asked: list[tuple[float, ...]] = []

    def fails(action: Sequence[float]) -> bool:
        asked.append(tuple(action))
        return True

    still = replace(verdict(), nominal=np.zeros(2))
    counts = []
    for tick in range(10):
        now = TickContext(tick, PERIOD, [0.19], [0.1], lambda action: iter([[0.189]]), fails)
        assert out.replace_verdict(still, now, 0.5) is still
        counts.append(len(asked))
    assert counts == list(range(8, 88, 8))
    first, second = ({round(action[index], 6) for action in asked} for index in range(2))
    assert first == {-0.6, -0.1, 0.15, 0.275, 0.4, 0.6, 0.8, 1.2, 2.0}
    assert second == {-1.0, -0.5, -0.25, -0.125, 0.0, 0.125, 0.25, 0.5, 1.0}
    assert len(set(asked)) == 80
    assert (0.4, 0.0) not in asked


@pytest.mark.parametrize(("period", "ticks"), [(0.05, 10), (0.02, 20), (1.5 / 239, 40), (1.5 / 240, 80), (0.005, 80)])
def test_a_short_period_looks_at_fewer_actions_in_one_tick(period: float, ticks: int) -> None:
    """At 200 Hz eight actions of 300 predictions took longer than the period, every tick, so that no way was found."""
    settings = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), backup_action=(0.0, 0.0), eta=0.5)
    out = DeadlockEscape(settings, QuadraticProgram(settings.low, settings.high, settings.weight_vector))
    counts: list[int] = []

    def ahead(action: Sequence[float]) -> Iterator[Sequence[float]]:
        while True:
            counts[-1] += 1
            yield [0.19 + 0.05 * action[0] if action[0] > 0.9 else 0.19]

    wanted = replace(verdict(), nominal=np.zeros(2))
    for tick in range(ticks):
        counts.append(0)
        found = out.replace_verdict(wanted, TickContext(tick, period, [0.19], [0.1], ahead, lambda _: False), 1.0)
        assert ("leads out" in found.reason) is (tick == ticks - 1)
    assert 240 <= max(counts[:-1]) <= 239 * 2 + 1, "and the nominal action"


@pytest.mark.parametrize("from_tick", [1, 2, 4])
def test_what_has_no_height_is_no_way_out(from_tick: int) -> None:
    """Where a barrier is no number no one knows anything: neither the nominal action nor a manoeuvre leads there."""

    def unknown(action: float, ticks: int) -> list[float]:
        return [*dips(action, ticks), float("nan") if ticks >= from_tick and action != 0.0 else 9.0]

    assert led(way_out(), unknown).action[0] == 0.0
    raises = verdict(nominal=1.0)
    found = way_out().replace_verdict(
        raises, here(0, lambda action, ticks: [0.19 + 0.01 * ticks, *unknown(action, 9)[1:]]), 0.0
    )
    assert found is raises


def test_what_was_found_some_ticks_ago_is_judged_once_more() -> None:
    settings = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), backup_action=(0.0, 0.0), eta=0.5)
    for last, taken in ((0.3, True), (0.189, False)):
        out = DeadlockEscape(settings, QuadraticProgram(settings.low, settings.high, settings.weight_vector))
        found = verdict()
        for tick in range(10):
            rise = 0.3 if tick < 9 else last
            known = TickContext(tick, PERIOD, [0.19], [0.1], lambda _, h=rise: iter([[0.189], [h]]), lambda _: False)  # type: ignore[misc]
            found = out.replace_verdict(replace(verdict(), nominal=np.zeros(2)), known, 1.0)
        assert ("leads out" in found.reason) is taken


def test_exactly_out_of_the_layer_in_one_tick_is_enough() -> None:
    def out(action: float, ticks: int) -> list[float]:
        return [0.1985 if ticks == 0 or action < 0.0 else 0.2 if ticks == 1 else 0.1]

    found = led(way_out(), out, ticks=1, stood=0.5)
    assert found.action[0] > 0.0
    assert "held for 0.1 s" in found.reason
    tool = way_out()
    assert led(tool, lambda action, ticks: [[0.1985, 0.19849, 0.2][min(ticks, 2)]], ticks=1).action[0] != 0.0
    assert "leads out" in tool.replace_verdict(verdict(), here(1, lambda _, ticks: [0.2], now=1), 0.0).reason


def test_a_barrier_at_the_edge_of_its_layer_keeps_its_condition_and_one_without_a_margin_has_none() -> None:
    falls = led(
        way_out(), lambda action, ticks: [*dips(action, ticks), 0.2 if ticks == 0 else 0.15 if ticks < 5 else 0.3]
    )
    assert falls.action[0] == 0.0
    tool, plain = way_out(), [0.1, 0.0]
    for tick in range(2):
        now = here(tick, lambda action, ticks: [*dips(action, ticks), 0.15], margins=plain, now=tick)
        assert tool.replace_verdict(verdict(), now, 1.0).h_next == pytest.approx(0.15), "the least of both"


@pytest.mark.parametrize(
    ("now", "then", "taken"),
    [
        ((0.15, 0.5), (0.16, 0.4), True),
        ((0.1, 0.5), (0.11, 0.4), True),  # h at the middle of the layer
        ((0.09, 0.5), (0.1, 0.4), False),  # in its lower half
        ((0.15, 0.5), (0.15, 0.4), False),  # it does not rise
        ((0.15, 0.5), (0.16, 0.34), False),  # the other one breaks its condition
        ((0.3, 0.5), (0.25, 0.35), True),  # exactly kept
        ((0.3, 0.5), (0.24, 0.4), False),
    ],
)
def test_the_nominal_action_is_taken_where_it_raises_what_is_short(now, then, taken):
    place = here(0, lambda _, ticks: list(now if ticks == 0 else then))
    found = way_out().replace_verdict(verdict(nominal=-3.0), place, 0.0)
    assert bool(found.action[0] == -1.0) is taken, "within its bounds"
    if taken:
        assert "raises every h" in found.reason
        assert not found.action.flags.writeable
        assert found.h_next == min(then)
        assert found.slack == pytest.approx(
            max(0.0, *(0.5 * h + 0.1 - after for h, after in zip(now, then, strict=True)))
        )


@pytest.mark.parametrize("until_action", [0.0, 0.006])
def test_a_car_next_to_an_obstacle_gets_out(until_action: float) -> None:
    """As measured with a box in tow: at rest with h 0.7 mm inside the layer, and every single step lowers it.

    The same where the action acts some milliseconds after the state was measured, as on every real robot.
    """
    model, settings = load_model("car"), settings_named("car")
    own = fingerprint(model)
    calibration = replace(uncalibrated(settings, own), epsilon={"obstacle": 0.0283, "field": 0.0054, "speed": 0.025})
    memory = RobotSession.create(CalibratedModel(model, own, calibration), settings)
    state = CarRobot(Scene.random(1, "box"), PERIOD / 2).state_message()
    state = replace(state, values=(-1.276, 2.0412, 9.2783, 0.0), distance_reversed=0.0, until_action=until_action)
    latent = np.array([0.8, 1.09])
    ways = []
    for _ in range(60):
        found = next_verdict(memory, state, latent)
        memory.decision = None
        assert found.h_next >= 0.04
        after = model.step(np.array(state.values), found.action, latent)
        memory.deadlock_detector.expect(state.values, (state.values[0] + 0.01, *state.values[1:]), tuple(after))
        ways.append(float(np.hypot(after[0] + 1.276, after[1] - 2.0412)))
        later = state.robot_time + state.period
        state = replace(state, tick=state.tick + 1, robot_time=later, values=tuple(after.tolist()))
    assert ways[8] < 0.01, "it stands"
    assert ways[-1] > 0.05, "and is led out"


def next_verdict(memory: RobotSession, state: StateMessage, latent: np.ndarray) -> Verdict:
    """What the service decides for a nominal action to reverse into what is behind."""
    memory.observe_state(state)
    known = {"memory": memory.pending, "barriers": memory.barriers, "epsilon": memory.margin.epsilon}
    found = memory.filter.decide(state.values, (-0.6, 0.34), latent, **known, time=state.robot_time)
    return memory.escape_boundary_layer(state, found, latent)
