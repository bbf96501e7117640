"""Whether the tests of one module notice the faults planted in it, without running more of them than need be.

The tests are collected once, in a process of their own. There they run once soundly and traced: which test runs which
line, and for how long. Each mutant is then judged in a fork of that process, by the tests that run its statement, those
that noticed others and the quick ones first, until one fails; its function is given the mutant's code in place. What
nobody runs survives without a trial. What these tests leave alive is judged by the module's other tests too where its
line runs while a test is prepared, since others may use what was prepared, and, where its line runs while modules are
imported or it cannot be put in place, by all of them in a process that imports the mutant instead of the module.
"""

from __future__ import annotations

import ast
import importlib.abc
import importlib.util
import json
import os
import resource
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any

from kept import KILLED, LATER, SURVIVED, Kept, Outcome
from mutants import Mutant, assigned

__all__ = ["Judge", "Trial", "in_fork", "judged", "run_pytest", "traced_from_here"]

PATIENCE, ROOM = 3.0, 3.0
"""A test that computes for so many times what it took with the sound module, and so many s, hangs: it noticed."""
SECONDS = 150
"""Of processor time; a module imported anew whose tests take more counts as killed."""
IDLE, IDLE_BESIDE_OTHERS = 20, 600
"""Seconds in a row without computing, after which a mutant counts as killed: it waits for ever; where it started other
processes, it may wait for them for longer."""
ROOM_BYTES = 4 * 2**30
"""A mutant that takes more than this beside what was there fills the memory: killed as well."""
_HANGS = 3
_NOTHING = 1e-3
"""Of a second; looking at the clock takes less."""


@dataclass(frozen=True)
class Trial:
    """One module, its mutants, the tests that judge it, and the file that keeps what came out."""

    name: str
    """Of the module, as it is imported."""
    path: Path
    mutants: Sequence[Mutant]
    arguments: tuple[str, ...]
    """Files and names of tests, as pytest takes them."""
    kept: Kept


