"""Runs the tests that a change touches, nearest first, within half a minute: ``make quick``.

    python tests/tools/quick.py [--since REVISION] [--seconds 30]

The change is what differs from the last commit; where nothing does, the last commit itself. Tests that start
processes, slow and long tests are left to ``make test`` and ``make test-long``; so is what the time does not suffice
for, and the summary says how much that was.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import pytest
from nearest import Nearest

ROOT = Path(__file__).resolve().parents[2]
MOST_FILES = 40
"""Collecting a file takes about 0.05 s: two seconds at most."""
LAST_TEST_SECONDS = 3.0
"""The last test begins so long before the end."""


class Budget:
    """Skips the tests that would begin after the time is over, before their fixtures are made."""

    def __init__(self, seconds: float) -> None:
        self._end = time.monotonic() + seconds

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        """Skips the test if the time is over."""
        if time.monotonic() > self._end:
            pytest.skip("the time is over; make test runs it")


def changed(root: Path, since: str) -> list[str]:
    """Files that differ from a revision; empty ``since``: from the last commit, or those of the last commit."""
    files = listed(root, "diff", "--name-only", since or "HEAD") + listed(
        root, "ls-files", "--others", "--exclude-standard"
    )
    return files or listed(root, "diff", "--name-only", "HEAD~1", "HEAD")


def listed(root: Path, *phrase: str) -> list[str]:
    """Lines that git prints."""
    return subprocess.run(["git", *phrase], cwd=root, capture_output=True, text=True, check=True).stdout.splitlines()


def main() -> int:
    """Chooses the tests and runs them. Exit code: pytest's; 0 where no test comes to the change."""
    began = time.monotonic()
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--since", default="", metavar="REVISION", help="compare with it instead of the last commit")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long all of it may take")
    given = parser.parse_args()
    files = changed(ROOT, given.since)
    tests = Nearest(ROOT).tests(files)
    chosen = list(tests)[:MOST_FILES]
    print(
        f"{len(files)} changed files, {len(tests)} test files come to them, the nearest {len(chosen)} run", flush=True
    )
    if not chosen:
        return 0
    left = given.seconds - LAST_TEST_SECONDS - (time.monotonic() - began)
    phrase = ["-q", "-m", "not long and not slow and not processes", "--no-header", *chosen]
    code = pytest.main(phrase, plugins=[Budget(left)])
    return 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else int(code)


if __name__ == "__main__":
    sys.exit(main())
