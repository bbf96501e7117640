"""Where an action begins to act, against the model stepped by hand, and what the filter makes of it."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa.safety.prediction.dead_time import ActuatorModel, EffectStart, InFlightCommands, MultiStepBarriers
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.solver.constraints import Constraints
from safedpa.safety.verdict import Status

CAR = load_model("car")
LATENT = tuple(CAR.latent.tolist())
STATE = (0.3, -0.2, 0.4, 1.1)


def late(name: str, seconds: float, model: PhysicsModel = CAR) -> PhysicsModel:
    parameter = "time_constant" if name.endswith("lag") else "seconds"
    return model.with_effect(effect("car", name), {parameter: Setting(seconds)})


def sent(model: PhysicsModel, commands: list[tuple[float, float]]) -> tuple[object, list[tuple[float, ...]]]:
    """What the actuators remember after some commands, the first of which was held for ever; and where the car went."""
    memory, state, path = model.initial_memory(np.array(commands[0]), np.array(LATENT)), np.array(STATE), []
    for command in commands:
        state, memory = model.advance(state, np.array(command), memory, np.array(LATENT))
        path.append(tuple(state.tolist()))
    return memory, path


def rolled(model: PhysicsModel, memory: object, commands: list[tuple[float, float]]) -> list[tuple[float, ...]]:
    state, path = np.array(STATE), []
    for command in commands:
        state, memory = model.advance(state, np.array(command), memory, np.array(LATENT))
        path.append(tuple(state.tolist()))
    return path


@pytest.mark.parametrize(
    ("name", "seconds", "reach"),
    [
        ("actuator_delay", 0.0, (0, 0)),
        ("actuator_delay", 0.01, (0, 0)),  # four fifths of the action are felt in its own period
        ("actuator_delay", 0.1, (2, 2)),
        ("actuator_delay", 0.13, (2, 3)),  # partly felt in the third period
        ("steering_delay", 0.2, (0, 4)),  # the drive acts at once
        ("drive_delay", 0.4, (0, 8)),
        ("steering_lag", 0.1, (0, 2)),  # mean delay of a first-order lag: its time constant
        ("drive_lag", 0.3, (0, 6)),
    ],
)
def test_dead_times_are_found_from_the_response(name: str, seconds: float, reach: tuple[int, int]) -> None:
    assert tuple(ActuatorModel(late(name, seconds)).dead_time_periods(LATENT)) == reach


def test_a_delay_that_is_estimated_counts_as_it_is_now() -> None:
    model = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.1, free=True)})
    actuators = ActuatorModel(model)
    index = model.latent_names.index("actuator_delay.seconds")
    for seconds, whole in ((0.1, 2), (0.25, 5), (0.1, 2)):
        latent = [*model.latent.tolist()]
        latent[index] = seconds
        assert tuple(actuators.dead_time_periods(tuple(latent))) == (whole, whole)


def test_where_nothing_waits_or_nothing_is_remembered_an_action_is_felt_at_once() -> None:
    for waits, rows, at_once in ((0, 1, True), (1, 1, False), (0, 2, False), (1, 2, False)):
        assert EffectStart(STATE, (), STATE, None, waits, rows).at_once is at_once
    assert tuple(ActuatorModel(CAR).dead_time_periods(LATENT)) == (0, 0)


def test_dead_time_is_in_seconds_and_without_anything_known_of_what_was_sent_an_action_is_in_force() -> None:
    for name, seconds in (("actuator_delay", 0.1), ("steering_delay", 0.2), ("drive_lag", 0.3)):
        assert ActuatorModel(late(name, seconds)).dead_time(LATENT) == pytest.approx(seconds)
    assert ActuatorModel(CAR).dead_time(LATENT) == 0.0
    begin = ActuatorModel(late("actuator_delay", 0.1)).effect_start(STATE, LATENT, None)
    assert begin is not None
    assert (begin.waiting_periods, begin.steps, begin.at_once) == (0, 1, True)


def test_slopes_over_a_delay_are_those_of_differences() -> None:
    model = late("actuator_delay", 0.13)
    actuators, around = ActuatorModel(model), (0.8, 0.1)
    memory, _ = sent(model, [(0.5, 0.0)] * 4)
    begin = actuators.effect_start(STATE, LATENT, InFlightCommands(memory, (0.5, 0.0)))
    assert begin is not None
    slopes = np.array(actuators.control_matrix(begin, around, LATENT))
    for index, width in ((0, 1e-4), (1, 1e-5)):
        up, down = ([v + sign * width * (i == index) for i, v in enumerate(around)] for sign in (1, -1))
        ends = [np.array(actuators.rollout(begin, end, LATENT)) for end in (up, down)]
        assert slopes[:, index] == pytest.approx((ends[0] - ends[1]) / (2 * width), abs=1e-3)


class Scripted:
    """Stands in for a model: the first action is felt two periods late, the second as ``deaf`` says."""

    class system:  # noqa: N801 - as the model has it
        action_low, action_high = np.array([-1.0, -2.0]), np.array([1.0, 2.0])

    period = 0.05

    def __init__(self, *, deaf: tuple[bool, bool]) -> None:
        self.deaf, self.asked = deaf, 0

    def initial_memory(self, action: Any, latent: Any = None) -> Any:
        return (tuple(action),) * 2

    def felt(self, action: Any, memory: Any, latent: Any, *, period: float) -> Any:
        self.asked += 1
        first = 0.0 if self.deaf[0] else memory[0][0]
        return [first, 0.0 if self.deaf[1] else action[1]], (*memory[1:], tuple(action))


@pytest.mark.parametrize(
    ("deaf", "reach"),
    [((False, False), (0, 2)), ((False, True), (2, 2)), ((True, False), (0, 0)), ((True, True), (0, 0))],
)
def test_an_action_that_is_never_felt_has_no_dead_time(deaf: tuple[bool, bool], reach: tuple[int, int]) -> None:
    assert tuple(ActuatorModel(Scripted(deaf=deaf)).dead_time_periods(None)) == reach  # type: ignore[arg-type]


def test_a_response_is_followed_until_it_has_settled_and_no_further() -> None:
    """The two ends of the step, and three periods of which the last is felt as it will stay."""
    model = Scripted(deaf=(False, False))
    ActuatorModel(model).dead_time_periods(None)  # type: ignore[arg-type]
    assert model.asked == 2 + 3


@pytest.mark.parametrize("load", [(0.0, 2.5), (0.8, 4.0)])
def test_the_latent_that_is_given_counts_all_the_way(load: tuple[float, float]) -> None:
    model, action, last = late("actuator_delay", 0.1), np.array((0.4, -0.2)), np.array((1.5, 0.1))
    latent = np.array(load)
    memory = model.initial_memory(last, latent)
    begin = ActuatorModel(model).effect_start(STATE, load, InFlightCommands(memory, tuple(last.tolist())))
    assert begin is not None
    state, path = np.array(STATE), list[NDArray[np.float64]]()
    for command in (last, last, action):
        state = CAR.advance(state, command, (), latent)[0]
        path.append(state)
    np.testing.assert_allclose(begin.path, path[:2], rtol=0, atol=1e-12)
    after = np.array(ActuatorModel(model).rollout(begin, action.tolist(), load))
    np.testing.assert_allclose(after, path[2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("written", [False, True])
def test_by_the_straight_line_a_robot_moves_as_by_arrays(written: bool) -> None:
    """To the last bit, at the latent that is given, else at the model's own."""
    model = load_model("car")
    if written:
        model.record_scalar_step()
    assert (model.scalar_step(model.period) is not None) is written
    actuators, state, command = ActuatorModel(model), (0.1, 0.2, 0.3, 0.8), (1.2, 0.2)
    other = (0.8, 4.0)
    for latent in (None, other):
        given = None if latent is None else np.array(latent)
        wanted, _ = load_model("car").advance(np.array(state), np.array(command), (), given, period=model.period)
        assert actuators.advance(state, command, (), latent, model.period) == (tuple(wanted.tolist()), ())
    assert actuators.advance(state, command, (), None, model.period) != actuators.advance(
        state, command, (), other, model.period
    )


