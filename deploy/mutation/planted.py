"""Plants faults that developers make at random places of their classes, and asks whether the near tests notice.

    python deploy/mutation/planted.py --seed S [--faults 50] [--seconds 120] [--again]

``run.py`` plants every small fault in the filter's modules; this one draws from classes (``fault_classes.py``: a sign
of an error, a margin, held-out rows, units, a link's certificate, what is durable, ...) over all that they name. Each
is planted in a copy of the working tree, where the nearest tests (``near.py``) run until one fails. A test that fails
on the copy without the fault as well is no witness and left out. Writes ``planted.json`` (place, difference, who
noticed) and ``planted.md`` beside this file, after each fault: a run that is cut keeps what it did, and goes on there.
With ``--again`` what was not noticed is tried again, after tests were added; what was so at first stays in the record.
Exit code 1: some fault is noticed by nobody.
"""

from __future__ import annotations

import argparse
import datetime
import difflib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path[:0] = [str(HERE)]

from fault_classes import CLASSES, Fault, faults_in  # noqa: E402 - found beside this file
from near import Nearness  # noqa: E402

NEAR = 12
"""Files of tests for each fault."""
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+?\.py(?:::[^\s].*?)?)(?: - .*)?$", re.MULTILINE)


def drawn(root: Path, seed: int, count: int) -> list[Fault]:
    """So many faults, from one class after the other, each at a place that chance chooses; the same for a seed."""
    chance = random.Random(seed)
    left = {kind.name: faults_in(root, kind) for kind in CLASSES}
    for found in left.values():
        chance.shuffle(found)
    names, chosen = list(left), list[Fault]()
    chance.shuffle(names)
    while len(chosen) < count and any(left.values()):
        for name in names:
            if left[name] and len(chosen) < count:
                chosen.append(left[name].pop())
    return chosen


def difference(fault: Fault, source: str) -> str:
    """Between the file and the one with the fault, as patches are written."""
    lines, planted = source.splitlines(), fault.planted(source).splitlines()
    return "\n".join(difflib.unified_diff(lines, planted, fault.path, fault.path, lineterm="", n=1))


@dataclass(frozen=True)
class Outcome:
    """Whether a fault was noticed.

    :param result: ``noticed``, ``unnoticed``, or ``cut`` where the time was over before all tests had run.
    :param by: the test that noticed.
    :param unsound: tests that fail without the fault as well.
    """

    result: str
    by: str = ""
    unsound: tuple[str, ...] = ()


class Copy:
    """A copy of the working tree, in which one file at a time is faulty.

    :param root: of the working tree.
    :param folder: for the copy.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        self.root = folder
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
            cwd=root,
            capture_output=True,
            check=True,
        )
        for name in listed.stdout.decode().split("\0"):
            if name and (root / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(root / name, folder / name)

    def tried(self, fault: Fault, tests: list[str], seconds: float) -> Outcome:
        """Whether one of the files of tests notices, those without the mark ``slow`` first."""
        if not tests:  # pytest would take the whole suite
            return Outcome("unnoticed")
        path, end, unsound = self.root / fault.path, time.monotonic() + seconds, list[str]()
        source = path.read_text(encoding="utf-8")
        for chosen in ("not slow", "slow"):
            while True:
                path.write_text(fault.planted(source), encoding="utf-8")
                try:
                    failed = self._first_failure(tests, chosen, unsound, end - time.monotonic())
                finally:
                    path.write_text(source, encoding="utf-8")
                if not failed:
                    break
                if failed == "cut":
                    return Outcome("cut", unsound=tuple(unsound))
                if not self._first_failure([failed], "", [], max(seconds, 60.0)):
                    return Outcome("noticed", failed, tuple(unsound))
                unsound.append(failed)
        return Outcome("unnoticed", unsound=tuple(unsound))

    def _first_failure(self, tests: list[str], chosen: str, without: list[str], seconds: float) -> str:
        """The first test that fails; empty where none does, ``cut`` where the time does not suffice."""
        if seconds <= 0.0:
            return "cut"
        paths = [str(self.root / folder) for folder in ("shared", "services", "sim")]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}
        words = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "--tb=no",
            "-rfE",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
        ]
        words += [*(["-m", chosen] if chosen else []), *[f"--deselect={name}" for name in without], *tests]
        with tempfile.TemporaryDirectory(prefix="p-") as folder:
            environment["TMPDIR"] = folder
            with subprocess.Popen(
                [*words, f"--basetemp={folder}/pytest"],
                cwd=self.root,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            ) as running:
                try:
                    told, _ = running.communicate(timeout=seconds)
                except subprocess.TimeoutExpired:
                    os.killpg(running.pid, signal.SIGKILL)
                    running.communicate()
                    return "cut"
        if running.returncode in (0, 5):  # none failed; none was chosen
            return ""
        named = _FAILED.search(told)
        return named[1].strip() if named else tests[0]


def main(arguments: list[str]) -> int:
    """Plants, and keeps what came out."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--faults", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=120.0, help="for the tests of one fault")
    parser.add_argument("--again", action="store_true", help="what was not noticed, on the tests as they are now")
    given = parser.parse_args(arguments)
    os.nice(10)
    record = read(HERE / "planted.json", given.seed)
    nearness = Nearness(ROOT)
    with tempfile.TemporaryDirectory(prefix="planted-") as folder:
        copy = Copy(ROOT, Path(folder))
        for row in planned(record, given):
            fault = Fault(**row["fault"])
            source = (ROOT / fault.path).read_text(encoding="utf-8")
            if row["difference"] != difference(fault, source):
                sys.stderr.write(f"{fault.path}: the file has changed since; a new seed draws new faults\n")
                continue
            tests = nearness.files(fault.path, fault.function, NEAR)
            outcome = copy.tried(fault, tests, given.seconds)
            came = {"result": outcome.result, "by": outcome.by, "unsound": outcome.unsound, "commit": commit()}
            row.setdefault("first", came)
            row |= {"now": came, "tests": tests}
            write(HERE, record)
            sys.stderr.write(f"{outcome.result:9} {fault.kind}: {fault.path}:{fault.line} {outcome.by}\n")
    return 1 if any(row.get("now", {}).get("result") != "noticed" for row in record["faults"]) else 0


