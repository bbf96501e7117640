"""Plants faults that developers make at random places of their classes, and asks whether the near tests notice.

    python -m safedpa_lab.planted_faults --seed S [--faults 50] [--class NAME] [--seconds 120] [--again [--place PATH]]

``make mutation`` mutates one module. This script draws from classes of faults (``fault_classes.py``: a sign of an
error, a margin, held-out rows, units, what one module hands to another, ...) over all modules that they name. Each is
planted in a copy of the working tree, where the tests that come to its place run until one fails
(``working_copy.py``). They are looked for in the nearest files (``nearest_tests.py``). A test that fails without the
fault as well is left out. Writes ``planted-S.json`` (place, difference, who noticed) and ``planted.md`` of all seeds
into ``--out`` (default: ``build/mutation``) after each fault: a run that is cut goes on there. ``--again`` tries what
was not noticed again, new tests first; the first result stays in the record. A fault that cannot be noticed has the
reason in its row, as ``why``. Exit code 1: a fault was not noticed and has no reason.
"""

from __future__ import annotations

import argparse
import datetime
import difflib
import json
import os
import random
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safedpa_lab.planted_faults.fault_classes import CLASSES, Fault, faults_in
from safedpa_lab.planted_faults.nearest_tests import Nearness
from safedpa_lab.planted_faults.working_copy import NEAR, Copy

ROOT = Path(__file__).resolve().parents[3]

FILES, FAR = 60, 1000
"""Files of tests for each fault, those beyond the nearest only where none of these reaches it; all that there are."""


def drawn(root: Path, seed: int, count: int, kinds: Collection[str] = ()) -> list[Fault]:
    """So many faults, from one class after the other, each at a place that chance chooses; the same for a seed.

    ``kinds``: names of the classes; empty: all.
    """
    chance = random.Random(seed)
    left = {kind.name: faults_in(root, kind) for kind in CLASSES if not kinds or kind.name in kinds}
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


