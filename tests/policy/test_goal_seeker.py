"""The goal seeker gets there, within its limits, the same every time and the same on both sides."""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.errors import InputError
from safedpa.robots.car.controllers.goal_seeker import GoalSeeker, GoalSeekerSettings

PERIOD = 0.05
REACHED = 0.3
SETTINGS = GoalSeekerSettings()

State = tuple[float, float, float, float]
Point = tuple[float, float]

coordinates = some.floats(-3.5, 3.5)
starts = some.tuples(coordinates, coordinates, some.floats(-math.pi, math.pi), some.floats(-0.5, 1.5))
goals = some.tuples(coordinates, coordinates)


def moved(state: State, action: tuple[float, float]) -> State:
    """The kinematic bicycle over one period, speed servo of gain 4 / s."""
    x, y, yaw, speed = state
    speed += 4.0 * (action[0] - speed) * PERIOD
    yaw += speed * math.tan(action[1]) / SETTINGS.wheelbase * PERIOD
    return x + speed * math.cos(yaw) * PERIOD, y + speed * math.sin(yaw) * PERIOD, yaw, speed


def seconds_to(goal: Point, state: State, longest: float = 60.0) -> float:
    """When the goal is reached in an empty field; infinity when it is not."""
    seeker = GoalSeeker()
    for tick in range(round(longest / PERIOD)):
        if math.hypot(goal[0] - state[0], goal[1] - state[1]) < REACHED:
            return tick * PERIOD
        state = moved(state, seeker.nominal_action(tick * PERIOD, state, goal))
    return math.inf


@given(starts, goals)
@settings(max_examples=150)
def test_it_reaches_any_goal_from_any_start(start: State, goal: Point) -> None:
    assert seconds_to(goal, start) < math.inf


@pytest.mark.parametrize("distance", [0.35, 0.5, 0.7, 0.905, 1.2])
@pytest.mark.parametrize("bearing", [math.pi / 2, -math.pi / 2, 1.2, 2.0, math.pi, 2.9])
def test_it_reaches_goals_inside_its_turning_circle(distance: float, bearing: float) -> None:
    """A goal abeam, nearer than the car can turn, would be circled for ever by pure pursuit."""
    goal = (distance * math.cos(bearing), distance * math.sin(bearing))
    assert seconds_to(goal, (0.0, 0.0, 0.0, 0.0)) < 30.0


def test_a_goal_straight_ahead_is_approached_straight_and_impossible_settings_are_refused() -> None:
    assert seconds_to((3.0, 0.0), (0.0, 0.0, 0.0, 0.0)) < 4.5
    speed, steer = GoalSeeker().nominal_action(0.0, (0.0, 0.0, 0.0, 0.0), (3.0, 0.0))
    assert (speed, steer) == (SETTINGS.cruise_speed, 0.0)
    for wrong in ({"cruise_speed": 0.0}, {"reverse_speed": 0.5}, {"steer_limit": 0.0}, {"wheelbase": -1.0}):
        with pytest.raises(InputError, match="goal seeker"):
            GoalSeekerSettings(**wrong)


@given(some.lists(some.tuples(starts, goals, some.floats(0.0, 2.0)), min_size=1, max_size=40))
def test_whatever_happens_it_stays_within_its_limits(events: list[tuple[State, Point, float]]) -> None:
    seeker, time = GoalSeeker(), 0.0
    for state, goal, elapsed in events:
        time += elapsed
        speed, steer = seeker.nominal_action(time, state, goal)
        assert SETTINGS.reverse_speed <= speed <= SETTINGS.cruise_speed
        assert abs(steer) <= SETTINGS.steer_limit


@given(starts, goals)
@settings(max_examples=30)
def test_it_is_deterministic(start: State, goal: Point) -> None:
    one, other = GoalSeeker(), GoalSeeker()
    state = start
    for tick in range(100):
        nominal = one.nominal_action(tick * PERIOD, state, goal)
        assert nominal == other.nominal_action(tick * PERIOD, state, goal)
        state = moved(state, nominal)