def planned(record: dict[str, Any], given: argparse.Namespace) -> list[dict[str, Any]]:
    """The faults that are still to be tried, put into the record where they are not there."""
    if given.again:
        return [row for row in record["faults"] if row.get("now", {}).get("result") != "noticed"]
    known = {row["difference"] for row in record["faults"]}
    for fault in drawn(ROOT, given.seed, given.faults):
        changed = difference(fault, (ROOT / fault.path).read_text(encoding="utf-8"))
        if changed not in known:
            record["faults"].append({"fault": vars(fault), "difference": changed})
    return [row for row in record["faults"] if "now" not in row]


def read(path: Path, seed: int) -> dict[str, Any]:
    """The record of a seed; an empty one where another seed's is there."""
    if path.exists():
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if record["seed"] == seed:
            return record
    return {"seed": seed, "date": datetime.date.today().isoformat(), "commit": commit(), "faults": []}


def commit() -> str:
    """Of the working tree, short."""
    words = ["git", "rev-parse", "--short=9", "HEAD"]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def write(folder: Path, record: dict[str, Any]) -> None:
    """``planted.json`` and ``planted.md``."""
    (folder / "planted.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    (folder / "planted.md").write_text(page(record), encoding="utf-8")


def page(record: dict[str, Any]) -> str:
    """The record for people: counts, then each fault with its place and who noticed."""
    rows = [row for row in record["faults"] if "now" in row]
    first, now = (Counter(row[when]["result"] for row in rows) for when in ("first", "now"))
    lines = [
        "# Planted faults",
        "",
        f"`python deploy/mutation/planted.py --seed {record['seed']}`, {record['date']}, commit {record['commit']}: of "
        f"{len(rows)} faults that were tried, the {NEAR} nearest files of tests noticed {first['noticed']} at first "
        f"and {now['noticed']} now. {now['unnoticed']} nobody notices; for {now['cut']} the time was over before all "
        "of these tests had run. Farther tests were not asked: more may be noticed than stands here. What is noticed "
        "now and was not at first owes it to tests written for it, after it was seen, or to another choice of the "
        "near tests; only the count at first says how much the tests notice.",
        "",
        "| class | place | before | after | at first | now |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        fault = row["fault"]
        before, after = (_cell(fault[name]) for name in ("before", "after"))
        told = f"`{row['now']['by']}`" if row["now"]["by"] else row["now"]["result"]
        place = f"{fault['path']}:{fault['line']} {fault['function']}"
        lines.append(f"| {fault['kind']} | {place} | {before} | {after} | {row['first']['result']} | {told} |")
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Code in one cell of a table."""
    short = " ".join(text.split())
    return "`" + (short if len(short) <= 80 else short[:77] + "...").replace("|", "\\|") + "`"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
