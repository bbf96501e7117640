"""Send and log times in a recording, in nanoseconds by this machine's clock."""

import dataclasses
import time

import pytest
from mcap.reader import make_reader

from safedpa.bus import STATE, Bus, MemoryBroker, MemoryTransport, StateMessage
from safedpa.bus.messages.service_info import setup_message
from safedpa_services.recorder import recorder as module
from safedpa_services.recorder.recorder import Recorder
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene


class Clocks:
    """The module's ``time``, which measures how long the reader of both clocks was held up between them."""

    sleep = staticmethod(time.sleep)

    def __init__(self) -> None:
        self.held_up = 0.0
        self._began = time.monotonic()

    def time_ns(self) -> int:
        self._began = time.monotonic()
        return time.time_ns()

    def monotonic(self) -> float:
        now = time.monotonic()
        self.held_up = max(self.held_up, now - self._began)
        return now


@pytest.mark.parametrize("published", [0.0, 1.25, 1_764_108_000.123456])
def test_both_times_of_a_message_are_nanoseconds_of_this_machine(tmp_path, published, monkeypatch):
    """Read by a reader that is not ours. It came when it was heard, however late it is written."""
    broker = MemoryBroker()
    ears, robot = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f")
    recorder = Recorder(ears, tmp_path / "r.mcap", setup_message("recorder", {}))
    state = CarRobot(Scene.random(1, "none"), wall_clock=lambda: published).state_message()
    before = time.time_ns()
    robot.publish(STATE, "r1", dataclasses.replace(state, publish_time=published))
    after = time.time_ns()
    time.sleep(0.05)
    clocks = Clocks()
    with monkeypatch.context() as patch:
        patch.setattr(module, "time", clocks)
        recorder.turn(0.0)
    recorder.run(lambda: True)
    with (tmp_path / "r.mcap").open("rb") as file:
        rows = [message for _, channel, message in make_reader(file).iter_messages() if "/state" in channel.topic]
    (row,) = rows
    assert isinstance(state, StateMessage)
    assert row.publish_time == pytest.approx(1e9 * published, rel=1e-15, abs=1.0)
    slack = 2_000_000 + int(1e9 * clocks.held_up)  # two clocks are read one after the other
    assert clocks.held_up > 0.0
    assert before - slack <= row.log_time <= after + slack
