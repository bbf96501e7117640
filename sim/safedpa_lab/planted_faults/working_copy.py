"""A copy of the working tree, in which one file at a time is faulty, and the tests that reach the fault.

A file of tests runs first without the fault, and with a call at its place: that reports which of its tests come there,
which of them fail anyway, and how long each takes. Those that come there and pass then run with the fault, the quick
ones first. What takes several times as long as it took before does not end: that is noticed too. So each fault has a
verdict, whatever the time: of tests for which it did not suffice none is a witness.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from safedpa_lab.planted_faults.fault_classes import Fault
from safedpa_lab.planted_faults.reached import CALL

NEAR = 12
"""Files of tests for each fault; more where none of these reaches it."""
_NEAREST, _SHARE = 3, 0.5
"""Files whose slow tests run before farther ones; each file's slow tests take this share of what is left at most."""
_LONGER, _ROOM_SECONDS = 5.0, 60.0
"""A run with a fault may take so many times as long as one without, and so much more, while others use the machine."""


@dataclass(frozen=True)
class Outcome:
    """Whether a fault was noticed.

    :param result: ``noticed``; ``unnoticed`` by tests that reach it; ``unreached`` by any that ran.
    :param by: the test that noticed.
    :param files: of tests that ran without the fault, to the end or until the time was over.
    :param reaching: how many tests came to the place and passed without the fault.
    :param unsound: tests that fail without the fault as well.
    """

    result: str = "unreached"
    by: str = ""
    files: int = 0
    reaching: int = 0
    unsound: tuple[str, ...] = ()


@dataclass(frozen=True)
class Run:
    """What tests did: each with its s, those that failed, those that came to the place, which one was not ended."""

    seconds: dict[str, float]
    failed: tuple[str, ...]
    reached: frozenset[str]
    begun: str
    ended: bool
    wall: float

    def witnesses(self) -> list[str]:
        """Tests that came to the place and passed, quick ones first.

        Where modules are imported, fixtures are prepared or a process without a name runs, all of them may have come.
        """
        passed = [name for name in self.seconds if name not in self.failed]
        if not all(name.endswith(" (call)") for name in self.reached):
            return sorted(passed, key=self.seconds.__getitem__)
        came = {name.removesuffix(" (call)") for name in self.reached}
        return sorted(came & set(passed), key=self.seconds.__getitem__)


