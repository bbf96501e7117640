"""From the bus to a file that Rerun reads again."""

from __future__ import annotations

import pytest

from safedpa.bus import HEALTH, Bus, MemoryBroker, MemoryTransport
from safedpa_services.dashboard.dashboard import Dashboard
from safedpa_services.dashboard.fleet_view import FleetView

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@pytest.fixture
def recording(look, drive, tmp_path):
    """Of three robots driving for five seconds, two kinds of rubbish among their messages."""
    from safedpa_services.dashboard.painter import Painter

    path = tmp_path / "drive.rrd"
    broker = MemoryBroker()
    sender, listener = MemoryTransport(broker), MemoryTransport(broker)
    robots, painter = Bus(sender, "fleet"), Painter(look, "fleet", save=path, bind="127.0.0.1", grpc_port=None)
    dashboard = Dashboard(Bus(listener, "fleet"), FleetView(look), painter)
    own = robots.inbox((HEALTH,))
    for tick in drive(100):
        for topic, message in tick:
            for robot in ("r1", "r 2", "front/".strip("/") + "-left"):
                robots.publish(topic, robot, message, getattr(message, "service", ""))
        sender.put("safedpa/fleet/r1/state", b"rubbish", never_drop=False)
        dashboard.turn(0.0)
    painter.close()
    heard = [item.message for item in own.take(0.0) if item.message.service == "dashboard"]
    assert heard[-1].refused > 0
    assert heard[-1].state == "running"
    return path


def test_the_recording_is_readable_and_nothing_of_a_robot_is_missing(recording):
    from rerun.chunk import RrdReader

    rows: dict[str, int] = {}
    for chunk in RrdReader(recording).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    for robot in ("r1", r"r\ 2", "front-left"):
        under = {path.removeprefix(f"/robots/{robot}/"): count for path, count in rows.items()}
        for path in ("world/body", "barrier", "action/steer", "latent/towed_load.mass_ratio"):
            assert under[path] >= 100, path
        assert under["residual"] == 100, "one style and 99 residuals"
        assert 3 <= under["verdict/filter"] < 30, "colours, passed, corrected, and keyframes"
        assert 2 <= under["services/policy"] < 30
    assert rows["/robots/r1/log"] == 2 + 20


def test_the_recording_carries_its_own_arrangement(recording):
    from rerun.chunk import RrdReader

    assert len(RrdReader(recording).recordings()) == 1
    assert len(RrdReader(recording).blueprints()) >= 1


class Slow:
    """A stream whose viewers read late, or never."""

    def __init__(self, never: bool) -> None:
        self.never, self.done = never, []

    def flush(self, *, timeout_sec: float) -> None:
        self.done.append(("flush", timeout_sec))
        if self.never:
            raise RuntimeError("timeout")

    def disconnect(self) -> None:
        self.done.append(("disconnect", 0.0))


@pytest.mark.parametrize("never", [False, True])
def test_what_is_on_its_way_is_written_first_for_a_second_at_most_and_then_all_is_closed(look, never):
    from safedpa_services.dashboard.painter import Painter

    painter = Painter(look, "fleet", save=None, bind="127.0.0.1", grpc_port=None)
    painter._stream = stream = Slow(never)
    painter.close()
    assert stream.done == [("flush", 1.0), ("disconnect", 0.0)]
