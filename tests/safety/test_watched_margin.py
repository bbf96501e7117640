"""What the watch over the margin counts as an error, and that invariance follows from the errors that it counts."""

import dataclasses
from dataclasses import replace
from math import nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.bus import LatentMessage, StateMessage
from safedpa.calibration.from_drives import DriveTick, barrier_residuals
from safedpa.dynamics import fingerprint, load_model
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety import FilterSettings, FunctionBarrier, MarginCalibration
from safedpa.safety.barriers.base import Barriers
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.error_clipping import NO_CLIP, ErrorClip, HSample
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.prediction.command_history import DelayedPrediction

CALIBRATION = MarginCalibration({"function": 0.01}, 0.99, 500, "2026-11-21", "x")


def at(latent: float) -> Barriers:
    """h = x - latent."""
    return Barriers((FunctionBarrier(lambda x: x[0] - latent),))


def seen(watch: OnlineMarginMonitor, clip: ErrorClip = NO_CLIP) -> float | None:
    """The error that was observed last; None where nothing came near."""
    errors = clip.errors("function", np.array([watch.samples["function"]]))
    return float(errors[0]) if len(errors) else None


def test_the_change_of_h_with_the_latent_is_in_the_error() -> None:
    """The filter kept h by the latent of then, and asks for h by that of now: the next condition begins with it."""
    watch = OnlineMarginMonitor(CALIBRATION)
    watch.expect([0.3], at(0.1))
    watch.observe([0.29], at(0.15))
    assert seen(watch) == pytest.approx(0.3 - 0.1 - (0.29 - 0.15))
    watch.expect([0.3], at(0.1))
    watch.observe([0.29], at(0.15), same_scene=False)
    assert seen(watch) == pytest.approx(0.01)
    watch.expect([0.3])
    watch.observe([0.29], at(0.15))
    assert seen(watch) == pytest.approx(0.01)
    watch.observe([0.29], at(0.15))
    assert watch.samples == {}, "nothing was predicted"


@pytest.mark.parametrize("learns", [True, False])
def test_a_watch_that_does_not_learn_sees_and_leaves_its_margin_as_it_is(learns: bool) -> None:
    watch = OnlineMarginMonitor(CALIBRATION)
    watch.learns = learns
    for _ in range(200):
        watch.expect([0.3], at(0.1))
        watch.observe([0.2], at(0.1))
    assert seen(watch) == pytest.approx(0.1)
    assert (watch.epsilon["function"] > 0.05) is learns
    assert (watch.coverage < 0.0) is not learns


def kinds(**heights: float) -> Barriers:
    """Barriers of a kind each, whose h is one state with a number on top."""
    rows = [
        FunctionBarrier(lambda x, index=index, more=more: x[index] + more, kind=kind)  # type: ignore[misc]
        for index, (kind, more) in enumerate(heights.items())
    ]
    return Barriers(tuple(rows))


@pytest.mark.parametrize("order", [("a", "b", "c"), ("b", "c", "a"), ("c", "a", "b"), ("c", "b", "a")])
@pytest.mark.parametrize("missed", [("a",), ("a", "a", "b")])
def test_the_coverage_is_that_of_the_kind_that_has_the_least(order: tuple[str, ...], missed: tuple[str, ...]) -> None:
    """Four steps each: "a" misses once or twice of them, so that 3/4 or 1/2 are left to it."""
    watch = OnlineMarginMonitor(dataclasses.replace(CALIBRATION, epsilon=dict.fromkeys(order, 0.01)))
    assert watch.coverage == -1.0
    barriers = kinds(**dict.fromkeys(order, 0.0))
    for step in range(4):
        too_much = [missed.count(kind) > step for kind in order]
        watch.expect([1.0] * 3)
        watch.observe([1.0 - 10.0**step * more for more in too_much], barriers)
    assert watch.coverage == pytest.approx(1.0 - missed.count("a") / 4.0)


def test_only_a_calibration_promises_a_coverage_and_a_kind_that_always_missed_has_one_of_none() -> None:
    for order in (("a", "b"), ("b", "a")):
        watch = OnlineMarginMonitor(dataclasses.replace(CALIBRATION, epsilon=dict.fromkeys(order, 0.01)))
        watch.expect([1.0, 1.0])
        watch.observe([0.0 if kind == "a" else 1.0 for kind in order], kinds(**dict.fromkeys(order, 0.0)))
        assert watch.coverage == 0.0
    assert OnlineMarginMonitor(CALIBRATION).promised == 0.99
    settings = settings_named("car")
    assert OnlineMarginMonitor(uncalibrated(settings, "m")).promised == -1.0


def test_a_miss_is_remembered_for_five_hundred_steps() -> None:
    watch, reported = OnlineMarginMonitor(CALIBRATION), []
    for step in range(502):
        watch.expect([1.0])
        watch.observe([1.0 if step else 0.0], at(0.0))
        reported.append(watch.coverage)
    assert reported[499] == pytest.approx(499 / 500)
    assert reported[500] == 1.0