@given(starts, goals)
@settings(max_examples=60)
def test_the_mirror_image_drives_the_mirror_image(start: State, goal: Point) -> None:
    one, other = GoalSeeker(), GoalSeeker()
    x, y, yaw, speed = start
    bearing = math.atan2(goal[1] - y, goal[0] - x) - yaw
    if abs(math.sin(bearing)) < 1e-6 or math.hypot(goal[0] - x, goal[1] - y) < REACHED:
        return  # straight ahead or behind it has to choose a side; near the goal it gets the next one
    for tick in range(80):
        nominal = one.nominal_action(tick * PERIOD, (x, y, yaw, speed), goal)
        mirrored = other.nominal_action(tick * PERIOD, (x, -y, -yaw, speed), (goal[0], -goal[1]))
        assert mirrored == pytest.approx((nominal[0], -nominal[1]), abs=1e-9)
        if tick < 40:  # drives, then is held, so that backing off is mirrored as well
            x, y, yaw, speed = moved((x, y, yaw, speed), nominal)
        if math.hypot(goal[0] - x, goal[1] - y) < REACHED:
            return


@given(starts, goals, some.floats(-3.0, 3.0), some.tuples(coordinates, coordinates))
@settings(max_examples=40)
def test_turning_and_shifting_the_world_changes_nothing(start: State, goal: Point, turn: float, shift: Point) -> None:
    x, y, yaw, speed = start
    if math.cos(math.atan2(goal[1] - y, goal[0] - x) - yaw) < -1.0 + 1e-6 or math.hypot(goal[0] - x, goal[1] - y) < 0.1:
        return  # straight behind: the sides are alike

    def seen(point: Point) -> Point:
        c, s = math.cos(turn), math.sin(turn)
        return c * point[0] - s * point[1] + shift[0], s * point[0] + c * point[1] + shift[1]

    nominal = GoalSeeker().nominal_action(0.0, start, goal)
    turned = GoalSeeker().nominal_action(0.0, (*seen((x, y)), yaw + turn, speed), seen(goal))
    assert turned == pytest.approx(nominal, abs=1e-6)


def shuttled(settings: GoalSeekerSettings, seconds: float = 40.0) -> list[str]:
    """The modes, one after the other, where what is next to it lets it turn to the goal's side backwards alone."""
    seeker, state, modes = GoalSeeker(settings), (0.0, 0.0, 0.0, 0.0), [""]
    for tick in range(round(seconds / PERIOD)):
        speed, steer = seeker.nominal_action(tick * PERIOD, state, (0.3, -0.9))
        x, y, _, speed = moved(state, (speed, max(steer, 0.0) if speed > 0.0 else steer))
        state = (min(x, 0.3), y, 0.0, speed)  # the heading is where it was after a turn that comes to nothing
        if seeker.mode != modes[-1]:
            modes.append(seeker.mode)
    return modes[1:]


def test_room_that_leads_nowhere_is_not_made_for_ever() -> None:
    """Forwards and backwards it is held back nowhere, and comes no nearer: for 60 s at 50 Hz."""
    modes = shuttled(SETTINGS)
    before = modes[: modes.index("detour")]
    assert before.count("make_room") == SETTINGS.rooms + 1
    assert "back_off" not in before
    assert "detour" not in shuttled(GoalSeekerSettings(rooms=1000)), (
        "else something else ends it, and this tests nothing"
    )


def test_after_so_much_room_it_passes_the_goal_by_further_and_on_both_sides() -> None:
    seeker = GoalSeeker(GoalSeekerSettings(rooms=0))
    lasted: list[float] = []
    sides: list[float] = []
    time = 0.0
    for attempt in range(1, 6):
        while seeker.mode != "make_room":
            seeker.nominal_action(time, (0.0, 0.0, 0.0, 0.0), (0.0, -0.9))
            time += PERIOD
        while seeker.mode == "make_room":  # the goal is straight ahead at once
            _, steer = seeker.nominal_action(time, (0.0, 0.9, -math.pi / 2, 0.0), (0.0, -0.9))
            time += PERIOD
        assert seeker.mode == "detour", attempt
        began = time
        sides.append(math.copysign(1.0, steer))
        while seeker.mode == "detour":
            seeker.nominal_action(time, (0.0, 0.9 - 1.2 * (time - began), -math.pi / 2, 0.0), (0.0, -0.9))
            time += PERIOD
        lasted.append(time - began)
    assert lasted == pytest.approx([SETTINGS.detour_seconds * share for share in (1, 2, 3, 4, 4)], abs=2.1 * PERIOD)
    assert sides[0] == -sides[1] == sides[2] == -sides[3]


