"""The page's server answers while a long or hostile recording is read."""

import os
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pyarrow
import pytest
from pyarrow import csv

pytest.importorskip("nicegui")
pytestmark = [pytest.mark.long, pytest.mark.processes]

PAGE = """
import sys
from pathlib import Path
from nicegui import app
from safedpa_services.web.page_options import PageServerOptions
from safedpa_services.workbench.server import serve
from safedpa_services.workbench.session.controller import SessionController
from safedpa_services.workbench.session.inputs import InputSelection

controller = SessionController(InputSelection("car", (sys.argv[1],)), Path(sys.argv[3]))
async def read():
    await controller.open_initial()
    print("read", controller.error_message, flush=True)
app.on_startup(read)
options = PageServerOptions("127.0.0.1", int(sys.argv[2]))
serve(controller, options, browser=False, announce=lambda where: None)
"""
MOST_SECONDS, BUSY = 0.5, 20.0
"""Longest answer; on a busy machine, so many times the median."""


def answered(port: int) -> float | None:
    """Seconds until the server answers, if only that the token is missing; None before it listens."""
    began = time.monotonic()
    try:
        urlopen(f"http://127.0.0.1:{port}/", timeout=60.0).close()
    except HTTPError as error:
        error.close()
    except OSError:
        return None
    return time.monotonic() - began


def answers_while_read(path: Path, port: int, folder: Path) -> tuple[list[float], str]:
    """Seconds of each answer while a recording is read, and what the page says of it then."""
    command = [sys.executable, "-c", PAGE, str(path), str(port), str(folder)]
    # the framework behaves differently where it takes itself to be under test
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        lines: list[str] = []
        reader = threading.Thread(target=lambda: lines.extend(iter(server.stdout.readline, "")), daemon=True)
        reader.start()
        took, until = [], time.monotonic() + 120.0
        while not lines and server.poll() is None and time.monotonic() < until:
            took += [seconds for seconds in [answered(port)] if seconds is not None]
            time.sleep(0.02)
        server.terminate()
        server.wait(60.0)
        reader.join(60.0)
    return took, "".join(lines)


def long_table(path: Path) -> Path:
    t = 0.01 * np.arange(400_000)
    columns = {"t": t, "x": np.sin(0.3 * t), "y": np.cos(0.2 * t), "yaw": 0.1 * np.sin(t), "speed": 1 + 0.1 * np.cos(t)}
    columns |= {"target_speed": 1 + 0.1 * np.sin(t), "steer": 0.1 * np.cos(0.2 * t)}
    csv.write_csv(pyarrow.table(columns), path)
    return path


def endless_bag(path: Path) -> Path:
    """Its definitions are a view of endless rows."""
    with closing(sqlite3.connect(path)) as base:
        base.execute("CREATE TABLE topics(id INTEGER, name, type, serialization_format)")
        base.execute("CREATE TABLE messages(topic_id, timestamp, data)")
        rows = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS topic_type FROM c"
        base.execute(f"CREATE VIEW message_definitions AS {rows} ORDER BY 1")
    return path


@pytest.mark.parametrize(
    ("name", "make", "problem"),
    [("long.csv", long_table, ""), ("endless.db3", endless_bag, "'message_definitions' is no plain table")],
)
def test_the_page_answers_while_it_reads(name, make, problem, free_port, tmp_path: Path) -> None:
    took, shown = answers_while_read(make(tmp_path / name), free_port, tmp_path / "out")
    assert problem in shown
    assert max(took) < max(MOST_SECONDS, BUSY * float(np.median(took)))