def test_a_kind_without_a_margin_is_seen_and_moves_none() -> None:
    watch = OnlineMarginMonitor(CALIBRATION)
    for _ in range(20):
        watch.expect([1.0, 1.0])
        watch.observe([1.0, 0.0], kinds(function=0.0, other=0.0))
    assert watch.samples["other"] == HSample(1.0, 0.0)
    assert watch.epsilon == {"function": 0.01}


def test_past_a_dead_time_the_prediction_is_compared_at_both_states() -> None:
    """h = x - latent; of the state before as of this one the h hoped for is that of the barriers of then."""
    watch = OnlineMarginMonitor(CALIBRATION)
    watch.expect([0.9], at(0.1))
    watch.observe([0.5], at(0.2), late=DelayedPrediction(predicted_prev=(0.8,), measured_prev=(0.7,), predicted=(0.6,)))
    assert watch.samples["function"] == pytest.approx(HSample(0.5, 0.3, 0.7, 0.5))


@pytest.mark.parametrize("place", range(3))
def test_an_h_that_is_no_number_leaves_no_error_wherever_it_stands(place: int) -> None:
    three = Barriers((FunctionBarrier(lambda x: x, names=("a", "b", "c")),))
    watch = OnlineMarginMonitor(CALIBRATION)
    measured = [0.5, 0.6, 0.7]
    measured[place] = nan
    watch.expect([1.0, 1.0, 1.0])
    watch.observe(measured, three)
    assert np.isnan(watch.samples["function"].measured)
    assert watch.samples["function"].predicted == 1.0
    assert watch.coverage == -1.0
    watch.expect([1.0, 1.0, 1.0])
    watch.observe([np.inf, 0.5, -np.inf], three)
    assert watch.samples["function"].measured == -np.inf, "the sum is no number, and each of them is one"


def test_errors_by_a_latent_that_jumps_widen_the_margin() -> None:
    watch = OnlineMarginMonitor(CALIBRATION)
    for tick in range(40):
        watch.expect([0.3], at(0.1 * (tick % 2)))
        watch.observe([0.3], at(0.1 * ((tick + 1) % 2)))
    assert watch.epsilon["function"] >= 0.1


def test_an_error_far_from_the_boundary_is_none_and_one_near_it_is_whole() -> None:
    clip = ErrorClip(0.2, {"function": 0.5})
    watch = OnlineMarginMonitor(CALIBRATION, clip)
    errors, shares = [], []
    for hoped, measured in ((3.0, 0.6), (3.0, 0.4), (0.4, 0.6), (0.4, 0.1)):
        watch.expect([hoped], at(0.0))
        watch.observe([measured], at(0.0))
        errors.append(seen(watch, clip))
        shares.append(watch.coverage)
    assert errors == [None, pytest.approx(0.1), pytest.approx(-0.1), pytest.approx(0.3)]
    assert shares == [-1.0, 0.0, 0.5, pytest.approx(1 / 3)], "the first was none"


def test_the_least_of_a_kind_counts() -> None:
    """What comes nearer than predicted, behind another that is nearer still, is no error of the least."""
    two = Barriers((FunctionBarrier(lambda x: [x[0], x[1]], names=("a", "b")),))
    watch = OnlineMarginMonitor(CALIBRATION)
    watch.expect([0.1, 0.9], two)
    watch.observe([0.1, 0.5], two)
    assert seen(watch) == 0.0


def test_the_clip_level_is_never_below_the_boundary_layer_of_the_margin_in_force() -> None:
    clip = ErrorClip.of_settings(FilterSettings.for_robot("car", eta=0.2, epsilon={"function": 0.01}))
    assert clip.level("function", 0.01) == pytest.approx(0.5)
    assert clip.level("function", 0.3) == pytest.approx(1.5)
    assert clip.level("other", 0.3) == np.inf
    assert NO_CLIP.level("function", 0.3) == np.inf
    heights = np.array([HSample(0.6, 0.7), HSample(0.6, 0.4), HSample(0.3, 0.4)])
    assert clip.errors("function", heights).tolist() == pytest.approx([0.1, -0.1])
    assert NO_CLIP.errors("function", heights).tolist() == pytest.approx([-0.1, 0.2, -0.1])
    late = HSample(0.3, 0.2, 0.4, 0.45)  # (1 - eta) times the error at the state at which the condition was posed
    assert clip.error("function", late, 0.0) == pytest.approx(0.1 + 0.8 * 0.05)
    assert NO_CLIP.error("function", late, 0.0) == pytest.approx(0.1), "with eta of 1 nothing of h now is asked for"
    assert clip.error("function", HSample(0.5, 0.5), 0.0) is None, "at the clip level the boundary is far away"
    assert ErrorClip.of_settings(FilterSettings.for_robot("car", epsilon={"function": 0.0})).by_kind == {}, (
        "no margin, no layer"
    )


