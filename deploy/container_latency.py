"""Sense to act of the loop in containers, next to a bare chain of as many containers before and after it.

    docker-compose build router adaptation policy safety_filter robot recorder diagnosis authority
    python deploy/container_latency.py --rate 20 --seconds 600

Both on the bus without certificates (``docker-compose.plain.yml``), through the router, with the limits that the
compose file sets and without real-time scheduling, which engines do not give. The chain hands 600 bytes through three
containers; recorder and diagnosis run alongside the loop. Prints one JSON document; the containers are taken away
again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PROJECT = "safedpa-latency"
SERVICES = ("adaptation", "policy", "safety_filter", "recorder", "diagnosis")
_HOPS = ("state", "latent", "nominal", "action")
_LONGEST_CHAIN_SECONDS = 120.0
"""Half before the loop and half after it."""
_START_SECONDS, _STOP_SECONDS = 5.0, 10


def measured(seconds: float, rate: float) -> dict[str, Any]:
    """Microseconds from sense to act of both. Raises RuntimeError with what an engine or a container said.

    Raises ValueError for times and rates that are none.
    """
    if not (0.0 < rate <= 1000.0 and 1.0 <= seconds * rate < 1e9):
        raise ValueError(f"got {seconds:g} s at {rate:g} Hz, wanted one tick at least, and at most 1000 a second")
    half = 0.5 * min(seconds, _LONGEST_CHAIN_SECONDS)
    with _project(rate) as compose:
        _run(*compose, "up", "-d", "--no-build", "router")
        image = _run("docker", "inspect", "--format", "{{.Config.Image}}", _container(compose, "router"))
        before = _chain(image, half, rate)
        _run(*compose, "up", "-d", "--no-build", *SERVICES)
        time.sleep(_START_SECONDS)  # who is not there yet is late, which reports nothing
        _run(*compose, "up", "-d", "--no-build", "robot")
        time.sleep(seconds)
        _run(*compose, "stop", "--timeout", str(_STOP_SECONDS), "robot")
        loop = account_in(_run("docker", "logs", _container(compose, "robot")).splitlines())
        _run(*compose, "stop", "--timeout", "3", *SERVICES)
        after = _chain(image, half, rate)
    return {
        "rate_hz": rate,
        "seconds": seconds,
        "loop_us": loop["latency_us"],
        **{name: loop[name] for name in ("ticks", "watchdog_ticks", "collisions")},
        "bare_chain_us": [before, after],
        "ratio_p99": round(loop["latency_us"]["p99"] / max(before["p99"], after["p99"]), 2),
        "load_average": os.getloadavg(),
    }


def account_in(lines: Sequence[str]) -> dict[str, Any]:
    """The account that a robot gives when it ends, of its log. Raises RuntimeError where it gave none."""
    for line in reversed(lines):
        try:
            found = json.loads(line)
        except ValueError:
            continue
        if isinstance(found, dict) and "latency_us" in found:
            if None in found["latency_us"].values():
                raise RuntimeError(f"no action reached the robot in {found['ticks']} ticks")
            return found
    raise RuntimeError(f"the robot gave no account of its drive; its last words: {' '.join(lines[-2:])}")


@contextmanager
def _project(rate: float) -> Iterator[list[str]]:
    os.environ |= {"SAFEDPA_RATE": f"{rate:g}", "SAFEDPA_LOAD": "box"}
    plugin = subprocess.run(("docker", "compose", "version"), capture_output=True, check=False).returncode == 0
    program = ["docker", "compose"] if plugin else ["docker-compose"]
    files = ("docker-compose.yml", "docker-compose.plain.yml")
    compose = [*program, "--project-name", PROJECT, *[word for file in files for word in ("-f", str(ROOT / file))]]
    down = (*compose, "down", "--volumes", "--remove-orphans", "--timeout", "3")
    try:
        yield compose
    except BaseException:
        subprocess.run(down, cwd=ROOT, capture_output=True, check=False)  # what went wrong before counts
        raise
    _run(*down)


def _chain(image: str, seconds: float, rate: float) -> dict[str, float]:
    relay = ("docker", "run", "--detach", *_guest(image), "relay")
    links = [_run(*relay, f"bare/{source}", f"bare/{target}") for source, target in pairwise(_HOPS)]
    try:
        ends = ("send", f"bare/{_HOPS[0]}", f"bare/{_HOPS[-1]}", f"{seconds:g}", f"{rate:g}")
        found: dict[str, float] = json.loads(_run("docker", "run", "--rm", *_guest(image), *ends).splitlines()[-1])
        return found
    finally:
        _run("docker", "rm", "--force", *links)


def _guest(image: str) -> list[str]:
    """As the compose file has its containers."""
    script = ("--volume", f"{ROOT / 'deploy' / 'container_chain.py'}:/chain.py:ro")
    limits = ("--cpus", "1.0", "--cpu-shares", "4096", "--memory", "192m", "--cap-drop", "ALL", "--init")
    return [*limits, "--network", f"{PROJECT}_bus", *script, "--entrypoint", "python", image, "/chain.py"]


def _container(compose: Sequence[str], service: str) -> str:
    return _run(*compose, "ps", "-q", service).splitlines()[0]


def _run(*phrase: str) -> str:
    done = subprocess.run(phrase, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        notice = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        raise RuntimeError(f"{' '.join(phrase[:2])} ...: {notice[-1]}")
    return done.stdout.strip()


def main() -> None:
    """Prints what was measured."""
    parser = argparse.ArgumentParser(prog="container_latency", description="sense to act of the loop in containers")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=float, default=20.0, help="ticks a second")
    options = parser.parse_args()
    try:
        found = measured(options.seconds, options.rate)
    except (RuntimeError, ValueError, OSError) as error:
        parser.exit(1, f"container_latency: {error}\n")
    sys.stdout.write(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
