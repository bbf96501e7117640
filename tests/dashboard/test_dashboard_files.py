"""The dashboard's files: bounded, never overwritten, and stopped before the disk is full."""

import json
import shutil
from types import SimpleNamespace

import pytest
from rerun.chunk import RrdReader

from safedpa.bus import ReceivedMessage
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.rerun_recording import FileLimits, RerunRecording

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")
SMALL = FileLimits(file_bytes=30_000, files=3, free_bytes=1000)


def draw(recording, look, tick_of, clock, seconds, view=None):
    """Draws a drive; the clock of the limits advances with it."""
    view, first = view or FleetView(look), round(20.0 * clock.now)
    for k in range(first, first + round(20.0 * seconds)):
        clock.now = 0.05 * k
        items = [ReceivedMessage(t, "r1", m, b"", f"safedpa/fleet/r1/{t.name}", clock.now) for t, m in tick_of(k)]
        frames = view.take(items, clock.now)
        recording.arrange(view.fields)
        recording.draw(frames)
    return view


@pytest.fixture
def clock(monkeypatch):
    made = SimpleNamespace(now=0.0)
    monkeypatch.setattr("time.monotonic", lambda: made.now)
    return made


def recording_of(look, path, limits=SMALL):
    return RerunRecording(look, "fleet", save=path, bind="127.0.0.1", grpc_port=None, limits=limits)


def test_files_are_bounded_in_size_and_number_and_each_can_be_read(look, tick_of, clock, tmp_path):
    recording = recording_of(look, tmp_path / "dashboard.rrd")
    draw(recording, look, tick_of, clock, 60.0)
    recording.close()
    files = sorted(tmp_path.iterdir())
    assert 1 < len(files) <= 3
    assert not (tmp_path / "dashboard.rrd").exists(), "the oldest was removed"
    assert max(path.stat().st_size for path in files) < 40 * SMALL.file_bytes, "batches of 5 s come after the limit"
    paths = {chunk.entity_path for chunk in RrdReader(files[0]).stream()}
    assert {"/meaning", "/robots/r1/verdict/filter", "/robots/r1/world"} <= paths, "it has what is sent once"


def test_a_file_that_exists_is_never_written_to(look, tick_of, clock, tmp_path):
    for number in range(3):
        recording = recording_of(look, tmp_path / "dashboard.rrd", FileLimits())
        draw(recording, look, tick_of, clock, 2.0)
        recording.close()
        sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
        assert len(sizes) == number + 1
    assert {"dashboard.rrd", "dashboard-2.rrd", "dashboard-3.rrd"} == set(sizes)
    assert min(sizes.values()) > 10_000


def test_an_almost_full_disk_stops_the_file_with_one_message_and_it_goes_on_in_another(
    look, tick_of, clock, tmp_path, monkeypatch, capfd
):
    disk = SimpleNamespace(total=0, used=0, free=10_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk)
    monkeypatch.setenv("SAFEDPA_LOG", "json")
    recording = recording_of(look, tmp_path / "dashboard.rrd", FileLimits(free_bytes=1000))
    view = draw(recording, look, tick_of, clock, 3.0)
    disk.free = 900
    draw(recording, look, tick_of, clock, 8.0, view)
    names = {path.name for path in tmp_path.iterdir()}
    disk.free = 1500
    draw(recording, look, tick_of, clock, 3.0, view)
    assert {path.name for path in tmp_path.iterdir()} == names == {"dashboard.rrd"}, "not before there is some to spare"
    disk.free = 10_000
    draw(recording, look, tick_of, clock, 12.0, view)
    recording.close()
    assert {path.name for path in tmp_path.iterdir()} == {"dashboard.rrd", "dashboard-2.rrd"}
    events = [json.loads(line)["kind"] for line in capfd.readouterr().err.splitlines() if line.startswith("{")]
    assert events == ["dashboard.file_stopped", "dashboard.file_resumed"]
