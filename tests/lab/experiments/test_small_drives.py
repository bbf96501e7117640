"""Small versions of drives in reverse, of long drives, of late commands, and of changed nominal actions."""

import dataclasses
import itertools

import pytest
from tests.messages import stamp, state_of

from safedpa.bus import NOMINAL, AbstractNode, Inputs, NominalMessage, Outputs, StateMessage
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa_lab.experiments.car.conditions import QuickerPolicyNode
from safedpa_lab.experiments.car.drives import ExploringPolicyNode
from safedpa_lab.experiments.driving.delayed_drives import Lateness, delayed_drives, margin_with_delay
from safedpa_lab.experiments.driving.long_drives import LongDrive, run_long_drive
from safedpa_lab.experiments.driving.reversing_drives import ReversingDrive, run_reversing_drive
from safedpa_sim.robots.car import robot as car_robot

ONCE_COLLIDED = (("box", 510), ("chair", 502))


@pytest.mark.parametrize(("load", "seed"), [*ONCE_COLLIDED, ("large_chair", 503)])
def test_no_load_collides_while_it_is_reversed_at_the_nearest_obstacle(load: str, seed: int) -> None:
    outcome, reversed_metres = run_reversing_drive(ReversingDrive(load, seed))
    assert outcome.collisions == 0
    assert reversed_metres > 0.3
    assert outcome.least_h > -0.01