def test_actuators_of_which_nothing_is_remembered_have_settled_as_the_latent_has_it() -> None:
    """Behind a gain that is estimated, what waits in a delay is as much of the command as the latent says."""
    model = late(
        "steering_delay", 0.15, CAR.with_effect(effect("car", "steering_gain"), {"gain": Setting(1.0, free=True)})
    )
    found = []
    for gain in (1.0, 0.4):
        latent = (0.0, 2.5, gain)
        begin = ActuatorModel(model).effect_start((0.0, 0.0, 0.0, 0.5), latent, InFlightCommands(None, (1.0, 0.1)))
        assert begin is not None
        settled = model.initial_memory(np.array((1.0, 0.1)), np.array(latent))
        assert repr(begin.memory) == repr(settled)
        found.append(repr(settled))
    assert found[0] != found[1]


def test_two_delays_add_up_and_a_gain_before_a_delay_counts_as_the_latent_has_it() -> None:
    model = CAR.with_effect(effect("car", "steering_gain"), {"gain": Setting(1.0, free=True)})
    actuators = ActuatorModel(late("steering_delay", 0.15, model))
    assert [tuple(actuators.dead_time_periods((0.0, 2.5, gain))) for gain in (1.0, 0.4, 2.0)] == [(0, 3)] * 3
    both = late("drive_delay", 0.1, late("actuator_delay", 0.1))
    assert tuple(ActuatorModel(both).dead_time_periods(LATENT)) == (2, 4)


