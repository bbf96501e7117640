"""``safedpa up --secure`` whose processes are killed: nothing of it drives on, no key stays, the next one starts."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from tests.waiting import until

pytestmark = [
    pytest.mark.long,
    pytest.mark.processes,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="finds processes by their environment"),
]
KILLED = ("router", "adaptation", "policy", "safety_filter", "recorder")


class Run:
    """One ``up --secure`` with all its processes, found by the folder in their environment."""

    def __init__(self, folder: Path, *options: str) -> None:
        (folder / "private").mkdir(exist_ok=True)
        self.folder = folder
        self._seen = dict[int, str]()
        command = [sys.executable, "-m", "safedpa_services", "up", "--secure", "--headless", "--no-diagnosis", "--json"]
        self.launcher = subprocess.Popen(
            [*command, "--out", str(folder / "runs"), *options],
            env={**os.environ, "TMPDIR": str(folder / "private")},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def processes(self) -> dict[int, str]:
        """Its command line by process id; a process that shows no one its environment does so by its parent, and is
        known from then on, since it may lose that parent.
        """
        own, parents, lines = {self.launcher.pid}, dict[int, int](), dict[int, str]()
        for path in Path("/proc").glob("[0-9]*"):
            try:
                phrase = (path / "cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
                lines[int(path.name)] = phrase
                parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
                if str(self.folder).encode() in (path / "environ").read_bytes():
                    own.add(int(path.name))
            except OSError:
                continue
        own |= {pid for pid, phrase in self._seen.items() if lines.get(pid) == phrase}
        children = {pid for pid, above in parents.items() if above in own}
        self._seen = {pid: lines[pid] for pid in (own | children) & lines.keys()}
        return dict(self._seen)

    def pid_of(self, service: str) -> int:
        """Of the newest process of a service; 0 without one."""
        return max(
            (pid for pid, phrase in self.processes().items() if f"safedpa_services.{service} " in phrase), default=0
        )

    def files(self) -> list[str]:
        """What lies in its private place."""
        return sorted(path.name for path in (self.folder / "private").rglob("*") if path.is_file())

    def recorded(self) -> int:
        """Bytes of its recordings, which grow while it drives."""
        return sum(path.stat().st_size for path in self.folder.glob("runs/*/recording*.mcap"))


def _is_new(run: Run, service: str, before: int) -> bool:
    return run.pid_of(service) not in (0, before)


def _has_grown(run: Run, size: int) -> bool:
    return run.recorded() > size + 20_000


@contextmanager
def driving(folder: Path, *options: str) -> Iterator[Run]:
    run = Run(folder, *options)
    try:
        assert until(lambda: run.recorded() > 60_000), "it drives"
        yield run
    finally:
        for pid in [run.launcher.pid, *run.processes()]:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        run.launcher.communicate()


def test_with_the_launcher_everything_ends_and_the_next_one_starts(tmp_path: Path) -> None:
    with driving(tmp_path, "--seconds", "600") as run:
        assert len(run.processes()) > 6
        assert [name for name in run.files() if name.endswith(".key.pem")] == ["operator.key.pem"]
        run.launcher.kill()
        run.launcher.wait()
        assert until(lambda: not run.processes()), f"left behind: {run.processes()}"
        assert run.files() == [], "no key, and nothing else"
        account = json.loads(next(tmp_path.glob("runs/*/robot.json")).read_text(encoding="utf-8"))
        assert account["collisions"] == 0
        assert account["watchdog_ticks"] > 0, "it braked to a standstill by itself"
        output, errors = Run(tmp_path, "--seconds", "1", "--lockstep").launcher.communicate(timeout=120)
        assert json.loads(output)["ticks"] == 20, errors


def test_each_service_that_is_killed_comes_back_and_the_robot_brakes_meanwhile(tmp_path: Path) -> None:
    with driving(tmp_path, "--seconds", "600") as run:
        for service in KILLED:
            before = run.pid_of(service)
            assert before
            os.kill(before, signal.SIGKILL)
            assert until(partial(_is_new, run, service, before)), f"{service} did not come back"
            assert before not in run.processes()
            size = run.recorded()
            assert until(partial(_has_grown, run, size)), f"it does not drive on after {service}"
            assert [name for name in run.files() if name.endswith(".key.pem")] == ["operator.key.pem"]
        run.launcher.send_signal(signal.SIGINT)
        output, errors = run.launcher.communicate(timeout=120)
        assert run.launcher.returncode == 0, errors
        reported = json.loads(output)
        assert reported["collisions"] == 0
        assert {entry["name"] for entry in reported["services"] if entry["restarts"]} >= set(KILLED)
        assert until(lambda: not run.processes())
        assert run.files() == []
