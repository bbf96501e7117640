"""A late viewer gets the current data of every robot first, even if the memory for viewers is full."""

import os
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from tests.messages import finding_of, stamp

from safedpa.bus import FINDING, ReceivedMessage
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.rerun_recording import SERVER_MEMORY
from safedpa_services.web.ports import choose_port

pytestmark = [pytest.mark.processes, pytest.mark.filterwarnings("ignore:RRD file has no footer")]

_LONG = pytest.mark.skipif("SAFEDPA_LONG_TESTS" not in os.environ, reason="minutes; say SAFEDPA_LONG_TESTS=1")
_FIRST_CHUNKS = 200
_TICKS_OF_A_BATCH, _BATCH_SECONDS = 8, 0.4
"""The recording sends what it drew every 0.4 s. The drive is drawn faster than it was driven, but for its last batches:
a viewer gets the newest ones first, so only these need their usual size."""
_PACED_BATCHES = 15
_PATIENCE_SECONDS = 240.0
_ENDED = "The drive has ended."
_NEEDED = (
    "world/obstacles", "world/clearance", "world/field", "world/goal", "now", "verdict/filter", "verdict/in_force",
    "verdict/diagnosis", "verdict/model", "services/robot", "services/policy", "services/safety_filter",
)  # fmt: skip


def _finding(k):
    return FINDING, finding_of("watching", **stamp(k, epoch=7), sentence="The model fits.", number=0, error=0.03)


class Drive:
    """Robots that drive side by side; their scenes, findings and models never change."""

    def __init__(self, look, tick_of, port, robots, memory="256MB"):
        from safedpa_services.dashboard.rerun_recording import RerunRecording

        self.recording = RerunRecording(look, "fleet", save=None, bind="127.0.0.1", grpc_port=port, memory=memory)
        self.address = f"rerun+http://127.0.0.1:{port}/proxy"
        self.view, self._robots, self._tick_of = FleetView(look), robots, tick_of

    def go(self, ticks):
        for k in range(ticks):
            messages = [*self._tick_of(k, status="passed"), *([_finding(k)] if k % 20 == 0 else [])]
            frames = self.view.take(
                [ReceivedMessage(topic, robot, message, b"", "key", 0.05 * k) for robot in self._robots
                 for topic, message in messages], 0.05 * k,
            )  # fmt: skip
            if k == 0:
                self.recording.arrange(self.view.fields)
            self.recording.draw(frames)
            if k % _TICKS_OF_A_BATCH == 0 and 0 < ticks - k < _PACED_BATCHES * _TICKS_OF_A_BATCH < ticks:
                time.sleep(_BATCH_SECONDS)
        time.sleep(_BATCH_SECONDS)


class Viewer:
    """Rerun's own client, which stores the received chunks in order.

    It opens a port of its own, by default 9876, and ends if another client uses it.
    """

    def __init__(self, address, path):
        program = Path(find_spec("rerun_cli").origin).parent / "rerun"
        self._path, self._message = path, path.with_suffix(".log")
        command = [str(program), address, "--port", "auto", "--save", str(path)]
        with self._message.open("w") as notice:
            self._process = subprocess.Popen(command, stdout=notice, stderr=notice)

    def chunks(self, enough, patience=_PATIENCE_SECONDS):
        """Returns the received chunks once ``enough`` returns true."""
        until = time.monotonic() + patience
        while not enough(found := self._read()):
            assert time.monotonic() < until, f"it got {len(found)} chunks; it said: {self._message.read_text()[-2000:]}"
            time.sleep(0.3)
        return found

    def all_chunks(self, enough, patience=_PATIENCE_SECONDS):
        """Returns the received chunks once ``enough`` returns true or, without it, once nothing more arrives."""
        counts = [0, 0]

        def settled(found):
            counts.append(len(found))
            return counts[-1] == counts[-2] == counts[-3]

        return self.chunks(lambda found: len(found) >= _FIRST_CHUNKS and (enough or settled)(found), patience)

    def _read(self):
        from rerun.chunk import RrdReader

        if not self._path.exists() or self._path.stat().st_size == 0:
            return []
        copy = self._path.with_suffix(".copy.rrd")
        copy.write_bytes(self._path.read_bytes())
        try:
            return list(RrdReader(copy).stream())
        except (RuntimeError, OSError, ValueError):  # broken off in the middle of a chunk
            return []

    def close(self):
        self._process.kill()
        self._process.wait()


