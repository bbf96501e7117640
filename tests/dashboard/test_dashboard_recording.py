"""From the bus to a file that Rerun can read."""

import pytest

from safedpa.bus import HEALTH, Bus, MemoryBroker, MemoryTransport, encode
from safedpa.records import McapRecorder
from safedpa_services.dashboard.dashboard import Dashboard, draw_recording
from safedpa_services.dashboard.fleet_view import FleetView

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@pytest.fixture
def recording(look, drive, tmp_path):
    """Recording of three robots that drive for five seconds, with two kinds of invalid messages."""
    from safedpa_services.dashboard.rerun_recording import RerunRecording

    path = tmp_path / "drive.rrd"
    broker = MemoryBroker()
    sender, listener = MemoryTransport(broker), MemoryTransport(broker)
    robots, recording = Bus(sender, "fleet"), RerunRecording(look, "fleet", save=path, bind="127.0.0.1", grpc_port=None)
    dashboard = Dashboard(Bus(listener, "fleet"), FleetView(look), recording)
    own = robots.inbox((HEALTH,))
    for tick in drive(100):
        for topic, message in tick:
            for robot in ("r1", "r 2", "front/".strip("/") + "-left"):
                robots.publish(topic, robot, message, getattr(message, "service", ""))
        sender.put("safedpa/fleet/r1/state", b"rubbish", never_drop=False)
        dashboard.turn(0.0)
    recording.close()
    heard = [item.message for item in own.take(0.0) if item.message.service == "dashboard"]
    assert heard[-1].refused > 0
    assert heard[-1].state == "running"
    return path


def test_the_recording_is_readable_and_complete(recording):
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


def test_the_recording_contains_the_arrangement_of_its_panes(recording):
    from rerun.chunk import RrdReader

    assert len(RrdReader(recording).recordings()) == 1
    assert len(RrdReader(recording).blueprints()) >= 1


def test_a_recording_of_messages_is_drawn_completely_and_at_its_times(look, drive, tmp_path):
    """Independent of the reading speed: no frame is left out and no service is shown as silent."""
    from rerun.chunk import RrdReader

    path, drawn = tmp_path / "a.mcap", tmp_path / "a.rrd"
    with McapRecorder(path) as recorder:
        for k, tick in enumerate(drive(100)):
            for topic, message in tick:
                if topic is HEALTH and k % 5:
                    continue  # four heartbeats a second
                service = f"/{message.service}" if topic is HEALTH else ""
                recorder.write(f"safedpa/f/r1/{topic.name}{service}", encode(message), 50_000_000 * k, 0)
        recorder.write("safedpa/f/r1/state", b"garbage", 6_000_000_000, 0)
    draw_recording([path], look, drawn)
    batches = [(chunk.entity_path, chunk.to_record_batch()) for chunk in RrdReader(drawn).stream()]
    bodies = [batch.column("t").cast("int64") for path, batch in batches if path == "/robots/r1/world/body"]
    seconds = sorted(1e-9 * value for column in bodies for value in column.to_pylist())
    assert seconds == pytest.approx([0.05 * k for k in range(100)])
    lanes = [
        str(batch.column(name).to_pylist())
        for path, batch in batches
        for name in batch.schema.names
        if path == "/robots/r1/services/policy" and name.startswith("StateChange")
    ]
    assert any("running" in lane for lane in lanes)
    assert not any("silent" in lane for lane in lanes)
