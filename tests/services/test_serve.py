"""``safedpa serve`` reports when the robot begins to drive and when the gateway brakes it, once per change."""

import signal

import pytest
from click.testing import CliRunner
from tests.messages import health_of, state_of

from safedpa.bus import HEALTH, STATE, Bus, MemoryBroker, MemoryTransport
from safedpa_services.command_line import serve

SILENT, DRIVES, BRAKES = None, "", "brakes: no action for 12 ticks"


@pytest.fixture
def served(monkeypatch, tmp_path):
    """served(details): the printed lines of a drive whose robot reported these details in turn; nothing is started."""
    broker = MemoryBroker()
    robot = Bus(MemoryTransport(broker), "fleet")

    def run(turns):
        class Supervisor:
            def __init__(self, _services, _robot, watch, _stop, on_turn, *_others):
                self.watch, self.on_turn = watch, on_turn

            def run(self):
                for turn in turns:
                    if turn is not SILENT:
                        robot.publish(*turn)
                    self.watch.listen(0.0)
                    self.on_turn()
                return 0

        monkeypatch.setattr("safedpa_services.supervisor.supervisor.Supervisor", Supervisor)
        monkeypatch.setattr("safedpa.bus.ZenohTransport", lambda _: MemoryTransport(broker))
        file = tmp_path / "robot.toml"
        file.write_text('format = 2\nrobot = "car"\nname = "own"\n', encoding="utf-8")
        phrase = [str(file), "--headless", "--policy", "random", "--no-diagnosis", "--out", str(tmp_path)]
        result = CliRunner().invoke(serve.command, phrase)
        assert result.exception is None, result.output
        return [line for line in result.output.splitlines() if line.startswith("robot own:")]

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield run
    for number, handler in before.items():
        signal.signal(number, handler)


def beat(detail):
    return HEALTH, "own", health_of("robot", detail=detail), "robot"


def test_driving_is_reported_once_and_not_before_the_robot_is_heard(served):
    assert served([SILENT]) == []
    assert served([SILENT, *[(STATE, "own", state_of())] * 5]) == ["robot own: the filter drives"]


def test_braking_by_itself_and_driving_on_are_reported(served):
    drives = "robot own: the filter drives"
    details = [DRIVES, DRIVES, BRAKES, BRAKES, DRIVES, DRIVES]
    assert served([beat(detail) for detail in details]) == [drives, f"robot own: {BRAKES}", drives]