@pytest.fixture
def view_of(tmp_path):
    """Starts a viewer that ends with the test."""
    viewers = []

    def start(address):
        viewers.append(Viewer(address, tmp_path / f"viewer-{len(viewers)}.rrd"))
        return viewers[-1]

    yield start
    for viewer in viewers:
        viewer.close()


@pytest.mark.parametrize(
    ("robots", "ticks", "memory"),
    [
        pytest.param(("r1",), 1500, "256MB", id="after 75 s", marks=pytest.mark.long),
        pytest.param(("r1", "r2"), 600, "256MB", id="two robots", marks=pytest.mark.long),
        pytest.param(("r1", "r2"), 600, "2MB", id="two robots, memory full", marks=pytest.mark.long),
        pytest.param(
            ("r1",), 54_000, SERVER_MEMORY, id="after 45 minutes, as shipped", marks=[_LONG, pytest.mark.long]
        ),
    ],
)
def test_a_late_viewer_receives_the_current_data_among_the_first_chunks(
    look, tick_of, free_port, view_of, robots, ticks, memory
):
    drive = Drive(look, tick_of, choose_port(None, free_port, "--grpc-port", "127.0.0.1"), robots, memory)
    full = memory == "2MB" or ticks == 54_000
    try:
        drive.go(ticks)
        enough = None if full else _has_the_beginning  # which comes last, and on a busy machine after pauses
        chunks = view_of(drive.address).all_chunks(enough, _PATIENCE_SECONDS + 0.01 * ticks)
    finally:
        drive.recording.close()
    assert full != _has_the_beginning(chunks), "was the memory limit reached?"
    first = [chunk for chunk in chunks[:_FIRST_CHUNKS] if not chunk.is_static]
    missing = {f"/robots/{robot}/{path}" for robot in robots for path in _NEEDED} - {c.entity_path for c in first}
    assert not missing
    for robot in robots:
        reported = " ".join(_texts(chunk) for chunk in first if chunk.entity_path == f"/robots/{robot}/now")
        assert "0.0 s: passed: The nominal action was passed" in reported, "the last log line is from the start"


@pytest.mark.long
def test_a_viewer_learns_that_the_drive_has_ended(look, tick_of, free_port, view_of):
    drive = Drive(look, tick_of, choose_port(None, free_port, "--grpc-port", "127.0.0.1"), ("r1",))
    try:
        drive.go(20)
        viewer = view_of(drive.address)
        viewer.chunks(lambda found: any("now" in chunk.entity_path for chunk in found))
        drive.recording.draw(drive.view.end(_ENDED, 1.0))
    finally:
        drive.recording.close()
    viewer.chunks(_is_ended)


@pytest.mark.long
def test_a_dashboard_that_ends_while_it_waits_reports_it_to_its_viewer(free_port, view_of):
    command = [sys.executable, "-m", "safedpa_services.dashboard", "--fleet", "no_one", "--grpc-port", str(free_port)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout.readline().startswith("dashboard: http")
        viewer = view_of(f"rerun+http://127.0.0.1:{free_port}/proxy")
        viewer.chunks(lambda found: any("No process found" in _texts(chunk) for chunk in found))
        process.terminate()
        viewer.chunks(lambda found: any("dashboard was ended" in _texts(chunk) for chunk in found))
    finally:
        process.kill()
        process.communicate()


def _is_ended(chunks):
    return any(f"**{_ENDED}**" in _texts(chunk) for chunk in chunks if "now" in chunk.entity_path)


def _has_the_beginning(chunks):
    return any(_begin(chunk) == 0.0 for chunk in chunks)


def _begin(chunk):
    """Returns the time of its first row [s]; infinity for static data."""
    times = [] if chunk.is_static else _column(chunk, "t")
    return min((1e-9 * getattr(value, "value", value) for value in times), default=float("inf"))


def _texts(chunk):
    if not chunk.entity_path.endswith(("/now", "/waiting")):
        return ""
    return " ".join(row[0] for row in _column(chunk, "TextDocument:text") if row)


def _column(chunk, name):
    column = chunk.to_record_batch().column(name)
    return column.cast("int64").to_pylist() if name == "t" else column.to_pylist()
