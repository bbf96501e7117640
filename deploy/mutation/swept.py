"""Plants every fault of whole classes, not a draw of them, and asks the nearest tests, in one process for each file.

    python deploy/mutation/swept.py [--paths GLOB ...] [--kinds WORD ...] [--part K/N] [--report]

``planted.py`` draws fifty faults and gives each whatever time it needs; this one goes through all places of the classes
(``fault_classes.py``), so that each has been looked at. For that the nearest files of tests are collected once and
traced, and each fault is judged in a fork of that process by the tests that run its statement (``trial.py``). So what
only another process does is *open* here, though tests that start one may notice: ``planted.py`` says. What came out is
kept in ``build/mutation/swept`` while module and tests are the same. With ``--report`` nothing runs: the counts by
class, and each fault that is open, go to the terminal.
"""

from __future__ import annotations

import argparse
import ast
import datetime
import fnmatch
import os
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path[:0] = [str(HERE), *(str(ROOT / folder) for folder in ("shared", "services", "sim"))]

from fault_classes import CLASSES, Fault, faults_in  # noqa: E402 - found beside this file
from kept import KILLED, LATER, Kept  # noqa: E402
from mutants import Mutant, home_of  # noqa: E402
from near import Nearness  # noqa: E402
from run import commit, import_what_is_not_mutated  # noqa: E402
from trial import Judge, Trial, in_fork, run_pytest, traced_from_here  # noqa: E402

FILES = 6
"""Of tests for each module, the nearest."""
SOUND_SECONDS = 25
"""The sound tests of a module may take so long together; what has not run by then judges nothing."""

Named = dict[str, list[Fault]]


class Sweep(Judge):
    """Judges by the tests that pass soundly and in time, whatever the others do."""

    def pytest_runtestloop(self, session: Any) -> bool:
        """Instead of running the tests once."""
        sys.settrace(None)
        self.sound = self._traced_once(session.items, SOUND_SECONDS)
        items = [item for item in session.items if item.nodeid in self._took]
        known, self._before = self._trial.kept.valid(), self._trial.kept.all()
        for mutant in self._trial.mutants:
            if mutant.name not in known:
                outcome, by = self._outcome(mutant, items, frozenset(self._at_import))
                self._trial.kept.keep(mutant.name, outcome, by)
        return True


def faults_by_file(kinds: Sequence[str], paths: Sequence[str]) -> dict[str, Named]:
    """The faults of each file, by their names; one that stands in several classes is there with each."""
    found: dict[str, Named] = defaultdict(lambda: defaultdict(list))
    for kind in CLASSES:
        if kinds and not any(word in kind.name for word in kinds):
            continue
        for fault in faults_in(ROOT, kind):
            if not paths or any(fnmatch.fnmatch(fault.path, glob) for glob in paths):
                found[fault.path][name_of(fault)].append(fault)
    return found


def likely_first(found: dict[str, Named]) -> list[str]:
    """The files, first those into which a draw of ``planted.py`` falls most often: it takes all classes in turn."""
    sizes = Counter(fault.kind for named in found.values() for faults in named.values() for fault in faults)
    share = {
        path: sum(1.0 / sizes[fault.kind] for faults in named.values() for fault in faults)
        for path, named in found.items()
    }
    return sorted(found, key=lambda path: (-share[path], path))


def name_of(fault: Fault) -> str:
    """In words that do not depend on line numbers; alike where the same text of one function stands twice."""
    before, after = (" ".join(text.split()) for text in (fault.before, fault.after))
    return f"{fault.function}: {before}  ->  {after}"


def mutants_of(source: str, named: Named) -> Iterator[Mutant]:
    """What the faults become for the judge."""
    tree = ast.parse(source)
    for name, faults in named.items():
        for number, fault in enumerate({(one.first, one.end): one for one in faults}.values()):
            text = fault.planted(source)
            yield Mutant(numbered(name, number), fault.line, text, *home_of(tree, source, fault.first, fault.end))


def numbered(name: str, number: int) -> str:
    """The second and later places of one name."""
    return f"{name} ({number + 1})" if number else name