class Copy:
    """Of the working tree.

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
        self._alongside = folder / "shared"
        shutil.copyfile(Path(__file__).with_name("reached.py"), self._alongside / "reached.py")

    def tried(self, fault: Fault, files: Sequence[str], seconds: float) -> Outcome:
        """Whether a test notices.

        :param files: of tests, nearest first.
        :param seconds: until no other file is begun; what is begun without the fault ends then too.
        """
        source = (self.root / fault.path).read_text(encoding="utf-8")
        probe, found = probed(fault, source), Outcome()
        end = time.monotonic() + seconds
        for chosen, number, file in _turns(files):
            room = end - time.monotonic()
            if room <= 0.0 or (number >= NEAR and found.reaching):
                break
            sound = self._run(fault.path, probe, source, [file], chosen, _SHARE * room if chosen == "slow" else room)
            witnesses = sound.witnesses()
            found = replace(
                found,
                result="unnoticed" if found.reaching or witnesses else "unreached",
                files=found.files + (chosen == "not slow"),
                reaching=found.reaching + len(witnesses),
                unsound=(*found.unsound, *sound.failed),
            )
            by = self._noticing(fault, source, witnesses, sound)
            if by:
                return replace(found, result="noticed", by=by)
        return found

    def _noticing(self, fault: Fault, source: str, witnesses: list[str], sound: Run) -> str:
        """The first of these tests that fails with the fault and passes alone without it; empty where none does."""
        left, planted = list(witnesses), fault.planted(source)
        while left:
            patience = _ROOM_SECONDS + _LONGER * sound.wall
            run = self._run(fault.path, planted, source, left, "", patience, first_only=True)
            begins = bool(run.seconds or run.failed)  # else what is imported before all tests fails
            suspect = run.failed[0] if run.failed else "" if run.ended and begins else run.begun or left[0]
            if not suspect:
                return ""
            alone = [suspect] if suspect in left else left[:1]
            again = self._run(fault.path, source, source, alone, "", patience)
            if again.ended and not again.failed:
                return suspect if run.failed else f"{suspect} (does not {'begin' if run.ended else 'end'})"
            left = left[left.index(alone[0]) + 1 :]
        return ""

    def _run(
        self, path: str, text: str, source: str, tests: Sequence[str], chosen: str, seconds: float, *,
        first_only: bool = False,
    ) -> Run:  # fmt: skip
        """Runs tests while the file is as ``text`` says; afterwards it is as the source again."""
        record, began = self._alongside / "reached.jsonl", time.monotonic()
        record.unlink(missing_ok=True)
        (self.root / path).write_text(text, encoding="utf-8")
        try:
            ended = self._ended([*(["-m", chosen] if chosen else []), *(["-x"] if first_only else []), *tests], seconds)
        finally:
            (self.root / path).write_text(source, encoding="utf-8")
        return _reported(record, ended, time.monotonic() - began)

    def _ended(self, phrase: Sequence[str], seconds: float) -> bool:
        """Whether pytest came to its end in time."""
        paths = [str(self.root / folder) for folder in ("shared", "services", "sim")]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}
        own = ["-q", "--tb=no", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "reached"]
        with tempfile.TemporaryDirectory(prefix="p-", ignore_cleanup_errors=True) as folder:
            environment["TMPDIR"] = folder
            with subprocess.Popen(
                [sys.executable, "-m", "pytest", *own, f"--basetemp={folder}/pytest", *phrase],
                cwd=self.root,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            ) as running:
                try:
                    running.wait(seconds)
                except subprocess.TimeoutExpired:
                    os.killpg(running.pid, signal.SIGKILL)
                    return False
        return True


def _turns(files: Sequence[str]) -> Iterator[tuple[str, int, str]]:
    """Which tests of which file run, nearest first; of the very nearest the slow ones before those of farther files."""
    numbered = list(enumerate(files))
    for group in (numbered[:_NEAREST], numbered[_NEAREST:NEAR], numbered[NEAR:]):
        for chosen in ("not slow", "slow"):
            yield from ((chosen, number, file) for number, file in group)


def _reported(record: Path, ended: bool, wall: float) -> Run:
    """What a run wrote. A test has run where it was taken down; its s are those of all its parts."""
    lines = record.read_text(encoding="utf-8").splitlines() if record.exists() else []
    rows = [json.loads(line) for line in lines if line.endswith("}")]
    parts, done, failed = dict[str, float](), set[str](), dict[str, None]()
    for row in rows:
        if "ran" in row:
            parts[row["ran"]] = parts.get(row["ran"], 0.0) + row["seconds"]
            done |= {row["ran"]} if row["when"] == "teardown" else set()
            failed |= {row["ran"]: None} if row["failed"] else {}
    begun = [row["begun"] for row in rows if "begun" in row and row["begun"] not in done]
    reached = frozenset(row["reached"] for row in rows if "reached" in row)
    seconds = {name: parts[name] for name in parts if name in done}
    return Run(seconds, tuple(failed), reached, begun[-1] if begun else "", ended, wall)


def probed(fault: Fault, source: str) -> str:
    """The file with a call at the place of the fault; a module's number calls wherever a function of it is reading."""
    constant = re.match(r"(\w+)(?:: [^=]+)? = ", fault.before) if not fault.function else None
    if constant:
        spots = list(_read_in_functions(source, constant[1]))
        if spots:
            text = _replaced(source, [(first, end, f"({CALL} and {constant[1]})") for first, end in spots])
            if _is_python(text):
                return text
    condition = re.match(r"(?:el)?if ", fault.before)
    name, _, value = fault.before.partition("=")
    forms = [
        f"{fault.before[: condition.end()]}not {CALL} or {fault.before[condition.end() :]}" if condition else "",
        f"({CALL} and ({fault.before}))",
        f"{CALL}; {fault.before}",
        f"{name}=({CALL} and ({value}))",  # an argument with its name
    ]
    for form in filter(None, forms):
        text = _replaced(source, [(fault.first, fault.end, form)])
        if _is_python(text):
            return text
    return f"{source}\n{CALL}\n"


def _read_in_functions(source: str, name: str) -> Iterator[tuple[int, int]]:
    """Bytes at which a module's functions read one of its names."""
    letters, starts = source.encode(), [0]
    for line in letters.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    spots = set[tuple[int, int]]()
    for node in (part for function in functions for statement in function.body for part in ast.walk(statement)):
        if isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Load):
            first = starts[node.lineno - 1] + node.col_offset
            end = first + len(name.encode())
            if letters[first:end] == name.encode():  # before Python 3.12 not so within formatted texts
                spots.add((first, end))
    yield from sorted(spots)


def _replaced(source: str, spots: Iterable[tuple[int, int, str]]) -> str:
    letters = source.encode()
    for first, end, text in sorted(spots, reverse=True):
        letters = letters[:first] + text.encode() + letters[end:]
    return letters.decode()


def _is_python(text: str) -> bool:
    try:
        ast.parse(text)
    except SyntaxError:
        return False
    return True
