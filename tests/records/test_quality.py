"""Every defect that is planted is found, said and cut; nothing is found where nothing is planted."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from safedpa.errors import RunError
from safedpa.records import Run
from safedpa.records.column_map.column_map import native_map
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.run import RawRows
from safedpa.robots.car.system import CAR
from safedpa.robots.differential_drive.system import DIFFERENTIAL_DRIVE
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.systems import System

Array = NDArray[np.float64]


def car_rows(count: int = 600, period: float = 0.05, seed: int = 0, noise: float = 1e-3, turn: float = 0.15) -> RawRows:
    """A kinematic bicycle behind a speed servo, driven by smooth random commands."""
    random = np.random.default_rng(seed)
    t = period * np.arange(count)
    phases = random.uniform(0, 2 * np.pi, 4)
    speed_command = 1.2 + 0.6 * np.sin(0.7 * t + phases[0]) + 0.1 * np.sin(2.9 * t + phases[1])
    steer = turn + 0.2 * np.sin(0.5 * t + phases[2]) + 0.05 * np.sin(2.3 * t + phases[3])
    state = np.array([0.0, 0.0, random.uniform(-3, 3), 1.0])
    states = np.empty((count, 4))
    for row in range(count):
        states[row] = state
        _, _, yaw, speed = state
        rate = np.array([np.cos(yaw) * speed, np.sin(yaw) * speed, speed * np.tan(steer[row]) / 0.32, 0.0])
        rate[3] = 4.0 * (speed_command[row] - speed)
        state = state + period * rate
    states += noise * random.standard_normal(states.shape)
    return RawRows(t, states, np.column_stack([speed_command, steer]))


def pendulum_rows(count: int = 1500, period: float = 0.01, seed: int = 0) -> RawRows:
    random = np.random.default_rng(seed)
    t = period * np.arange(count)
    torque = 1.5 * np.sin(1.3 * t + random.uniform(0, 6)) + 0.5 * np.sin(4.1 * t)
    states = np.empty((count, 2))
    angle, rate = np.pi + random.uniform(-0.5, 0.5), 0.0
    for row in range(count):
        states[row] = angle, rate
        rate += period * (torque[row] / 0.25 + 9.81 / 0.5 * np.sin(angle) - 0.3 * rate)
        angle += period * rate
    return RawRows(t, states, torque[:, None])


def judge(rows: RawRows, system: System = CAR) -> Run:
    return run_of_rows(Path("planted.csv"), system, native_map(system), rows, ())


def kinds(run: Run) -> list[str]:
    return [finding.kind for finding in run.findings]


def inside(run: Run, row_time: float) -> bool:
    """Whether a sample of that time is in a stretch."""
    return any(np.any(np.isclose(t, row_time, atol=1e-9)) for t, _, _ in run.parts())


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    period=st.sampled_from([0.01, 0.02, 0.05, 0.1]),
    noise=st.sampled_from([0.0, 1e-4, 2e-3]),
    turn=st.floats(-0.2, 0.2),
    start=st.sampled_from([0.0, -5.0, 1.7e9]),
)
def test_nothing_is_found_in_clean_car_runs(seed: int, period: float, noise: float, turn: float, start: float) -> None:
    rows = car_rows(round(20 / period), period, seed, noise, turn)
    run = judge(replace(rows, t=rows.t + start))
    assert run.findings == ()
    assert [len(part) for part in run.stretches] == [len(rows.t)]
    np.testing.assert_array_equal(run.t, rows.t + start)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), period=st.sampled_from([0.002, 0.005, 0.01]))
def test_nothing_is_found_in_clean_pendulum_runs(seed: int, period: float) -> None:
    run = judge(pendulum_rows(round(10 / period), period, seed), PENDULUM)
    assert run.findings == ()
    assert len(run.stretches) == 1


def test_wrapped_angles_are_unwrapped_without_a_finding() -> None:
    rows = car_rows()
    wrapped = rows.states.copy()
    wrapped[:, 2] = (wrapped[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped[:, 2])).max() > 6.0
    run = judge(replace(rows, states=wrapped))
    assert run.findings == ()
    np.testing.assert_allclose(np.diff(run.states[:, 2]), np.diff(rows.states[:, 2]), atol=1e-9)


def test_a_stop_and_a_start_are_no_defect() -> None:
    rows = car_rows()
    states, actions = rows.states.copy(), rows.actions.copy()
    states[200:300] = states[200]
    states[200:300, 3] = 0.0
    actions[200:300] = 0.0
    states[300:] = rows.states[200:-100]
    states[300:, 3] *= np.minimum(1.0, np.arange(300) * 0.1)
    retained = np.r_[0:300]
    assert kinds(judge(RawRows(rows.t[retained], states[retained], actions[retained]))) == []


def with_state(index: int, change: Callable[[Array], None]) -> Callable[[RawRows], RawRows]:
    def planted(rows: RawRows) -> RawRows:
        states = rows.states.copy()
        change(states[:, index])
        return replace(rows, states=states)

    return planted


def nan_at(rows: RawRows) -> RawRows:
    states, actions = rows.states.copy(), rows.actions.copy()
    states[100, 1] = np.nan
    actions[101, 0] = np.inf
    return RawRows(rows.t, states, actions)


def shifted_after(rows: RawRows) -> RawRows:
    states = rows.states.copy()
    states[300:, :2] += (2.0, -1.0)
    return replace(rows, states=states)


def one_outlier(rows: RawRows) -> RawRows:
    states = rows.states.copy()
    states[300, 0] += 3.0
    return replace(rows, states=states)


@pytest.mark.parametrize(
    ("plant", "expected", "lost"),
    [
        (nan_at, ["not_a_number", "cut"], 2),
        (shifted_after, ["jump", "jump"], 0),
        (one_outlier, ["jump", "cut"], 1),
        (lambda rows: rows.taken(np.r_[0:200, 205:600]), ["gap"], 0),
        (lambda rows: rows.taken(np.r_[0:200, 201:600]), ["gap"], 0),
        (lambda rows: rows.taken(np.repeat(np.arange(600), 1 + (np.arange(600) % 100 == 50))), ["repeated_row"], 0),
        (lambda rows: replace(rows, t=np.where(np.arange(600) < 300, rows.t, rows.t - 7.0)), ["clock_reset"], 0),
        (with_state(3, lambda speed: speed.__setitem__(250, 45.0)), ["out_of_bounds", "cut"], 1),
    ],
)
def test_a_planted_defect_is_found_and_cut(plant: Callable[[RawRows], RawRows], expected: list[str], lost: int) -> None:
    planted = plant(car_rows())
    run = judge(planted)
    assert kinds(run) == expected
    repeats = next((finding.count for finding in run.findings if finding.kind == "repeated_row"), 0)
    assert sum(len(part) for part in run.stretches) == len(planted.t) - repeats - lost
    for t, states, actions in run.parts():
        assert np.all(np.diff(t) > 0.0)
        assert np.isfinite(states).all()
        assert np.isfinite(actions).all()
        assert np.abs(np.diff(states[:, :2], axis=0)).max() < 0.3
        assert np.diff(t).max() < 0.09


def test_findings_say_how_often_and_when_first() -> None:
    run = judge(nan_at(car_rows()))
    message = run.findings[0].message
    assert message == "2 rows without a finite number in y, target_speed, first at t = 5.000 s; cut out"
    assert run.findings[0].start_t == pytest.approx(5.0)
    assert run.findings[0].count == 2
    assert run.findings[1].message.startswith("2 of 600 rows (0.333 %) were cut in all; 2 stretches remain")


def test_nothing_is_interpolated_over_bad_rows() -> None:
    rows = nan_at(car_rows())
    run = judge(rows)
    assert not inside(run, rows.t[100])
    assert not inside(run, rows.t[101])
    assert inside(run, rows.t[99])
    assert inside(run, rows.t[102])


def test_a_time_that_is_none_is_cut_out() -> None:
    rows = car_rows()
    t = rows.t.copy()
    t[[200, 201, 400]] = np.nan, np.nan, np.inf
    run = judge(replace(rows, t=t))
    assert kinds(run) == ["not_a_number", "cut"]
    assert run.findings[0].count == 3
    assert [len(part) for part in run.stretches] == [200, 198, 199]


def test_irregular_sampling_is_reported_and_nothing_is_cut_for_it() -> None:
    rows = car_rows(period=0.01)
    retained = np.flatnonzero(np.random.default_rng(3).random(600) < 0.5)
    run = judge(rows.taken(retained))
    assert "irregular_sampling" in kinds(run)


@pytest.mark.parametrize(("index", "name"), [(0, "target_speed"), (1, "steer")])
def test_an_input_without_excitation_is_named(index: int, name: str) -> None:
    rows = car_rows()
    actions = rows.actions.copy()
    actions[:, index] = 0.2
    run = judge(replace(rows, actions=actions))
    assert kinds(run) == ["constant_input"]
    assert run.findings[0].message.startswith(f"{name} is always 0.2")


def test_a_parked_robot_is_reported() -> None:
    rows = car_rows()
    run = judge(replace(rows, states=np.tile(rows.states[0], (600, 1))))
    assert kinds(run) == ["no_motion"]


@pytest.mark.parametrize(
    ("factor", "kind", "phrase"),
    [(3.6, "unit_mistake", "km/h"), (1 / 0.44704, "unit_mistake", "mph"), (1.4, "scale_mismatch", "wheel radius")],
)
def test_speed_in_another_unit_is_recognised(factor: float, kind: str, phrase: str) -> None:
    run = judge(with_state(3, lambda speed: speed.__imul__(factor))(car_rows()))
    assert kinds(run) == [kind]
    assert phrase in run.findings[0].message


def test_steer_in_degrees_is_recognised_although_every_row_is_cut() -> None:
    rows = car_rows()
    with pytest.raises(RunError) as caught:
        judge(replace(rows, actions=rows.actions * (1.0, 180 / np.pi)))
    assert 'looks like degrees, so every row was cut; name unit = "deg" in a column map' in str(caught.value)
    assert "no usable stretch" in str(caught.value)


@pytest.mark.parametrize("wrapped", [False, True])
def test_yaw_in_degrees_is_recognised_although_every_row_is_cut(wrapped: bool) -> None:
    rows = car_rows()
    states = rows.states * (1, 1, 180 / np.pi, 1)
    if wrapped:
        states[:, 2] = (states[:, 2] + 180) % 360 - 180
    with pytest.raises(RunError, match=r"only when it is read as degrees .* name unit = \"deg\" in a column map"):
        judge(replace(rows, states=states))


@pytest.mark.parametrize(
    ("change", "kind", "phrase"),
    [
        (lambda s: s[:, [1, 0, 2, 3]], "swapped_columns", "x and y look swapped"),
        (lambda s: s * (1, 1, -1, 1), "opposite_sign", "yaw or y"),
        (lambda s: s * (-1, 1, 1, 1), "opposite_sign", "x seems"),
        (lambda s: s + np.array([0, 0, np.pi / 2, 0]), "yaw_offset", "turned by -91 degrees"),
        (lambda s: s * (1, 1, 1, -1), "yaw_offset", "drives backwards"),
    ],
)
def test_swapped_and_mirrored_columns_are_recognised(change: Callable[[Array], Array], kind: str, phrase: str) -> None:
    rows = car_rows()
    run = judge(replace(rows, states=change(rows.states)))
    assert kinds(run) == [kind]
    assert phrase in run.findings[0].message


def test_a_car_in_reverse_is_no_defect() -> None:
    rows = car_rows()
    backwards = rows.states[::-1].copy()
    backwards[:, 3] *= -1.0
    assert kinds(judge(replace(rows, states=backwards, actions=rows.actions[::-1].copy()))) == []


def test_held_columns_are_named_with_their_period() -> None:
    rows = car_rows(3000, 0.01)
    held = rows.actions[(np.arange(3000) // 10) * 10]
    states = rows.states.copy()
    states[:, 3] = states[(np.arange(3000) // 5) * 5, 3]
    run = judge(RawRows(rows.t, states, held))
    messages = [finding.message for finding in run.findings if finding.kind == "held"]
    assert len(messages) == 2
    assert "speed is updated only every 5 rows (0.05 s)" in messages[0]
    assert "target_speed and steer are updated only every 10 rows (0.1 s)" in messages[1]


def test_a_held_position_is_not_full_of_jumps() -> None:
    rows = car_rows(3000, 0.01)
    states = rows.states.copy()
    states[:, :2] = states[(np.arange(3000) // 20) * 20, :2] * 1.0
    assert "jump" not in kinds(judge(replace(rows, states=states)))


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda s: s + np.array([np.pi, 0]), "angle_zero"),
        (lambda s: s * (1, -1), "opposite_sign"),
        (lambda s: s * (1, 60 / (2 * np.pi)), "unit_mistake"),
    ],
)
def test_a_pendulum_read_wrongly_is_recognised(change: Callable[[Array], Array], kind: str) -> None:
    rows = pendulum_rows()
    assert kinds(judge(replace(rows, states=change(rows.states)), PENDULUM)) == [kind]


def wheels_rows(count: int = 600, period: float = 0.05) -> RawRows:
    """A differential drive behind a servo, with the noise of a good tracking system."""
    t = period * np.arange(count)
    commands = np.column_stack([0.25 + 0.2 * np.sin(0.9 * t), 0.8 * np.sin(1.3 * t) + 0.4 * np.sin(3.1 * t)])
    states, state = np.empty((count, 5)), np.zeros(5)
    for row in range(count):
        states[row] = state
        _, _, yaw, speed, turn = state
        wanted = 5.0 * (commands[row] - state[3:])
        state = state + period * np.array([speed * np.cos(yaw), speed * np.sin(yaw), turn, *wanted])
    noise = np.random.default_rng(4).standard_normal((count, 5)) * (0.002, 0.002, 0.003, 0.01, 0.02)
    return RawRows(t, states + noise, commands)


@pytest.mark.parametrize(
    ("factor", "found", "notice"),
    [
        (1.0, [], ""),
        (-1.0, ["opposite_sign"], "turn_rate has the opposite sign of the change of yaw"),
        (3.0, ["scale_mismatch"], "times turn_rate"),
        (60 / (2 * np.pi), ["unit_mistake"], "as if turn_rate were in rpm"),
    ],
)
def test_a_gyroscope_that_counts_otherwise_is_recognised(factor: float, found: list[str], notice: str) -> None:
    rows = wheels_rows()
    run = judge(replace(rows, states=rows.states * (1, 1, 1, 1, factor)), DIFFERENTIAL_DRIVE)
    assert kinds(run) == found
    assert notice in " ".join(item.message for item in run.findings)


def test_a_run_with_nothing_usable_lists_what_was_found() -> None:
    rows = car_rows(60)
    states = rows.states.copy()
    states[::3, 0] = np.nan
    with pytest.raises(RunError, match=r"no usable stretch of rows: 20 rows without a finite number in x") as caught:
        judge(replace(rows, states=states))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("sign", "kinds"), [(1.0, set()), (-1.0, {"opposite_sign"})])
def test_a_servo_that_follows_at_once_has_the_sign_of_its_command(sign: float, kinds: set[str]) -> None:
    rows = car_rows(noise=0.0)
    actions = rows.actions.copy()
    actions[:, 0] = sign * 1.02 * rows.states[:, 3]
    found = run_of_rows(Path("planted.csv"), CAR, native_map(CAR), replace(rows, actions=actions), ())
    assert {item.kind for item in found.findings} & {"opposite_sign"} == kinds
