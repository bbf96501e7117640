"""Tests the library on every supported Python that is found here: ``python deploy/python_versions.py``.

Makes an empty environment for each version other than the one that runs this, installs this working tree with what
``filter-only.txt`` and the tests need, and runs quick tests of the library. A version that is not found is reported as
a skipped test. Exit code 1 if a test fails.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = ("3.11", "3.12", "3.13")
NEEDED = ("click", "hypothesis", "mcap", "msgpack", "pytest", "zstandard")
"""What the tests import next to the packages of ``filter-only.txt``."""
TESTS = (
    "tests/safety/test_filter_conditions.py",
    "tests/safety/test_filter_inputs.py",
    "tests/safety/test_filter_recorded.py",
    "tests/safety/test_filter_session.py",
    "tests/safety/test_filter_settings.py",
    "tests/safety/test_filter_verdicts.py",
    "tests/safety/test_stacks_of_functions.py",
    "tests/records/test_quality.py",
    "tests/records/test_values.py",
    "tests/dynamics/test_model_file.py",
    "tests/diagnosis/test_instead.py",
    "tests/diagnosis/test_rollout.py",
)
"""Tests of the filter, of reading logs and of the diagnosis, which need no simulator and a few seconds."""


def interpreters(versions: Iterable[str] = VERSIONS) -> dict[str, str]:
    """Returns the interpreter of each version that starts here, including those of pyenv that are not selected."""
    found = {}
    for version in versions:
        homes = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv").glob(f"versions/{version}.*/bin/python")
        for candidate in (shutil.which(f"python{version}"), *sorted(map(str, homes), reverse=True)):
            if candidate and _version_of(candidate) == version:
                found[version] = candidate
                break
    return found


def _version_of(interpreter: str) -> str:
    asked = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"
    done = subprocess.run([interpreter, "-c", asked], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def tested(version: str, interpreter: str, folder: Path) -> tuple[bool, str]:
    """Installs the library into an environment of this version; returns whether the tests passed, and the report."""
    python = folder / version / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
    pinned = ["--constraint", str(ROOT / "constraints.txt")]
    steps = [
        [interpreter, "-m", "venv", str(folder / version)],
        [*pip, *pinned, *NEEDED],
        [*pip, *pinned, "--no-deps", "--requirement", str(ROOT / "deploy" / "filter-only.txt"), str(ROOT)],
        [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not long", *TESTS],
    ]
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    plain |= {"SAFEDPA_COMPILE": "0", "PYTHONDONTWRITEBYTECODE": "1"}
    for step in steps:
        done = subprocess.run(step, capture_output=True, text=True, check=False, cwd=ROOT, env=plain)
        if done.returncode != 0:
            return False, f"{done.stdout[-4000:]}\n{done.stderr[-2000:]}".strip()
    return True, done.stdout.strip().splitlines()[-1]


def main() -> int:
    """Tests the versions at the same time; returns the exit code."""
    own = f"{sys.version_info[0]}.{sys.version_info[1]}"
    found = interpreters(version for version in VERSIONS if version != own)
    with tempfile.TemporaryDirectory(prefix="safedpa-python-") as name, ThreadPoolExecutor() as pool:
        results = dict(zip(found, pool.map(lambda item: tested(*item, Path(name)), found.items()), strict=True))
    for version, (passed, text) in results.items():
        sys.stdout.write(f"python {version}: {text}\n")
        if not passed and re.search(r"No matching distribution|Could not fetch|Connection", text):
            sys.stdout.write("SKIPPED [1] versions: no package index answers\n")
            return 0
    for version in VERSIONS:
        if version not in found and version != own:
            sys.stdout.write(f"SKIPPED [1] versions: Python {version} is not installed\n")
    return 0 if all(passed for passed, _ in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