def test_a_robot_that_hides_its_load_collides(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the footprint alone leaves open; were it closed some other way, the growth would not be needed."""
    monkeypatch.setattr(car_robot, "towed_reach", lambda load: ())
    assert sum(run_reversing_drive(ReversingDrive(*drive))[0].collisions for drive in ONCE_COLLIDED) > 0


def test_a_drive_is_the_same_every_time() -> None:
    drive = ReversingDrive("chair", 7, seconds=4.0)
    assert run_reversing_drive(drive) == run_reversing_drive(drive)
    long = LongDrive("large_chair", 9003, seconds=12.0)
    assert run_long_drive(long) == run_long_drive(long)


@pytest.mark.long
@pytest.mark.parametrize("seed", [9003, 7001])
def test_the_heaviest_load_gets_on_where_it_once_stood(seed: int) -> None:
    """In the dead band of a correction (9003), and short of the margin with all the room ahead (7001)."""
    outcome = run_long_drive(LongDrive("large_chair", seed, seconds=60.0))
    assert outcome.collisions == 0
    assert outcome.longest_stand < 10.0
    assert sum(outcome.statuses.values()) == 1200


@pytest.mark.long
@pytest.mark.parametrize("until_action", [0.0, 0.002, 0.006, 0.02])
def test_a_box_between_two_obstacles_gets_on_however_old_the_state_is(until_action: float) -> None:
    """It once stood for 69 s there, and crawled 0.6 m in 20 s while the policy gave up reversing to one side alone."""
    outcome = run_long_drive(LongDrive("box", 1, seconds=100.0, until_action=until_action))
    assert outcome.collisions == 0
    assert outcome.longest_stand < 10.0
    assert outcome.least_way > 0.4, "backwards the box lets it do 6 cm a second"


@pytest.mark.long
def test_a_known_delay_is_driven_with() -> None:
    """With the margin that belongs to it, which lies where the action begins to act."""
    margin = margin_with_delay(Lateness(0.3), 8, 8.0)
    assert 0.005 < margin.epsilon["obstacle"] < 0.08
    assert set(margin.epsilon) == {"obstacle", "field", "speed"}
    found = delayed_drives(Lateness(0.3), 4, 900, 8.0, margin=margin)
    assert found.collided == 0
    assert found.goals > 0
    assert found.statuses["corrected"] > found.statuses["relaxed"] + found.statuses["violated"]
    assert found.statuses["passed"] > 0.5 * found.statuses.total()


@pytest.mark.long
@pytest.mark.parametrize("channel", ["steer", "drive"])
def test_a_channel_that_is_late_alone(channel: str) -> None:
    """Over twelve drives: in single scenes more is relaxed than corrected, and which ones depends on each decision."""
    found = delayed_drives(Lateness(0.2, channel), 12, 31_000, 8.0)
    assert found.collided == 0
    assert found.goals > 0
    assert found.statuses["corrected"] > found.statuses["relaxed"] + found.statuses["violated"]
    assert found.statuses["fallback"] == 0


@pytest.mark.long
def test_a_delay_that_the_robot_measures_is_driven_with() -> None:
    reported = delayed_drives(Lateness(0.13, reported="clock"), 4, 31_000, 8.0)
    assert reported.collided == 0
    assert reported.goals > 0
    silent = delayed_drives(Lateness(0.13, reported="none"), 4, 31_000, 8.0)
    assert silent.collided == 0, "within the delay that is allowed for"


@pytest.mark.long
def test_an_unknown_delay_causes_no_collision() -> None:
    assert delayed_drives(Lateness(0.15, reported="none"), 4, 31_000, 8.0).collided == 0


@pytest.mark.long
def test_drives_repeat_exactly() -> None:
    assert delayed_drives(Lateness(0.13), 1, 5, 3.0) == delayed_drives(Lateness(0.13), 1, 5, 3.0)


def test_invalid_delays_are_refused() -> None:
    with pytest.raises(InputError, match="channel: got 'wheel', wanted one of both, drive, steer"):
        Lateness(0.1, "wheel")
    with pytest.raises(InputError, match="reported: got 'all', wanted one of model, clock, none"):
        Lateness(0.1, reported="all")
    with pytest.raises(InputError, match="channel: got 'drive', wanted both"):
        Lateness(0.1, "drive", reported="clock")
    for allowed in (Lateness(0.1, "drive"), Lateness(0.1, "steer", "none"), Lateness(0.1, reported="clock")):
        assert allowed.seconds == 0.1


STATE = state_of(tick=3, robot_time=0.15)


class FixedPolicy(AbstractNode):
    """Always the same nominal action."""

    name, inputs, outputs = PolicyNode.name, PolicyNode.inputs, PolicyNode.outputs

    def __init__(self, *values: float) -> None:
        self.values = values
        self.forgotten: list[str] = []

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot, inputs
        return {NOMINAL: NominalMessage(**stamp(state.tick), values=self.values, controller="test")}

    def forget(self, robot: str) -> None:
        self.forgotten.append(robot)


def nominal_values(node: AbstractNode, state: StateMessage = STATE) -> tuple[float, ...]:
    nominal = node.step("car", state, {})[NOMINAL]
    assert isinstance(nominal, NominalMessage)
    return nominal.values


@pytest.mark.parametrize(
    ("values", "wanted"), [((0.5, 0.2), (1.0, 0.2)), ((-0.5, 0.2), (-0.5, 0.2)), ((0.0, -0.1), (0.0, -0.1))]
)
def test_only_driving_forwards_is_quicker(values: tuple[float, ...], wanted: tuple[float, ...]) -> None:
    assert nominal_values(QuickerPolicyNode(FixedPolicy(*values), 2.0)) == wanted


def test_a_quicker_policy_takes_the_place_of_its_policy_and_forgets_with_it() -> None:
    policy = FixedPolicy(0.5, 0.0)
    node = QuickerPolicyNode(policy, 2.0)
    node.forget("car_7")
    assert policy.forgotten == ["car_7"]
    assert (node.name, node.inputs, node.outputs) == (PolicyNode.name, PolicyNode.inputs, PolicyNode.outputs)


def test_an_explored_action_lasts_for_its_time_and_stays_within_the_bounds() -> None:
    node, reported = ExploringPolicyNode(FixedPolicy(0.6, 0.1), 4), list[tuple[float, ...]]()
    for tick in range(200):
        reported.append(nominal_values(node, dataclasses.replace(STATE, tick=tick, robot_time=0.05 * tick)))
    starts = [0, *(tick for tick in range(1, 200) if reported[tick] != reported[tick - 1])]
    held = [0.05 * (end - start) for start, end in itertools.pairwise(starts)]
    assert len(held) > 5
    assert min(held) >= 0.4 - 1e-9
    assert max(held) <= 1.5 + 0.05 + 1e-9
    assert all(-0.6 <= speed <= 2.0 and abs(steer) <= 0.34 for speed, steer in reported)
