"""A car with a throttle whose drag its model lacks, as a recording on disk."""

import asyncio
import csv
import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from safedpa.bus.transport import ports
from safedpa.dynamics import PhysicsModel, Setting, save_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

COLUMNS = ("t", "x", "y", "yaw", "speed", "throttle", "steer")
NOISE = np.array([0.002, 0.002, 0.003, 0.015])
"""m, m, rad, m/s; of the measured states."""


def _plain():
    return PhysicsModel(
        KinematicBicycle("throttle"), [], {"base.wheelbase": Setting(0.3), "base.drive_gain": Setting(3.0)}
    )


def _rows(model, seconds, seed):
    draw = np.random.default_rng(seed)
    count = round(seconds / 0.05)
    steer = np.repeat(draw.uniform(-0.4, 0.4, count // 8 + 1), 8)
    throttle = np.repeat(draw.uniform(-0.6, 1.0, count // 12 + 1), 12)
    state, rows = np.array([0.0, 0.0, 0.0, 1.0]), []
    memory = model.initial_memory(np.array([throttle[0], steer[0]]))
    for row in range(count):
        action = np.array([np.clip(throttle[row] + 0.3 * (1.5 - state[3]), -1.0, 1.0), steer[row]])
        rows.append([0.05 * row, *(state + NOISE * draw.normal(size=4)), *action])
        state, memory = model.advance(state, action, memory, period=0.05, time=0.05 * row)
    return rows


def _written(path, rows, columns=COLUMNS):
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


@pytest.fixture(scope="session")
def finished():
    """Runs a coroutine to its end, on a thread of its own: the browser's tests leave a running loop in this one."""
    with ThreadPoolExecutor(1) as pool:  # the story itself is given up: else its thread were waited for without an end
        yield lambda story: pool.submit(asyncio.run, asyncio.wait_for(story, 240.0)).result()


@pytest.fixture(scope="session")
def plain():
    """A car with throttle and no effect."""
    return _plain()


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """A model file, and two recordings of a car with quadratic drag that the model does not have."""
    folder = tmp_path_factory.mktemp("drives")
    truth = _plain().with_effect(effect("car", "quadratic_drag"), {"coefficient": Setting(0.3)})
    save_model(_plain(), folder / "plain.toml")
    runs = [_written(folder / f"drive_{seed}.csv", _rows(truth, 40.0, seed)) for seed in (1, 2)]
    return folder / "plain.toml", runs


@pytest.fixture(scope="session")
def short_drive(tmp_path_factory):
    """12 s with the same hidden drag: a third of the search, for tests of what a page does with what was found."""
    truth = _plain().with_effect(effect("car", "quadratic_drag"), {"coefficient": Setting(0.3)})
    return _written(tmp_path_factory.mktemp("short") / "short.csv", _rows(truth, 12.0, 1))


@pytest.fixture(scope="session")
def short_drives(drives, short_drive):
    """The model file and two recordings of 12 s, for tests that look at a page or a report of more than one drive."""
    truth = _plain().with_effect(effect("car", "quadratic_drag"), {"coefficient": Setting(0.3)})
    return drives[0], [short_drive, _written(short_drive.with_name("shorter.csv"), _rows(truth, 12.0, 2))]


@pytest.fixture(scope="session")
def complete_drive(tmp_path_factory):
    """A recording that the model without any effect explains."""
    return _written(tmp_path_factory.mktemp("complete") / "complete.csv", _rows(_plain(), 60.0, 3))


@pytest.fixture(scope="session")
def runs(drives, plain):
    """The recordings with the hidden drag."""
    return [load_run(path, plain.system) for path in drives[1]]


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium; skips where there is none. Ends with its file: while it lives, no other loop runs here."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    with playwright.sync_playwright() as play:
        arguments = ["--no-sandbox", "--disable-background-networking"]
        started = play.chromium.launch(executable_path=chromium, args=arguments, timeout=_PATIENCE_MS)
        yield PatientBrowser(started)
        started.close()


_PATIENCE_MS = 240_000
"""Of whatever is asked of a page; playwright's own half minute is not enough for a busy machine to load one."""


class PatientBrowser:
    """Opens pages that have patience."""

    def __init__(self, started):
        self._started = started

    def new_context(self, **options):
        context = self._started.new_context(**options)
        context.set_default_timeout(_PATIENCE_MS)
        return context

    def new_page(self, **options):
        page = self._started.new_page(**options)
        page.set_default_timeout(_PATIENCE_MS)
        return page


@pytest.fixture
def serve(free_port, tmp_path):
    """Starts ``safedpa workbench`` with arguments; returns its address."""
    with _workbenches(free_port, tmp_path) as start:
        yield start


@pytest.fixture(scope="module")
def shown_workbench(short_drives, tmp_path_factory):
    """The address of a workbench with two recordings, for tests that look at it and decide nothing."""
    model, recordings = short_drives
    with _workbenches(ports.free_port(), tmp_path_factory.mktemp("shown")) as start:
        yield start(model, *recordings)


@contextmanager
def _workbenches(free_port, folder):
    started = []

    def start(*arguments):
        program = [sys.executable, "-m", "safedpa_services", "workbench", *map(str, arguments)]
        options = ["--no-browser", "--port", str(free_port), "--out", str(folder / "out")]
        # the framework behaves differently where it takes itself to be under test
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
        environment["OMP_NUM_THREADS"] = "1"
        server = subprocess.Popen([*program, *options], stdout=subprocess.PIPE, text=True, env=environment)
        started.append(server)
        line = server.stdout.readline()
        assert f":{free_port}" in line, line
        return line.split()[1]

    yield start
    for server in started:
        server.send_signal(signal.SIGINT)
        try:
            assert server.wait(_END_SECONDS) == 0
        finally:
            server.kill()
            server.wait()
            server.stdout.close()


_END_SECONDS = 240.0
"""Patience with a server that ends: on a busy machine it takes its time."""

SERVER = """
import json, sys, threading, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from live_messages import finding, model, state, REPORT
from safedpa.bus.service.process import StopSignal
from safedpa.bus import FINDING, MODEL, STATE, Answer, Bus, MemoryBroker, MemoryTransport
from safedpa_services.workbench.session.controller import SessionController
from safedpa_services.workbench.session.inputs import InputSelection
from safedpa_services.web.page_options import PageServerOptions
from safedpa_services.workbench.server import serve

broker = MemoryBroker()
bus, robot = Bus(MemoryTransport(broker), "fleet"), Bus(MemoryTransport(broker), "fleet")
asked = []

def answer(name, request):
    if request.do == "status":
        left = () if "accept" in asked else ("towed_load",)
        return Answer(ok=True, sentence="the model is the one that the robot began with", candidates=left,
                      foreseen=("the margin of obstacle goes from 0.03 to 0.1",), earlier=len(asked))
    if request.model != "aaaa" or request.finding != 1:
        return Answer(ok=False, sentence="refused: another model")
    asked.append(request.do)
    robot.publish(MODEL, "r1", model(tick[0], "take"))
    return Answer(ok=True, sentence=f"change 1 is offered to {request.who}")

tick, seconds = [0], float(sys.argv[3])
def drive():
    while True:
        tick[0] += 1
        rests = tick[0] > 200 and seconds > 0.01
        robot.publish(STATE, "r1", state(tick[0]))
        if rests or tick[0] % 20 == 0:
            done = "accept" in asked
            message = finding(tick[0], "watching", 0.1) if done else finding(
                tick[0], "candidates", 0.5, json.dumps(REPORT), 1)
            robot.publish(FINDING, "r1", message)
        time.sleep(seconds if rests else 0.01)

robot.answer_requests(answer)
threading.Thread(target=drive, daemon=True).start()
controller = SessionController(InputSelection(), Path(sys.argv[1]))
options = PageServerOptions("127.0.0.1", int(sys.argv[2]))
serve(controller, options, browser=False, bus=bus, stop=StopSignal())
"""


@pytest.fixture
def live(free_port, tmp_path):
    """A live page of a drive that is played: the server's process and its address."""
    with _live_server(free_port, tmp_path) as started:
        yield started


@pytest.fixture(scope="module")
def shown_live(tmp_path_factory):
    """The address of such a page, for tests that look at it and decide nothing: it rests between two ticks."""
    with _live_server(ports.free_port(), tmp_path_factory.mktemp("live"), seconds=1.0) as (_, address):
        yield address


@contextmanager
def _live_server(free_port, folder, seconds=0.01):
    """A tick every so many ``seconds``, once there are enough to be drawn."""
    source = (Path(__file__).parent / "test_live.py").read_text(encoding="utf-8")
    start, stop = source.index("REPORT = {"), source.index("@pytest.fixture\ndef history")
    messages = (Path(__file__).parents[1] / "messages.py").read_text(encoding="utf-8")
    header = f"{messages}\nfrom safedpa.bus import ModelMessage\n\n"
    (folder / "live_messages.py").write_text(header + source[start:stop], encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    command = [sys.executable, "-c", SERVER, str(folder), str(free_port), str(seconds)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        line = server.stdout.readline()
        assert "/live" in line
        yield server, line.split()[1]
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(_END_SECONDS)
        finally:
            server.kill()
            server.wait()
            server.stdout.close()
