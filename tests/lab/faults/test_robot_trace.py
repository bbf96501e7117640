"""The robot's own trace, and the last gate of all: what is too old when it would begin to act does not act."""

from __future__ import annotations

from pathlib import Path

import pytest

from safedpa.bus import ACTION, STATE, ActionMessage, Bus, MemoryBroker, MemoryTransport, StateMessage
from safedpa.bus.wire.codec import decode
from safedpa.errors import RecordingError
from safedpa_sim.robots import CarRobot, Scene, Trace, read_trace
from safedpa_sim.robots.loop import RobotLoop


class HeldUp:
    """A robot that is answered at once; its clock jumps by ``pause`` s while tick ``at`` is under way."""

    def __init__(self, file: Path, pause: float = 0.0, at: int = 3) -> None:
        broker = MemoryBroker()
        self.now, self._pause, self._at = 0.0, pause, at
        self._filter = MemoryTransport(broker)
        self._filter.subscribe("safedpa/test/r1/state", self._on_state)
        self._sender = Bus(self._filter, "test")
        self.robot = CarRobot(Scene.random(1), lockstep=False, epoch=9)
        with Trace(file) as trace:
            RobotLoop(self.robot, Bus(MemoryTransport(broker), "test"), "r1", self._clock, trace=trace).run(
                lambda: False, 8
            )

    def _clock(self) -> float:
        self.now += 0.001
        return self.now

    def _on_state(self, _: str, payload: bytes) -> None:
        state = decode(STATE.message, payload)
        assert isinstance(state, StateMessage)
        action = ActionMessage(epoch=state.epoch, tick=state.tick, robot_time=0.0, publish_time=0.0, values=(1.0, 0.1))
        self._sender.publish(ACTION, "r1", action)
        if state.tick == self._at:
            self.now += self._pause  # SIGSTOP: the answer waits in the process, which does not run


def test_every_period_leaves_a_line(tmp_path: Path) -> None:
    robot = HeldUp(tmp_path / "trace").robot
    periods = list(read_trace(tmp_path / "trace"))
    assert [one.tick for one in periods] == list(range(8))
    assert {one.applied_by for one in periods} == {"filter"}
    assert all((one.action_epoch, one.action_tick) == (9, one.tick) for one in periods)
    assert all(0.0 < one.age <= 2 * robot.period for one in periods)
    assert periods[3].applied == (1.0, 0.1)


def test_a_robot_that_was_held_up_does_not_act_on_what_it_saw_before(tmp_path: Path) -> None:
    robot = HeldUp(tmp_path / "trace", pause=2.0).robot
    periods = list(read_trace(tmp_path / "trace"))
    assert [one.tick for one in periods if one.applied_by == "watchdog"] == [3]
    assert periods[3].action_tick == -1
    assert periods[3].age > 2.0
    assert robot.guard.refusals == {"too old": 1}


def test_a_short_delay_of_the_process_costs_nothing(tmp_path: Path) -> None:
    robot = HeldUp(tmp_path / "trace", pause=0.05).robot
    assert robot.watchdog_ticks == 0


def test_a_line_that_a_killed_robot_did_not_finish_is_left_out(tmp_path: Path) -> None:
    HeldUp(tmp_path / "trace")
    whole = (tmp_path / "trace").read_bytes()
    (tmp_path / "trace").write_bytes(whole[:-7])
    assert [one.tick for one in read_trace(tmp_path / "trace")] == list(range(7))


def test_a_trace_that_cannot_be_written_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="--trace"):
        Trace(tmp_path / "nowhere" / "trace")