class Planted(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from a given source in place of its file."""

    def __init__(self, name: str, source: str) -> None:
        self._name, self._source = name, source

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """The specification of the planted module, of no other."""
        return importlib.util.spec_from_loader(fullname, self) if fullname == self._name else None

    def exec_module(self, module: ModuleType) -> None:
        """Runs the planted source."""
        exec(compile(self._source, self._name, "exec", dont_inherit=True), module.__dict__)


@dataclass
class Traced:
    """Which lines of one file run."""

    file: str
    lines: set[int] = field(default_factory=set)

    def __call__(self, frame: FrameType, _event: str, _argument: object) -> Any:
        """For ``sys.settrace``."""
        return self._line if frame.f_code.co_filename == self.file else None

    def _line(self, frame: FrameType, event: str, _argument: object) -> Any:
        if event == "line":
            self.lines.add(frame.f_lineno)
        return self._line


def judged(trial: Trial) -> bool:
    """Judges what is not known in ``trial.kept`` and puts it there; False where the tests fail without any fault."""
    path = trial.kept.path
    path.parent.mkdir(parents=True, exist_ok=True)
    known = trial.kept.valid()
    if all(mutant.name in known and known[mutant.name].outcome != LATER for mutant in trial.mutants):
        return True
    if in_fork(lambda: collected(trial), path.with_suffix(".log")) != 0:
        return False
    known = trial.kept.valid()
    for mutant in trial.mutants:
        if known[mutant.name].outcome == LATER:
            first = FirstFailure(path.with_suffix(".by"))
            sound = in_fork(lambda mutant=mutant, first=first: imported_anew(trial, mutant.source, first)) == 0
            trial.kept.keep(mutant.name, SURVIVED if sound else KILLED, "" if sound else first.told())
    return True


class FirstFailure:
    """Tells another process which test failed first.

    :param path: of a file for its name.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._path.unlink(missing_ok=True)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Remembers a failure."""
        if report.failed and not self._path.exists():
            self._path.write_text(report.nodeid, encoding="utf-8")

    def told(self) -> str:
        """The name; empty where none failed, as where the tests could not be collected."""
        name = self._path.read_text(encoding="utf-8") if self._path.exists() else ""
        self._path.unlink(missing_ok=True)
        return name


def in_fork(work: Callable[[], int], output: Path | None = None) -> int:
    """What the work returns, in a process of its own that is silent; -1 where it ended otherwise, or hung."""
    child = os.fork()
    if child == 0:
        silence = os.open(output or os.devnull, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        code = -1
        try:
            code = work()
        finally:
            os._exit(code & 255)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def run_pytest(arguments: Sequence[str], plugin: object | None = None) -> int:
    """In a forked process: pytest's exit code."""
    import hypothesis
    import pytest

    # One counterexample is enough: making it small costs more than all other tests.
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    checks = [hypothesis.HealthCheck.too_slow]
    hypothesis.settings.register_profile(
        "mutation", phases=phases, derandomize=True, deadline=None, suppress_health_check=checks
    )
    os.environ["HYPOTHESIS_PROFILE"] = "mutation"
    quiet = "ignore::pytest.PytestAssertRewriteWarning"  # hypothesis was imported before pytest could rewrite it
    plain = ("-x", "-q", "--tb=no", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist", "-s")
    return int(pytest.main([*plain, "-W", quiet, *arguments], plugins=[plugin] if plugin else []))


def imported_anew(trial: Trial, source: str, first: FirstFailure) -> int:
    """In a forked process: all tests, with the source in the module's place."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_utime + SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (int(most), int(most) + 1))
    limit_memory()
    end_where_idle()
    sys.meta_path.insert(0, Planted(trial.name, source))
    return run_pytest(trial.arguments, first)


def end_where_idle() -> None:
    """From here on a process that waits for ever ends; one that was stopped by others goes on where it was."""
    idle, before = 0, time.process_time()

    def look(*_: object) -> None:
        nonlocal idle, before
        now = time.process_time()
        idle, before = (idle + 1 if now - before < _NOTHING else 0), now
        others = Path("/proc/thread-self/children").read_text(encoding="ascii")
        if idle >= (IDLE_BESIDE_OTHERS if others else IDLE):
            os._exit(_HANGS)

    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, 1.0, 1.0)


def limit_memory() -> None:
    """From here on."""
    now = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + ROOM_BYTES, now + ROOM_BYTES))


def collected(trial: Trial) -> int:
    """In a forked process: collects the tests once, and judges what can be judged there."""
    judge = Judge(trial, traced_from_here(trial).lines)
    run_pytest(trial.arguments, judge)
    return 0 if judge.sound else 1


def traced_from_here(trial: Trial) -> Traced:
    """In a forked process: which lines of the module run from now on."""
    traced = Traced(str(trial.path))
    sys.settrace(traced)
    return traced


class Judge:
    """In place of pytest's own loop over the tests."""

    def __init__(self, trial: Trial, at_import: set[int]) -> None:
        self._trial, self._at_import = trial, at_import
        self._failed = False
        self._noticed: Counter[str] = Counter()
        self._traced = Traced(str(trial.path))
        self._prepares: set[int] = set()
        self._took: dict[str, float] = {}
        self._runs: dict[str, frozenset[int]] = {}
        self._before: dict[str, Outcome] = {}
        self.sound = False

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Remembers a failure."""
        self._failed |= report.failed

    def pytest_runtest_call(self) -> None:
        """What ran until now prepared the test."""
        self._prepares |= self._traced.lines

    def pytest_runtestloop(self, session: Any) -> bool:
        """Instead of running the tests once."""
        sys.settrace(None)
        at_import = frozenset(self._at_import)
        self.sound = not session.testsfailed and bool(session.items) and self._traced_once(session.items)
        if self.sound:
            known, self._before = self._trial.kept.valid(), self._trial.kept.all()
            for mutant in self._trial.mutants:
                if mutant.name not in known:
                    outcome, by = self._outcome(mutant, session.items, at_import)
                    self._trial.kept.keep(mutant.name, outcome, by)
        return True

    def _traced_once(self, items: Sequence[Any], seconds: int = 0) -> bool:
        """Runs the tests soundly in a fork: which lines each runs, and how long it takes [s]; those that pass count.

        :param seconds: for all of them, until the rest is left out; 0: as long as it takes.
        :return: whether each ran and passed.
        """
        into, out = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(into)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(seconds)
            with os.fdopen(out, "w", encoding="utf-8", buffering=1) as pipe:
                for row in self._rows(items):
                    pipe.write(json.dumps(row) + "\n")
            os._exit(0)
        os.close(out)
        with os.fdopen(into, encoding="utf-8") as pipe:
            rows = [json.loads(line) for line in pipe if line.endswith("\n")]
        os.waitpid(child, 0)
        passed = [row for row in rows if not row["failed"]]
        self._took = {row["test"]: row["seconds"] for row in passed}
        self._runs = {row["test"]: frozenset(row["lines"]) for row in passed}
        self._prepares = set(rows[-1]["prepares"]) if rows else set()
        return len(passed) == len(items)

    def _rows(self, items: Sequence[Any]) -> Iterator[dict[str, Any]]:
        for item, following in zip(items, [*items[1:], None], strict=True):
            self._traced, before = Traced(str(self._trial.path)), time.process_time()
            self._failed = False
            sys.settrace(self._traced)
            threading.settrace(self._traced)
            self._run(item, following)
            threading.settrace(None)  # type: ignore[arg-type]
            sys.settrace(None)
            yield {
                "test": item.nodeid,
                "seconds": time.process_time() - before,
                "lines": sorted(self._traced.lines),
                "prepares": sorted(self._prepares),
                "failed": self._failed,
            }

    def _run(self, item: Any, following: Any) -> None:
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)

    def _outcome(self, mutant: Mutant, items: Sequence[Any], at_import: frozenset[int]) -> tuple[str, str]:
        """What became of it, and by which test."""
        early = any(line in at_import for line in mutant.lines)
        first = [item for item in items if not self._runs[item.nodeid].isdisjoint(mutant.lines)]
        if not first and not early:
            return SURVIVED, ""
        if not (mutant.function or mutant.constant) or not at_import.isdisjoint(mutant.made):
            return LATER, ""
        before = self._before[mutant.name].by if mutant.name in self._before else ""
        first.sort(key=lambda item: self._took[item.nodeid] / (1.0 + self._noticed[item.nodeid]))
        first.sort(key=lambda item: item.nodeid != before)
        chosen = {item.nodeid for item in first} if not self._prepares.isdisjoint(mutant.lines) else None
        order = [*first, *[item for item in items if chosen is not None and item.nodeid not in chosen]]
        by = self._noticed_by(mutant, order)
        if by is not None and by < len(order):
            self._noticed[order[by].nodeid] += 1
            return KILLED, order[by].nodeid
        return (LATER if by is None or early else SURVIVED), ""

    def _noticed_by(self, mutant: Mutant, order: Sequence[Any]) -> int | None:
        """Which test notices, their number where none does; None where the mutant cannot be put in place."""
        into, out = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(into)
            self._try(mutant, order, out)
        os.close(out)
        with os.fdopen(into, "rb") as pipe:
            told = pipe.read().split()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if told and told[0] == b"-":
            return None
        return len(order) if status == 0 else max(0, len(told) - 1)

    def _try(self, mutant: Mutant, order: Sequence[Any], out: int) -> None:
        """In a forked process: tells each test before it runs, and ends with 1 where one fails. Never returns."""
        try:
            if not put_in_place(sys.modules[self._trial.name], mutant):
                os.write(out, b"-")
                os._exit(0)
            limit_memory()
            signal.signal(signal.SIGPROF, lambda *_: os._exit(_HANGS))
            end_where_idle()
            for item, following in zip(order, [*order[1:], None], strict=True):
                os.write(out, b". ")
                signal.setitimer(signal.ITIMER_PROF, PATIENCE * self._took[item.nodeid] + ROOM)
                self._run(item, following)
                if self._failed:
                    return
        finally:  # whatever a mutant raises past pytest
            os._exit(1 if self._failed or sys.exc_info()[0] else 0)


def put_in_place(module: ModuleType, mutant: Mutant) -> bool:
    """Gives the mutant's function in the imported module its new code, or the constant its new value.

    False where the function is not found as it stands.
    """
    if mutant.constant:
        (value,) = [
            node.value
            for node in ast.parse(mutant.source).body
            if assigned(node) == mutant.constant  # type: ignore[attr-defined]
        ]
        exec(f"{mutant.constant} = {ast.unparse(value)}", module.__dict__)
        return True
    live, code = live_function(module, mutant.function), code_of(mutant)
    if live is None or code is None or live.__code__.co_freevars != code.co_freevars:
        return False
    live.__code__ = code
    return True


def live_function(module: ModuleType, qualified: str) -> FunctionType | None:
    """The function of a module or class, whatever it is wrapped in; None where that is not sure."""
    found: Any = module
    for name in qualified.split("."):
        found = vars(found).get(name)
        if found is None:
            return None
    for attribute in ("__func__", "fget", "func", "__wrapped__"):
        found = getattr(found, attribute, found) if not isinstance(found, FunctionType) else found
    while isinstance(found, FunctionType) and hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    sure = isinstance(found, FunctionType) and found.__code__.co_qualname == qualified
    return found if sure and found.__module__ == module.__name__ else None


def code_of(mutant: Mutant) -> CodeType | None:
    """The code of the mutant's function; None where there are several of that name."""
    rest, found = [compile(mutant.source, "mutant", "exec", dont_inherit=True)], list[CodeType]()
    while rest:
        inner = [constant for constant in rest.pop().co_consts if isinstance(constant, CodeType)]
        found += [code for code in inner if code.co_qualname == mutant.function]
        rest += inner
    return found[0] if len(found) == 1 else None
