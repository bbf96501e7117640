"""Actions in flight: the barrier is evaluated where the new one takes effect."""

from collections.abc import Callable
from math import cos, hypot, sin, tau
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, LATE, SETTINGS, asked, latent_at, state_at, surroundings

from safedpa.bus import SurroundingsMessage, VerdictMessage
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.scene import propagate_obstacles
from safedpa.safety import (
    FilterSettings,
    FunctionBarrier,
    PendingActions,
    Prediction,
    RolloutBarrier,
    SafetyFilter,
    Status,
)

PERIOD, TICKS = 0.05, 3
A = np.array([[1.0, PERIOD], [0.0, 1.0]])
B = np.array([[0.5 * PERIOD**2], [PERIOD]])
ON_A_LINE = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.1, epsilon=0.002)


def affine(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return A @ x, B


def room(x: np.ndarray) -> float:
    """Room less stopping distance, the wall at 1."""
    return float(1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.1 * max(x[1], 0.0))


def furthest(seed: int, knows: bool) -> tuple[float, set[Status]]:
    """How far a mass gets whose commands arrive three ticks late, and the statuses."""
    random = np.random.default_rng(seed)
    late = PendingActions(affine, TICKS, (0.0,))
    x = np.array([random.uniform(-1.0, 0.0), 0.0])
    xi, notice, far = late.state(x), set(), -np.inf
    plain = FunctionBarrier(room)
    known = SafetyFilter(late.prediction, [late.barrier(plain)], ON_A_LINE)
    blind = SafetyFilter(affine, [plain], ON_A_LINE)
    for _ in range(110):
        nominal = [1.0] if random.random() < 0.7 else random.uniform(-1.0, 1.0, 1)
        verdict = known.decide(xi, nominal) if knows else blind.decide(x, nominal)
        notice.add(verdict.status)
        x = A @ x + B @ late.split(xi)[1][0]
        xi = late.next_state(xi, verdict.action, x)
        far = max(far, float(x[0]))
    return far, notice


@pytest.mark.long
def test_a_delay_that_is_known_costs_nothing() -> None:
    """60 runs: none beyond the wall, none relaxed; without knowing of it many end up beyond."""
    found = [furthest(seed, True) for seed in range(60)]
    assert max(far for far, _ in found) < 1.0
    assert set.union(*(notice for _, notice in found)) == {Status.passed, Status.corrected}
    assert sum(furthest(seed, False)[0] > 1.0 for seed in range(20)) >= 4


def test_the_state_holds_what_is_pending_oldest_first() -> None:
    late = PendingActions(affine, 2, (0.5,))
    xi = late.state([0.1, 0.2])
    np.testing.assert_array_equal(xi, [0.1, 0.2, 0.5, 0.5])
    xi = late.next_state(xi, [-1.0], [0.3, 0.4])
    np.testing.assert_array_equal(xi, [0.3, 0.4, 0.5, -1.0])
    after = A @ [0.3, 0.4] + B @ [0.5]
    np.testing.assert_allclose(late.step(xi, np.array([0.7])), [*after, -1.0, 0.7])
    np.testing.assert_allclose(late.state_at_effect(xi), A @ after + B @ [-1.0])
    f, g = late.affine(xi)
    np.testing.assert_allclose(f + g @ [0.7], late.step(xi, np.array([0.7])))
    np.testing.assert_array_equal(late.state([0.1, 0.2], [[1.0], [2.0]]), [0.1, 0.2, 1.0, 2.0])


def test_the_condition_is_the_one_without_delay_at_the_state_after_what_is_pending() -> None:
    random = np.random.default_rng(2)
    late = PendingActions(affine, TICKS, (0.0,))
    for _ in range(50):
        queue = random.uniform(-1.0, 1.0, (TICKS, 1))
        xi = late.state(random.uniform((0.0, -0.5), (0.6, 0.8)), queue)
        plain = SafetyFilter(affine, [FunctionBarrier(room)], ON_A_LINE).decide(late.state_at_effect(xi), [1.0])
        known = SafetyFilter(late.prediction, [late.barrier(FunctionBarrier(room))], ON_A_LINE).decide(xi, [1.0])
        assert known.status is plain.status
        np.testing.assert_allclose(known.action, plain.action, atol=1e-3)
        assert known.h_next == pytest.approx(plain.h_next, abs=1e-4)


@pytest.mark.parametrize("name", ["car", "car_learned", "pendulum_learned"])
def test_it_holds_any_model_of_the_project(name: str) -> None:
    model, random = load_model(name), np.random.default_rng(4)
    low, high = model.system.action_low, model.system.action_high
    late = PendingActions(model, 2, np.zeros(len(low)))
    latent = model.latent
    for _ in range(10):
        x = random.uniform(-1.0, 1.0, len(model.system.state))
        queue = random.uniform(low, high, (2, len(low)))
        reached = model.step(model.step(x, queue[0], latent), queue[1], latent)
        np.testing.assert_allclose(late.state_at_effect(late.state(x, queue), latent), reached, atol=1e-12)
        np.testing.assert_allclose(
            late.prediction.next_state(late.state(x, queue), low, latent, None)[-len(low) :], low
        )


def test_the_car_among_obstacles_with_a_delay_that_it_knows() -> None:
    model, settings = load_model("car"), FilterSettings.for_robot("car")
    scene = car_barriers(settings, (0.08, 0.40, 0.12), [(2.0, 0.1, 0.3)], (-4, 4, -4, 4))
    late = PendingActions(model, 2, (0.0, 0.0))
    barriers = [late.barrier(part, model.latent) for part in scene]
    other = PendingActions(load_model("pendulum"), 2, (0.0,))
    with pytest.raises(InputError, match="reads the states"):
        SafetyFilter(other.prediction, barriers, settings, state_range=other.state_range)
    safe = SafetyFilter(late.prediction, barriers, settings, state_range=late.state_range)
    x = np.zeros(4)
    xi, notice = late.state(x), set()
    for _ in range(80):
        verdict = safe.decide(xi, [2.0, 0.0], model.latent)
        notice.add(verdict.status)
        x = model.step(x, late.split(xi)[1][0])
        xi = late.next_state(xi, verdict.action, x)
        assert min(part.h(x).min() for part in scene) > 0.0
    assert notice == {Status.passed, Status.corrected}


def test_the_gradient_by_the_chain_rule_is_that_of_its_values() -> None:
    model, random = load_model("car"), np.random.default_rng(1)
    late = PendingActions(model, 2, (0.0, 0.0))
    for part in car_barriers(FilterSettings.for_robot("car"), (0.08, 0.40, 0.12), [(2.0, 0.1, 0.3)], (-4, 4, -4, 4)):
        barrier = late.barrier(part, model.latent)
        for _ in range(5):
            xi = late.state(random.uniform((-1, -1, -3, 0.2), (1, 1, 3, 1.5)), random.uniform(-0.3, 0.3, (2, 2)))
            steps = 1e-6 * np.eye(len(xi))
            near = np.array([(barrier.h(xi + step) - barrier.h(xi - step)) / 2e-6 for step in steps]).T
            h, gradient = barrier.h_and_grad(xi)
            np.testing.assert_array_equal(h, barrier.h(xi))
            np.testing.assert_allclose(gradient, near, atol=2e-6)
            directions = 0.1 * random.normal(size=(len(xi), 3))
            np.testing.assert_allclose(barrier.lie_derivative(xi, directions), gradient @ directions, atol=1e-5)


def test_what_looks_between_ticks_still_does() -> None:
    looking = RolloutBarrier(lambda x: (np.array(x), np.eye(1)), (0.0,), lambda x: abs(x[0] - 1.0) - 0.1, 1)
    late = PendingActions(lambda x: (np.array(x), np.eye(1)), 1, (0.0,))
    barrier, ahead, beyond = late.barrier(looking), late.state([0.8]), np.array([0.8, 0.4])
    assert barrier.h(beyond)[0] == pytest.approx(0.1)
    assert barrier.starting_at(ahead).h(beyond)[0] == pytest.approx(-0.1, abs=1e-6)
    plain = late.barrier(FunctionBarrier(lambda x: x[0]))
    assert plain.starting_at(ahead) is plain


def test_what_is_no_delay_is_named() -> None:
    late = PendingActions(Prediction(affine), 2, (0.0,))
    cases: list[tuple[Callable[[], object], str]] = [
        *(
            (
                lambda count=count: PendingActions(affine, count, (0.0,)),
                "wanted a whole number of pending actions, 1 or more",
            )
            for count in (0, -1, True, 1.0, "1", None)
        ),
        (lambda: late.split(np.zeros(2)), "state: got shape"),
        (lambda: late.split(np.zeros((1, 4))), "state: got shape"),
        (lambda: late.state([[0.0, 0.0]]), "pending: got state"),
        (lambda: late.state(1.0), "pending: got state"),
        (lambda: late.state([0.0, 0.0], np.zeros((2, 2))), "pending: got"),
        (lambda: PendingActions(affine, 2, ()), "wanted (actions,) finite"),
        (lambda: PendingActions(affine, 2, (np.nan,)), "wanted (actions,) finite"),
        (lambda: late.state([0.0, 0.0], [[1.0]]), "pending: got"),
        (lambda: late.state_at_effect(np.zeros(2)), "make it with state()"),
        (lambda: PendingActions(lambda x, a: x[:1], 1, (0.0,)).state_at_effect(np.zeros(3)), "predicted state"),
    ]
    for made, notice in cases:
        with pytest.raises(InputError) as error:
            made()
        assert notice in str(error.value)


def test_a_barrier_is_judged_with_the_latent_that_it_was_given() -> None:
    """The car's way there depends on its latent; two ways by the model itself, and without one by its own."""
    model, x = load_model("car"), np.array([0.1, -0.2, 0.3, 0.8])
    late, queue = PendingActions(model, 2, (0.0, 0.0)), np.array([[1.0, 0.2], [1.5, -0.3]])
    ahead = FunctionBarrier(lambda state: 3.0 - state[0] - 0.1 * state[3])
    other = 0.5 * np.asarray(model.latent) + 0.4
    found = []
    for given, latent in ((None, model.latent), (other, other)):
        end = model.step(model.step(x, queue[0], latent), queue[1], latent)
        found.append(float(late.barrier(ahead, given).h(late.state(x, queue))[0]))
        assert found[-1] == pytest.approx(3.0 - end[0] - 0.1 * end[3], abs=1e-12)
    assert abs(found[0] - found[1]) > 1e-3


@pytest.mark.parametrize("resting", [(0.0, np.nan), (np.inf, 0.0), (), ((0.0, 0.0),)])
def test_what_rests_is_a_row_of_finite_numbers(resting: tuple[object, ...]) -> None:
    with pytest.raises(InputError, match="resting"):
        PendingActions(load_model("car"), 2, resting)  # type: ignore[arg-type]


class Robot:
    """The model itself behind the filter; in the ticks of ``lost`` the watchdog's action is applied."""

    def __init__(self, model: PhysicsModel, until_action: float = 0.0, lost: tuple[int, ...] = ()) -> None:
        self.model, self.until_action, self.lost = model, until_action, lost
        self.node = SafetyFilterNode(model, SETTINGS)
        self.values = np.array((0.0, 0.0, 0.0, 0.0))
        self.memory: Any = model.initial_memory(np.zeros(2), model.latent)
        self.applied, self.applied_by, self.tick = (0.0, 0.0), "none", 0

    def turn(self, nominal: tuple[float, float] = (1.0, 0.0)) -> VerdictMessage:
        reported: dict[str, Any] = {"applied": self.applied, "applied_by": self.applied_by}
        state = state_at(self.tick, tuple(self.values.tolist()), until_action=self.until_action, **reported)
        verdict = asked(self.node, state, latent_at(state, self.model), nominal)
        lost = self.tick in self.lost
        self.applied, self.applied_by = ((0.0, 0.0), "watchdog") if lost else (verdict.action, "filter")
        self.values, self.memory = self.model.advance(
            self.values, np.array(self.applied), self.memory, self.model.latent
        )
        self.tick += 1
        return verdict


@pytest.mark.parametrize("lost", [(), (5,), (5, 6), (4, 8)])
def test_the_watchdogs_actions_come_behind_what_is_in_flight(lost: tuple[int, ...]) -> None:
    robot = Robot(LATE, lost=lost)
    for tick in range(14):
        truth, start = robot.memory, robot.values
        verdict = robot.turn((0.2 * tick, 0.01 * tick))
        path, _ = LATE.rollout_held(start, np.array(verdict.action), truth, LATE.latent, 8, period=0.05)
        np.testing.assert_allclose(verdict.predicted, path[: len(verdict.predicted)], atol=1e-12)


def test_predictions_that_come_true_leave_the_margin_as_it_is() -> None:
    robot = Robot(LATE)
    for _ in range(12):
        verdict = robot.turn()
    np.testing.assert_allclose(verdict.predicted[0], robot.values, atol=1e-12)
    assert verdict.margin == pytest.approx(SETTINGS.epsilon["obstacle"])


@pytest.mark.parametrize("age", [0.1, 0.2])
def test_the_filter_predicts_from_where_the_action_of_an_old_state_acts(age: float) -> None:
    new, old = Robot(CAR), Robot(CAR, age)
    for robot in (new, old):
        robot.values = np.array((3.4, 0.0, 0.0, 1.6))
        robot.applied, robot.applied_by = (2.0, 0.0), "filter"
    assert old.turn((2.0, 0.0)).h_next < new.turn((2.0, 0.0)).h_next - 0.5 * age


POINTS = ((1.0, 2.0, 0.05), (3.0, -1.0, 0.4))


def seen(movers: tuple[tuple[float, ...], ...], hidden: tuple[tuple[float, ...], ...]) -> SurroundingsMessage:
    known = {"movers": movers, "hidden": hidden, "problems": ("one source is late",)}
    return surroundings(state_at(3), points=POINTS, ages=(0.05, 0.1), **known)


@pytest.mark.parametrize("seed", range(5))
def test_every_way_a_mover_can_go_ends_within_its_disc_and_the_fastest_at_its_edge(seed: int) -> None:
    """Ways of ten legs in any directions at any speeds allowed; the straight one at full speed leads to the edge."""
    random = np.random.default_rng(seed)
    x, y, radius, speed = random.uniform((-5.0, -5.0, 0.0, 0.1), (5.0, 5.0, 1.0, 3.0)).tolist()
    seconds = float(random.uniform(0.02, 1.4))
    found = propagate_obstacles(seen(((x, y, radius, 0.3, -0.2, speed),), ((x, y, radius, speed),)), seconds)
    for row in (*found.movers, *found.hidden):
        middle_x, middle_y, wide = row[:3]
        for _ in range(50):
            legs, at_x, at_y = random.dirichlet(np.ones(10)) * seconds, x, y
            for leg, angle, pace in zip(
                legs, random.uniform(0.0, tau, 10), random.uniform(0.0, speed, 10), strict=True
            ):
                at_x, at_y = at_x + leg * pace * cos(angle), at_y + leg * pace * sin(angle)
            assert hypot(at_x - middle_x, at_y - middle_y) + radius <= wide + 1e-12
        angle = float(random.uniform(0.0, tau))
        far_x, far_y = x + seconds * speed * cos(angle), y + seconds * speed * sin(angle)
        assert hypot(far_x - middle_x, far_y - middle_y) + radius == pytest.approx(wide)


def test_speeds_and_stationary_points_are_passed_on_unchanged() -> None:
    before = seen(((1.0, 2.0, 0.3, 0.4, -0.5, 0.8), (0.0, 1.0, 0.2, 0.0, 0.0, 0.0)), ((4.0, 5.0, 0.6, 1.5),))
    found = propagate_obstacles(before, 0.2)
    assert [row[3:] for row in found.movers] == [(0.4, -0.5, 0.8), (0.0, 0.0, 0.0)]
    assert [row[3:] for row in found.hidden] == [(1.5,)]
    assert [len(row) for row in (*found.movers, *found.hidden)] == [6, 6, 4]
    assert found.movers[1] == before.movers[1], "who may not move is where it was"
    assert (found.points, found.ages, found.problems) == (before.points, before.ages, before.problems)


@pytest.mark.parametrize("seconds", [0.0, -0.1])
def test_what_acts_at_once_sees_what_is_seen(seconds: float) -> None:
    before = seen(((1.0, 2.0, 0.3, 0.4, -0.5, 0.8),), ((4.0, 5.0, 0.6, 1.5),))
    assert propagate_obstacles(before, seconds) is before


@pytest.mark.parametrize("width", [0, 1, 2, 3, 5, 7])
def test_rows_of_another_width_are_left_for_the_scene_to_refuse(width: int) -> None:
    odd = tuple(float(number) for number in range(width))
    found = propagate_obstacles(seen((odd, (1.0, 2.0, 0.3, 0.4, -0.5, 0.8)), (odd,)), 0.5)
    assert found.movers[0] == odd
    assert found.movers[1][2] == pytest.approx(0.7)
    assert found.hidden == (odd,)