def test_the_clip_level_is_ten_boundary_layers_and_a_margin_that_just_fits_keeps_it() -> None:
    """epsilon / eta is 0.2 for a; a kind without a margin has no ceiling, and the default is a kind of its own."""
    clip = ErrorClip.of_settings(FilterSettings.for_robot("car", eta=0.5, epsilon={"a": 0.1, "b": 0.0, "default": 0.2}))
    assert clip.error("a", HSample(2.1, 2.1), 0.0) is None
    assert clip.error("a", HSample(2.1, 1.9), 0.0) == pytest.approx(0.1)
    assert clip.error("b", HSample(1e6, 1e6 - 1.0), 0.0) == pytest.approx(1.0)
    low = ErrorClip(0.25, {"a": 0.5})
    assert low.fit_margin("a", lambda _: 0.125) == (0.125, low)
    assert low.fit_margin("a", lambda _: 0.126) == (0.126, ErrorClip(0.25, {"a": 1.0}))
    assert low.fit_margin("b", lambda _: 7.0) == (7.0, low), "without a ceiling every margin fits"


@given(
    h=st.lists(st.floats(-1.0, 3.0), min_size=1, max_size=4),
    predicted=st.lists(st.floats(-1.0, 3.0), min_size=4, max_size=4),
    measured=st.lists(st.floats(-1.0, 3.0), min_size=4, max_size=4),
    eta=st.floats(0.05, 1.0),
    epsilon=st.floats(0.0, 0.3),
)
def test_a_step_within_the_margin_keeps_the_least_h_as_the_theory_says(h, predicted, measured, eta, epsilon):
    """min(h, H)[t+1] >= (1 - eta) min(h, H)[t], where the conditions held by the prediction and the error is within."""
    count = len(h)
    hoped = [max(value, (1.0 - eta) * now + epsilon) for value, now in zip(predicted, h, strict=False)]
    rows = Barriers((FunctionBarrier(lambda x: x, names=tuple(map(str, range(count)))),))
    clip = ErrorClip(eta, {"function": 0.4})
    watch = OnlineMarginMonitor(dataclasses.replace(CALIBRATION, epsilon={"function": epsilon}), clip)
    top = clip.level("function", epsilon)
    watch.expect(hoped, rows)
    watch.observe(measured[:count], rows)
    error = clip.errors("function", np.array([watch.samples["function"]]), epsilon).sum()  # none or one
    if error <= epsilon:
        assert min(*measured[:count], top) >= (1.0 - eta) * min(*h, top) - 1e-9


def point_state(tick: int) -> StateMessage:
    return StateMessage(
        epoch=1, tick=tick, robot_time=0.02 * tick, publish_time=0.0, values=(0.01 * tick, 0.0, 0.0, 0.5, 0.0),
        applied=(0.0, 0.0), applied_by="filter", period=0.02, lockstep=True, goal=(3.0, 0.0),
        obstacles=((0.2, 0.3, 0.2),), field=(), footprint=(),
    )  # fmt: skip


def latent_message(tick: int, values: tuple[float, ...], own: str) -> LatentMessage:
    stamp = {"epoch": 1, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
    return LatentMessage(**stamp, model=own, values=values, deviations=values)


def test_the_point_robot_s_room_to_stop_is_less_in_a_wind_that_is_learned_late() -> None:
    """With the same states, what is believed of the wind alone makes the errors differ: by the fall of h with it."""
    model, settings = load_model("point_wind"), settings_named("point")
    own, calm, wind = fingerprint(model), (0.0, 0.0), (0.0, 0.5)
    rooms: dict[Any, float] = {}
    for latent in (calm, wind):
        scene = RobotSession.create(CalibratedModel(model, own, uncalibrated(settings, own)), settings).scene
        scene.learn(np.array(latent))  # type: ignore[union-attr]
        stack: Any = scene.of(point_state(4))
        rooms[latent] = min(stack.h_floats(point_state(4).values))
    fall = rooms[calm] - rooms[wind]
    assert fall > 0.003
    found = {}
    for later in (calm, wind):
        latents = [calm] * 3 + [later] * 3  # the barriers of a tick are those of the latent one tick before
        along = [DriveTick(point_state(k), latent_message(k, latents[k], own)) for k in range(6)]
        heights = barrier_residuals(model, settings, along)["obstacle"]
        assert heights.shape == (5, 4), "each tick but the first is compared with what was expected of it"
        found[later] = NO_CLIP.errors("obstacle", heights)
    lost = [
        tick._replace(state=replace(tick.state, values=(nan,) * 5)) if k == 3 else tick for k, tick in enumerate(along)
    ]
    left = barrier_residuals(model, settings, lost)["obstacle"]
    assert len(left) < 5
    assert np.isfinite(left).all(), "a state that is no number makes no error"
    assert found[wind][:3] == pytest.approx(found[calm][:3])
    assert found[wind][3] - found[calm][3] > 0.4 * fall, "less what the wind does to the prediction itself"
