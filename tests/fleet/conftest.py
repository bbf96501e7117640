"""A running fleet for the tests of this folder, which run only when they are asked for: ``make test-fleet``."""

import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fleet_containers import LOADS, SERVICES, Fleet, Watch, run

_BASE = "python:3.11.14-slim-bookworm"
_ROWS = pytest.StashKey[list[tuple[str, ...]]]()


def pytest_configure(config: pytest.Config) -> None:
    """Registers the marker of this folder."""
    config.addinivalue_line("markers", "fleet: starts a fleet of containers for minutes; only with -m fleet")
    config.stash[_ROWS] = []


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves these tests out unless they are asked for by their marker."""
    if "fleet" in (config.option.markexpr or ""):
        return
    items[:] = [item for item in items if item.get_closest_marker("fleet") is None]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Prints what each fault and each intruder brought about."""
    rows = config.stash[_ROWS]
    if rows:
        if os.environ.get("SAFEDPA_FLEET_TABLE"):
            Path(os.environ["SAFEDPA_FLEET_TABLE"]).write_text(_markdown(rows), encoding="utf-8")
        terminalreporter.section("the fleet")
        width = max(len(row[0]) for row in rows)
        for row in rows:
            terminalreporter.write_line(f"{row[0]:<{width}}  {'  '.join(row[1:])}")


def _markdown(rows: list[tuple[str, ...]]) -> str:
    """The table as a page of the documentation."""
    load = "/".join(f"{value:.0f}" for value in os.getloadavg())
    when = f"{time.strftime('%Y-%m-%d %H:%M')} UTC, {os.cpu_count()} cores, load average over 1/5/15 minutes {load}"
    lines = [f"| {row[0]} | {'; '.join(' '.join(cell.split()) for cell in row[1:])} |" for row in rows]
    head = [
        "# A fleet of containers under faults",
        "",
        f"`make test-fleet`, {when} at the end.",
        "",
        "| what | came of it |",
    ]
    return "\n".join([*head, "|---|---|", *lines, ""])


@pytest.fixture(scope="session")
def rows(request: pytest.FixtureRequest) -> list[tuple[str, ...]]:
    """Lines of the table at the end."""
    return request.config.stash[_ROWS]


@pytest.fixture(scope="session")
def fleet(rows: list[tuple[str, ...]]) -> Iterator[Fleet]:
    """Four robots with different loads and everything that serves them."""
    reason = os.environ.get("SAFEDPA_NO_CONTAINERS") or _missing()
    if reason:
        pytest.skip(reason)
    fleet = Fleet(len(LOADS), ",".join(LOADS))
    fleet.down()  # of a run that was broken off
    rows.append(("images", f"built in {fleet.build(SERVICES):.0f} s"))
    try:
        fleet.up(SERVICES)
        yield fleet
    finally:
        left = fleet.down()
        rows += [("taken away", left)] if left else []


def _missing() -> str:
    """Why there can be no containers here, or nothing."""
    if shutil.which("docker") is None:
        return "docker is not installed; 'make test-fleet' installs it"
    answer = run("docker", "info", check=False)
    if answer.returncode:
        return f"no container engine answers: {answer.stderr.strip()[-200:]}"
    base = os.environ.get("SAFEDPA_BASE_IMAGE", _BASE)
    if run("docker", "image", "inspect", base, check=False).returncode:
        return f"the base image {base} is not here; pull it, or make one by deploy/base-image.sh"
    return ""


@pytest.fixture(scope="session")
def watch(fleet: Fleet) -> Iterator[Watch]:
    """What is seen on the fleet's bus."""
    watch = fleet.watch()
    yield watch
    watch.close()