def test_a_pure_delay_is_judged_after_what_is_pending() -> None:
    model, action = late("actuator_delay", 0.2), (0.4, -0.2)
    memory, _ = sent(model, [(0.0, 0.0), (1.0, 0.3), (2.0, 0.1), (1.5, -0.3), (0.5, 0.2)])
    actuators = ActuatorModel(model)
    begin = actuators.effect_start(STATE, LATENT, InFlightCommands(memory, (0.5, 0.2)))
    assert begin is not None
    expected = rolled(model, memory, [action] * 5)
    other = rolled(model, memory, [(2.0, 0.34)] * 5)
    assert expected[:4] == other[:4]  # no one can change these any more
    assert begin.path == tuple(expected[:4])
    assert begin.state == expected[3]
    assert begin.steps == 1
    np.testing.assert_allclose(actuators.rollout(begin, action, LATENT), expected[4], rtol=0, atol=1e-12)
    assert other[4] != expected[4]


def test_channels_of_different_delays_are_judged_in_every_period() -> None:
    model, action, last = late("steering_delay", 0.15), (0.2, -0.3), (1.5, 0.1)
    memory, _ = sent(model, [(0.0, 0.0), (1.0, 0.3), (2.0, 0.2), last])
    actuators = ActuatorModel(model)
    begin = actuators.effect_start(STATE, LATENT, InFlightCommands(memory, last))
    assert begin is not None
    assert (begin.path, begin.steps) == ((), 4)
    held, changed = rolled(model, memory, [last] * 3), rolled(model, memory, [action] * 4)
    assert begin.state == tuple(np.ravel([*held, held[-1]]))
    np.testing.assert_allclose(actuators.rollout(begin, action, LATENT), np.ravel(changed), rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", [late("actuator_delay", 0.13), late("steering_delay", 0.1), late("drive_lag", 0.1)])
def test_slopes_are_those_of_the_outcome(model: PhysicsModel) -> None:
    memory, _ = sent(model, [(0.0, 0.0), (1.0, 0.3), (1.0, 0.2)])
    actuators = ActuatorModel(model)
    begin = actuators.effect_start(STATE, LATENT, InFlightCommands(memory, (1.0, 0.2)))
    assert begin is not None
    action, step = (1.2, 0.1), 1e-5
    g = np.array(actuators.control_matrix(begin, action, LATENT))
    for index in range(2):
        ends = [np.array(action) + sign * step * np.eye(2)[index] for sign in (1.0, -1.0)]
        above, below = (np.array(actuators.rollout(begin, end.tolist(), LATENT)) for end in ends)
        np.testing.assert_allclose(g[:, index], (above - below) / (2 * step), rtol=1e-4, atol=1e-6)


def test_of_commands_that_are_not_known_only_the_dead_time_is_passed() -> None:
    model = late("actuator_delay", 0.13)
    memory, _ = sent(model, [(1.0, 0.0)])
    begin = ActuatorModel(model).effect_start(STATE, LATENT, memory)
    assert begin is not None
    assert (len(begin.path), begin.steps) == (2, 1)


@pytest.mark.parametrize("name", ["car", "car_learned"])
def test_a_model_without_memory_is_judged_where_it_is(name: str) -> None:
    model = load_model(name)
    latent = tuple(model.latent.tolist())
    prediction = Prediction.of_model(model)
    assert prediction.effect_start(STATE, latent, ()) is None
    assert prediction.effect_start(STATE, latent, InFlightCommands((), (1.0, 0.0))) is None
    begin = prediction.effect_start(STATE, latent, InFlightCommands((), (1.0, 0.2), (((1.0, 0.2), 0.03),)))
    assert begin is not None
    aged = model.advance(np.array(STATE), np.array((1.0, 0.2)), (), np.array(latent), period=0.03)[0]
    assert begin.state == tuple(aged.tolist())


def test_several_states_in_a_row_are_the_same_barriers_at_each() -> None:
    scene = car_barriers(
        FilterSettings.for_robot("car"), (0.08, 0.4, 0.12), [(2.0, 0.3, 0.3), (1.0, -1.0, 0.2)], (-4, 4, -4, 4)
    )
    filter_ = SafetyFilter.for_model(CAR, FilterSettings.for_robot("car"), scene)
    plain = filter_.tools.barrier_sets.get(scene, 4).scalar_rows(4)
    random = np.random.default_rng(0)
    states = random.uniform((-1, -1, -3, 0), (1, 1, 3, 2), (3, 4)).tolist()
    g = random.normal(size=(12, 2)).tolist()
    along = MultiStepBarriers(plain, 3, 4)
    flat = [value for state in states for value in state]
    each = [plain.h_floats(tuple(state)) for state in states]
    assert along.h_floats(flat) == [value for h in each for value in h]
    count = len(each[0])
    rows = list(range(3 * count))
    expected = [
        row
        for part, state in enumerate(states)
        for row in plain.lie_derivative_floats(tuple(state), g[4 * part : 4 * part + 4], [1.0, 1.0], list(range(count)))
    ]
    np.testing.assert_allclose(along.lie_derivative_floats(flat, g, [1.0, 1.0], rows), expected)
    grad_bound = along.grad_bound(flat)
    assert grad_bound is not None
    assert len(grad_bound) == 12


def scene_ahead(distance: float) -> list[object]:
    settings = FilterSettings.for_robot("car")
    return list(car_barriers(settings, (0.08, 0.40, 0.12), [(distance, 0.0, 0.3)], (-20, 20, -20, 20)))


def test_passed_never_hides_a_collision_that_is_on_its_way() -> None:
    """The robot stands, but two metres a second are pending for 0.4 s: no nominal action is passed, and h_next says
    why."""
    model = late("actuator_delay", 0.4)
    latent = np.array(LATENT)
    memory = model.initial_memory(np.array((0.0, 0.0)), latent)
    for _ in range(8):
        memory = model.felt((2.0, 0.0), memory, LATENT, period=model.period)[1]
    filter_ = SafetyFilter.for_model(model, FilterSettings.for_robot("car"))
    pending = InFlightCommands(memory, (2.0, 0.0))
    state = (0.0, 0.0, 0.0, 0.0)
    barriers = scene_ahead(0.95)
    blind = filter_.decide(state, [0.0, 0.0], latent, barriers=barriers)
    assert blind.status is Status.passed
    verdict = filter_.decide(state, [0.0, 0.0], latent, memory=pending, barriers=barriers)
    assert verdict.status is Status.relaxed
    assert verdict.h_now > 0.0 > verdict.h_next
    free = filter_.decide(state, [0.0, 0.0], latent, memory=pending, barriers=scene_ahead(5.0))
    assert free.status is Status.passed


@pytest.mark.parametrize("seconds", [0.1, 0.13, 0.3, 0.4])
def test_a_known_delay_is_no_reason_to_relax(seconds: float) -> None:
    """One step cannot see an action that acts later: every condition near an obstacle seemed impossible to keep."""
    model, latent = late("actuator_delay", seconds), np.array(LATENT)
    memory = model.initial_memory(np.array((1.0, 0.0)), latent)
    filter_ = SafetyFilter.for_model(model, FilterSettings.for_robot("car"))
    statuses = set()
    for distance in np.linspace(1.7, 2.6, 10):
        pending = InFlightCommands(memory, (1.0, 0.0))
        barriers = scene_ahead(float(distance))
        verdict = filter_.decide((0.0, 0.0, 0.0, 1.0), [2.0, 0.0], latent, memory=pending, barriers=barriers)
        statuses.add(verdict.status)
    assert Status.corrected in statuses
    assert Status.relaxed not in statuses


def test_braking_keeps_the_conditions_whatever_is_pending() -> None:
    """Commands may still accelerate; all that counts is h >= epsilon / eta where the action begins to act."""
    settings = FilterSettings.for_robot("car")
    random = np.random.default_rng(3)
    kept = tried = 0
    for _ in range(400):
        seconds = random.choice([0.1, 0.2, 0.4])
        model = late("actuator_delay", float(seconds))
        memory = model.initial_memory(np.zeros(2), np.array(LATENT))
        commands = random.uniform((-0.6, -0.34), (2.0, 0.34), (8, 2))
        for command in commands:
            memory = model.felt(command.tolist(), memory, LATENT, period=0.05)[1]
        state = tuple(random.uniform((-3, -3, -3, -0.5), (3, 3, 3, 2.0)).tolist())
        obstacles = np.column_stack([random.uniform(-3, 3, (4, 2)), random.uniform(0.2, 0.35, 4)])
        scene = car_barriers(settings, (0.08, 0.40, 0.12), obstacles, (-4, 4, -4, 4))
        filter_ = SafetyFilter.for_model(model, settings, scene)
        tools = filter_.tools
        stack = tools.barrier_sets.get(scene, 4)
        epsilon, _ = tools.margins.resolve(stack, {})
        pending = InFlightCommands(memory, tuple(commands[-1].tolist()))
        conditions = Constraints(
            stack, tools.prediction, state, LATENT, pending, settings.eta, epsilon, tools.program.sides
        )
        begin = tools.prediction.effect_start(state, LATENT, pending)
        assert begin is not None
        h = np.array(stack.scalar_rows(4).h_floats(begin.state))
        if (h >= np.array(epsilon) / settings.eta).all():
            tried += 1
            kept += conditions.evaluate((0.0, 0.0)).is_feasible
    assert tried > 40
    assert kept == tried


def test_a_learned_model_with_a_delay_looks_as_far() -> None:
    learned = load_model("car_learned")
    model = learned.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
    latent = tuple(model.latent.tolist())
    assert tuple(ActuatorModel(model).dead_time_periods(latent)) == (4, 4)
    memory = model.initial_memory(np.array((1.0, 0.0)), np.array(latent))
    filter_ = SafetyFilter.for_model(model, FilterSettings.for_robot("car"))
    found = [
        filter_.decide(
            (0.0, 0.0, 0.0, 1.0), [2.0, 0.0], np.array(latent), memory=InFlightCommands(memory, (1.0, 0.0)),
            barriers=scene_ahead(float(distance)),
        ).status
        for distance in np.linspace(1.7, 2.6, 10)
    ]  # fmt: skip
    assert Status.corrected in found
    assert Status.relaxed not in found


def test_a_filter_without_a_model_of_ours_has_nothing_on_its_way() -> None:
    barrier = FunctionBarrier(lambda x: 1.0 - x[0])
    plain = SafetyFilter(lambda x: (x, np.eye(1)), [barrier], FilterSettings(action_low=(-1.0,), action_high=(1.0,)))
    assert plain.decide([0.0], [0.05]).status is Status.passed