def held(seeker: GoalSeeker, seconds: float, start: float = 0.0) -> list[tuple[str, tuple[float, float]]]:
    """What it requests while something holds it in place, by mode."""
    found = []
    for tick in range(round(seconds / PERIOD)):
        nominal = seeker.nominal_action(start + tick * PERIOD, (0.0, 0.0, 0.0, 0.0), (3.0, 1.0))
        found.append((seeker.mode, nominal))
    return found


def test_held_in_place_it_tries_one_thing_after_the_other_and_backs_off_whatever_it_tows() -> None:
    modes = [mode for mode, _ in held(GoalSeeker(), 8.0)]
    order = [mode for mode, before in zip(modes, ["", *modes], strict=False) if mode != before]
    assert order[:5] == ["seek", "back_off", "detour", "back_off", "detour"], "none for longer than its patience"
    assert modes.index("back_off") * PERIOD <= SETTINGS.patience_seconds + PERIOD
    assert backed_off(2.0) == pytest.approx(0.7, abs=0.05), "no shorter than 1.4 s"
    assert backed_off(5.0) == pytest.approx(SETTINGS.back_off_way, abs=0.05)


def backed_off(seconds_a_metre: float) -> float:
    """How far it backs off when it is held ahead, and reverses so slowly [m]."""
    seeker, x, back = GoalSeeker(), 0.0, 0.0
    for tick in range(400):
        speed, _ = seeker.nominal_action(tick * PERIOD, (x, 0.0, 0.0, 0.0), (3.0, 1.0))
        if seeker.mode == "detour":
            return back
        x -= PERIOD / seconds_a_metre if speed < 0.0 else 0.0
        back = -x
    return back


def test_held_back_while_it_backs_off_it_tries_the_other_side_before_it_goes_on() -> None:
    tried = held(GoalSeeker(), 8.0)
    first = next(index for index, (mode, _) in enumerate(tried) if mode == "back_off")
    steers = []
    for mode, (_, steer) in tried[first:]:
        if mode != "back_off":
            break
        steers.append(math.copysign(1.0, steer))
    changes = [at for at, (one, other) in enumerate(pairwise(steers), 1) if one != other]
    assert len(changes) == 1, "once, however long it is held"
    assert changes[0] * PERIOD == pytest.approx(SETTINGS.patience_seconds, abs=2.1 * PERIOD)


def test_a_goal_behind_is_turned_to_in_moves_to_one_side_or_at_once_where_it_is_far() -> None:
    seeker, steers = GoalSeeker(), set()
    for tick in range(160):
        nominal = seeker.nominal_action(tick * PERIOD, (0.0, 0.0, 0.0, 0.0), (-1.0, 3.0))
        assert seeker.mode in ("seek", "back_off")
        if seeker.mode == "back_off":
            steers.add(nominal[1])
    assert steers == {-SETTINGS.steer_limit}, "in reverse the nose turns against the wheels"
    near, far = (
        GoalSeeker().nominal_action(0.0, (0.0, 0.0, 0.0, 0.0), (0.8, 0.8)),
        GoalSeeker().nominal_action(0.0, (0.0,) * 4, (5.0, 5.0)),
    )
    assert far[1] == near[1] > 0.3


def test_backing_off_goes_backwards_changes_sides_and_ends_with_a_new_goal() -> None:
    events = [nominal for mode, nominal in held(GoalSeeker(), 20.0) if mode == "back_off"]
    assert {speed for speed, _ in events} == {SETTINGS.reverse_speed}
    assert {math.copysign(1.0, steer) for _, steer in events} == {-1.0, 1.0}
    seeker = GoalSeeker()
    held(seeker, SETTINGS.patience_seconds + 0.2)
    assert seeker.mode == "back_off"
    seeker.nominal_action(2.0, (0.0, 0.0, 0.0, 0.0), (3.0, -1.0))
    assert seeker.mode == "seek"