def trial_of(path: str, named: Named, nearness: Nearness) -> Trial:
    """The module's faults, the nearest tests, and what is known of them."""
    source = (ROOT / path).read_text(encoding="utf-8")
    functions = ".".join(sorted({fault.function for faults in named.values() for fault in faults}))
    files = [ROOT / name for name in nearness.files(path, functions, FILES)]
    arguments = (f"--rootdir={ROOT}", "-m", "not slow", *map(str, files))
    kept = ROOT / "build" / "mutation" / "swept" / f"{path.replace('/', '.')}.jsonl"
    module = ".".join(Path(path).with_suffix("").parts[1:]).removesuffix(".__init__")
    outcomes = Kept(kept, ROOT, source, files, datetime.date.today().isoformat(), commit())
    return Trial(module, ROOT / path, list(mutants_of(source, named)), arguments, outcomes)


def swept(trial: Trial) -> None:
    """Judges what is not known of one module."""
    trial.kept.path.parent.mkdir(parents=True, exist_ok=True)
    known = trial.kept.valid()
    if any(mutant.name not in known for mutant in trial.mutants):
        in_fork(lambda: _collected(trial), trial.kept.path.with_suffix(".log"))


def _collected(trial: Trial) -> int:
    judge = Sweep(trial, traced_from_here(trial).lines)
    return run_pytest(trial.arguments, judge)


def main(arguments: list[str]) -> int:
    """Sweeps, and tells what is open."""
    parser = argparse.ArgumentParser(prog="swept.py", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--paths", nargs="*", default=[], metavar="GLOB", help="files from the root; default: all")
    parser.add_argument("--kinds", nargs="*", default=[], metavar="WORD", help="classes with such a word; default: all")
    parser.add_argument("--part", default="1/1", metavar="K/N", help="every N-th file, from the K-th on")
    parser.add_argument("--report", action="store_true", help="run nothing: what is kept")
    given = parser.parse_args(arguments)
    os.nice(10)
    os.chdir(ROOT)
    part, _, parts = given.part.partition("/")
    if not (part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)):
        parser.error(f"--part: got {given.part}, wanted K/N with K from 1 to N")
    nearness, found = Nearness(ROOT), faults_by_file(given.kinds, given.paths)
    if not found:
        parser.error("got no place where such a fault could stand; wanted other --paths or --kinds")
    if not given.report:
        import_what_is_not_mutated()
    counts, opened = defaultdict[str, Counter[str]](Counter), list[str]()
    for path in likely_first(found)[int(part) - 1 :: int(parts)]:
        trial, began = trial_of(path, found[path], nearness), time.monotonic()
        if not given.report:
            swept(trial)
        seen, left = told(trial, found[path])
        opened += [f"{path}:{line}" for line in left]
        for kind, result in seen:
            counts[kind][result] += 1
        total, noticed = len(seen), sum(result == KILLED for _, result in seen)
        sys.stderr.write(f"{path}: {noticed} of {total}, {time.monotonic() - began:.0f} s\n")
    sys.stdout.write("\n".join([*table(counts), "", *opened]) + "\n")
    return 1 if opened else 0


def told(trial: Trial, named: Named) -> tuple[list[tuple[str, str]], list[str]]:
    """Class and outcome of each fault; a line for each that is not noticed."""
    known, seen, left = trial.kept.valid(), list[tuple[str, str]](), list[str]()
    for name, faults in named.items():
        places = list({(one.first, one.end): one for one in faults}.values())
        for number, fault in enumerate(places):
            entry = known.get(numbered(name, number))
            result = entry.outcome if entry else "not judged"
            kinds = sorted({one.kind for one in faults if (one.first, one.end) == (fault.first, fault.end)})
            seen += [(kind, result) for kind in kinds]
            if result != KILLED:
                left.append(f"{fault.line} [{', '.join(kinds)}] {'not in place: ' if result == LATER else ''}{name}")
    return seen, left


def table(counts: dict[str, Counter[str]]) -> list[str]:
    """Counts by class."""
    lines = ["| class | faults | noticed |", "|---|---|---|"]
    total = sum(counts.values(), Counter[str]())
    for kind, seen in [*sorted(counts.items()), ("all", total)]:
        lines.append(f"| {kind} | {seen.total()} | {seen[KILLED]} |")
    return lines


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