def main(arguments: list[str]) -> int:
    """Plants, and keeps what came out."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--faults", type=int, default=50)
    parser.add_argument("--class", dest="chosen", action="append", default=[], choices=[kind.name for kind in CLASSES])
    parser.add_argument("--seconds", type=float, default=120.0, help="to find tests that come to one fault")
    parser.add_argument("--again", action="store_true", help="what was not noticed, on the tests as they are now")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutation", help="folder of the records")
    parser.add_argument("--place", default="", metavar="PATH[:LINE]", help="only of faults at such a place")
    given = parser.parse_args(arguments)
    os.nice(10)
    given.out.mkdir(parents=True, exist_ok=True)
    record = read(given.out, given.seed)
    nearness = Nearness(ROOT)
    with tempfile.TemporaryDirectory(prefix="planted-") as folder:
        copy, changed = Copy(ROOT, Path(folder)), changed_since(ROOT, record["commit"]) if given.again else set[str]()
        for row in planned(record, given):
            fault = there_now(copy.root, row)  # the working tree may be changed meanwhile
            if fault is None:
                row["now"] = {"result": "gone", "by": "", "commit": commit()}
                sys.stderr.write(f"gone      {row['fault']['kind']}: {row['fault']['path']}\n")
                continue
            tests = new_first(nearness.files(fault.path, fault.function, FAR), changed)[:FILES]
            outcome = copy.tried(fault, tests, given.seconds)
            came = {**asdict(outcome), "commit": commit()}
            row.setdefault("first", came)
            row |= {"now": came, "tests": tests[: outcome.files]}
            write(given.out, record)
            sys.stderr.write(f"{outcome.result:9} {fault.kind}: {fault.path}:{fault.line} {outcome.by}\n")
    write(given.out, record)
    return 1 if any(map(is_open, record["faults"])) else 0


def is_open(row: dict[str, Any]) -> bool:
    """Whether no one notices the fault, and the record gives no reason (``why``) why nothing can."""
    return row.get("now", {}).get("result") not in ("noticed", "gone") and not row.get("why")


def planned(record: dict[str, Any], given: argparse.Namespace) -> list[dict[str, Any]]:
    """The faults that are still to be tried, put into the record where they are not there."""
    if given.again:
        found = [row for row in record["faults"] if row.get("now", {}).get("result") != "noticed"]
        return [row for row in found if given.place in f"{row['fault']['path']}:{row['fault']['line']}"]
    if not record["faults"]:
        for fault in drawn(ROOT, given.seed, given.faults, given.chosen):
            changed = difference(fault, (ROOT / fault.path).read_text(encoding="utf-8"))
            record["faults"].append({"fault": vars(fault), "difference": changed})
    return [row for row in record["faults"] if "now" not in row]


def there_now(root: Path, row: dict[str, Any]) -> Fault | None:
    """The fault of a row; where its file was changed since, the same change of the same function, if it is one."""
    fault, path = Fault(**row["fault"]), root / row["fault"]["path"]
    if not path.exists():
        return None
    if row["difference"] == difference(fault, path.read_text(encoding="utf-8")):
        return fault
    kind = next(kind for kind in CLASSES if kind.name == fault.kind)
    what = (fault.path, fault.function, fault.before, fault.after)
    alike = [one for one in faults_in(root, kind) if (one.path, one.function, one.before, one.after) == what]
    if len(alike) != 1:
        return None
    row |= {"fault": vars(alike[0]), "difference": difference(alike[0], path.read_text(encoding="utf-8"))}
    return alike[0]


def changed_since(root: Path, former: str) -> set[str]:
    """Files of tests that are new or other than in a commit."""
    phrase = ["git", "diff", "--name-only", former, "--", "tests"]
    done = subprocess.run(phrase, cwd=root, capture_output=True, text=True, check=False)
    return set(done.stdout.split())


def new_first(tests: list[str], changed: set[str]) -> list[str]:
    """What was written since the faults were planted is asked before the rest, each part nearest first."""
    return sorted(tests, key=lambda name: name not in changed)


def read(folder: Path, seed: int) -> dict[str, Any]:
    """The record of a seed; an empty one where there is none."""
    path = folder / f"planted-{seed}.json"
    if path.exists():
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return record
    return {"seed": seed, "date": datetime.date.today().isoformat(), "commit": commit(), "faults": []}


def commit() -> str:
    """Of the working tree, short."""
    phrase = ["git", "rev-parse", "--short=9", "HEAD"]
    return subprocess.run(phrase, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def write(folder: Path, record: dict[str, Any]) -> None:
    """The record of a seed, and ``planted.md`` of all of them."""
    (folder / f"planted-{record['seed']}.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    records = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("planted-*.json")]
    pages = [page(one) for one in sorted(records, key=lambda one: -one["seed"])]
    (folder / "planted.md").write_text("\n".join([_HEAD, *pages]), encoding="utf-8")


_HEAD = f"""# Planted faults

The files of tests run nearest first, {NEAR} of them, more where none of these comes to the fault. *unnoticed*: tests
come there and pass; *unreached*: none of those that ran does; *gone*: the place is not there any more. Farther tests
were not asked: more may be noticed than stands here. What is noticed now and was not at first owes it to tests written
for it, after it was seen, or to another choice of the near tests; only the count at first says how much the tests
notice.
"""


def page(record: dict[str, Any]) -> str:
    """The record for people: counts, then each fault with its place and who noticed."""
    rows = [row for row in record["faults"] if "now" in row]
    first, now = (Counter(row.get(when, row["now"])["result"] for row in rows) for when in ("first", "now"))
    counts = [", ".join(f"{number} {result}" for result, number in sorted(count.items())) for count in (first, now)]
    lines = [
        f"## Seed {record['seed']}",
        "",
        f"`python -m safedpa_lab.planted_faults --seed {record['seed']}`, {record['date']}, commit "
        f"{record['commit']}: of {len(rows)} faults at first {counts[0]}; now {counts[1]}.",
        "",
        "| class | place | before | after | at first | now |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        fault = row["fault"]
        before, after = (_cell(fault[name]) for name in ("before", "after"))
        reported = f"`{row['now']['by']}`" if row["now"]["by"] else row["now"]["result"]
        at_first = row.get("first", row["now"])["result"]
        place = f"{fault['path']}:{fault['line']} {fault['function']}"
        lines.append(f"| {fault['kind']} | {place} | {before} | {after} | {at_first} | {reported} |")
    explained = [f"- {row['fault']['path']}:{row['fault']['line']}: {row['why']}" for row in rows if row.get("why")]
    lines += ["", *explained] if explained else []
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Code in one cell of a table."""
    short = " ".join(text.split())
    return "`" + (short if len(short) <= 80 else short[:77] + "...").replace("|", "\\|") + "`"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
