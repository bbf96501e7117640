"""Which tests reach a place, and how long each takes: lies next to the code of the copy in which faults are planted.

The faulty statement calls ``reported`` in every process and thread; pytest loads this file as a plug-in (``-p``). Both
write lines of JSON into the file of the same name that ends in ``.jsonl``, which an interrupted run leaves behind.
"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

CALL = '__import__("reached").reported()'
"""What stands at the place."""
RECORD = Path(__file__).with_suffix(".jsonl")
_REPORTED = set[str]()


def reported() -> bool:
    """True; at the first call within a test that this test was here. A test's processes inherit its name."""
    now = os.environ.get("PYTEST_CURRENT_TEST", "")
    if now not in _REPORTED:
        _REPORTED.add(now)
        _write({"reached": now})
    return True


def pytest_runtest_logstart(nodeid: str) -> None:
    """A test that does not end has begun."""
    _write({"begun": nodeid})


def pytest_runtest_logreport(report: Any) -> None:
    """Of a part of a test: its preparation, itself, its end."""
    _write({"ran": report.nodeid, "failed": bool(report.failed), "when": report.when, "seconds": report.duration})


def pytest_collectreport(report: Any) -> None:
    """A file that cannot be read is a failure of its own."""
    if report.failed:
        _write({"ran": report.nodeid, "failed": True, "when": "collect", "seconds": 0.0})


def _write(row: dict[str, Any]) -> None:
    with contextlib.suppress(OSError):
        descriptor = os.open(RECORD, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            os.write(descriptor, json.dumps(row).encode() + b"\n")
        finally:
            os.close(descriptor)
