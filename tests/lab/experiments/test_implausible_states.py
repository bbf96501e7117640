"""The laboratory's failed states: what the source sends, and that the experiment's drives are stopped."""

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments.driving.false_stops import healthy_drive
from safedpa_lab.experiments.driving.implausible_states import (
    StateDrive,
    implausible_states,
    right_reasons,
    run_state_drive,
)
from safedpa_lab.experiments.driving.state_faults import FAULTS, ROBOTS, FaultyState, StateFault
from safedpa_lab.experiments.driving.state_limits import measured_evidence

CAR = ROBOTS["car"]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_changes_the_message_and_not_the_robot(fault: StateFault) -> None:
    robot = CAR.make("none", 3)
    begun = StateFault(fault.kind, fault.size, begin=0.0)
    source = FaultyState(robot, CAR.system, begun, 3, noise=0.0)
    sent = []
    for _ in range(5):
        sent.append(source.state_message())
        source.advance()
    if fault.kind == "jump":
        gap = np.subtract(sent[0].values, CAR.make("none", 3).values)[:2]
        assert np.hypot(*gap) == pytest.approx(fault.size)
    if fault.kind == "clock":
        stamps, arrivals = (np.ptp([getattr(one, name) for one in sent]) for name in ("robot_time", "publish_time"))
        assert stamps / arrivals == pytest.approx(fault.size)
    if fault.kind.startswith("frozen"):
        assert len({one.values for one in sent}) == 1
    assert robot.tick == 5


@pytest.mark.long
@pytest.mark.parametrize("fault", [StateFault("jump", 0.8, 1.0), StateFault("frozen", begin=1.0)])
def test_a_drive_with_a_fault_is_stopped_for_the_right_reason(fault: StateFault) -> None:
    found = run_state_drive(StateDrive("car", "none", 11, 2.0, fault))
    assert any(reason in found["stopped"] for reason in fault.reasons)
    assert (found["hits"], found["after_seconds"] <= 0.3) == ([], True)


@pytest.mark.long
@pytest.mark.parametrize("fault", [StateFault("jump", 0.8, 0.6), StateFault("clock", 3.0, 2.5), StateFault("none")])
def test_a_drive_behind_the_gateway_is_stopped_for_the_right_reason_and_only_then(fault: StateFault) -> None:
    found = run_state_drive(StateDrive("car", "none", 11, 1.2 if fault.kind == "jump" else 2.7, fault, gateway=True))
    reasons = right_reasons(fault, gateway=True)
    assert any(reason in found["stopped"] for reason in reasons) is bool(reasons), found["stopped"]
    assert (found["hits"], found["way"] > 0.1) == ([], True)
    assert not reasons or found["after_seconds"] <= 0.3 + 1e-6


def test_a_robot_without_a_ros_interface_is_refused_behind_the_gateway() -> None:
    with pytest.raises(InputError, match="point: it has no ROS interface"):
        implausible_states(["point"], [1], 1.0, 0, gateway=True)


@pytest.mark.long
def test_a_healthy_drive_shows_small_errors_of_every_unit() -> None:
    rows = measured_evidence(StateDrive("car", "none", 5, 1.5, StateFault("none")))
    assert set(rows[-1].jump) == {"m", "rad", "m/s"}
    assert max(row.jump["m"] for row in rows) < 0.1


@pytest.mark.parametrize("seed", [2068001, 2068003])
def test_frozen_states_do_not_change_the_estimate_with_which_a_robot_brakes(seed: int) -> None:
    """The estimate from frozen states says that no command moves the robot; a throttle car then reversed at 3 m/s."""
    found = run_state_drive(StateDrive("car_throttle", "none", seed, 5.0, StateFault("frozen")))
    assert "does not change" in found["stopped"]
    assert not found["hits"]


@pytest.mark.parametrize("seed", [2075001, 2075002])
def test_a_frozen_speed_does_not_turn_a_resting_throttle_into_a_speed(seed: int) -> None:
    """The gateway publishes a throttle as the speed that it reaches: with a frozen speed, throttle 0 means drive on."""
    found = run_state_drive(StateDrive("car_throttle", "none", seed, 8.0, StateFault("frozen"), gateway=True))
    assert "does not change" in found["stopped"]
    assert not found["hits"]


@pytest.mark.parametrize("seed", [2068001, 2068003])
def test_a_car_that_was_estimated_to_be_weak_does_not_reverse_when_its_state_is_lost(seed: int) -> None:
    """Its throttle brakes three times as hard as estimated at low throttle; it then reversed at 3 m/s."""
    assert not run_state_drive(StateDrive("car_throttle", "none", seed, 6.0, StateFault("lost", 5.0)))["hits"]


@pytest.mark.long
def test_a_creeping_robot_and_a_delay_between_two_periods_are_no_wrong_state() -> None:
    """In these healthy drives states were refused: one creeps, one is late by 2.3 periods, with pauses."""
    for seed, index in ((2070211, 211), (2070215, 215)):
        assert not run_state_drive(healthy_drive("car_throttle", index, seed, 20.0))["stopped"]
