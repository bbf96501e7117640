"""Work distributed over processes, and drives that are kept in a file so that a long experiment can continue."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, final

from safedpa.errors import InputError
from safedpa_lab.experiments.record import ReportProgress, silent
from safedpa_lab.provenance.code import digests

Item = TypeVar("Item")
Result = TypeVar("Result")


@final
class Workers(AbstractContextManager["Workers"]):
    """``map`` over several processes, each on one core; with one, in this process."""

    def __init__(self, processes: int) -> None:
        self._pool: ProcessPoolExecutor | None = None
        if processes > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_one_thread)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """The results of ``function`` on the items, in their order."""
        return map(function, items) if self._pool is None else self._pool.map(function, items)

    def __exit__(self, *_: Any) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def _one_thread() -> None:
    """Set before numpy is imported by the first task: two processes of many threads would fight for the cores."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


@final
class Progress:
    """Counts finished parts, and reports them."""

    def __init__(self, size: int, report_progress: ReportProgress) -> None:
        self.size, self.done, self._report = size, 0, report_progress

    def advance(self, count: int = 1) -> None:
        """Adds finished parts."""
        self.done += count
        self._report(self.done, self.size)


Order = TypeVar("Order")
"""A frozen dataclass of plain values; the result of its drive contains its fields."""
Outcome = dict[str, Any]


def driven(
    run: Callable[[Order], Outcome],
    wanted: Sequence[Order],
    processes: int,
    on_drive: ReportProgress = silent,
    record: Path | None = None,
) -> list[Outcome]:
    """The result of each drive, in order; equal drives are run once.

    Drives that ``record`` holds are not driven again, and those that are driven are added to it. Raises InputError
    for a file that is no such record, or one that other code than today's made.
    """
    different = dict.fromkeys(wanted)
    retained = {} if record is None or not wanted else _recorded(record, type(wanted[0]), run.__module__)
    found = {order: retained[order] for order in different if order in retained}
    missing = [order for order in different if order not in retained]
    with Workers(processes) as workers:
        for order, outcome in zip(missing, workers.map(run, missing), strict=True):
            found[order] = outcome
            if record is not None:
                with record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(outcome) + "\n")
            on_drive(len(found), len(different))
    return [found[order] for order in wanted]


def check_record(record: Path | None, kind: type[Any], run: Callable[[Any], Outcome]) -> None:
    """Creates the record, or checks that it can be continued, before other long work. Raises InputError as above."""
    if record is not None:
        _recorded(record, kind, run.__module__)


def _recorded(path: Path, kind: Any, module: str) -> dict[Any, Outcome]:
    """The drives in a file, which is created if missing. Its first line is the code that made them."""
    code = digests(module)
    try:
        if not path.exists():
            path.write_text(json.dumps({"code": code}) + "\n", encoding="utf-8")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be kept as a record ({error}); wanted a file that can be written") from error
    whole = text[: text.rfind("\n") + 1] or text  # what was killed while it wrote leaves part of a line
    try:
        first, *lines = map(json.loads, whole.splitlines())
        by = first["code"]
        drives = {kind(**{item.name: one[item.name] for item in fields(kind)}): one for one in lines}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: got no record of such drives ({error}), wanted a new file, or one that was"
        ) from error
    if by != code:
        raise InputError(f"{path}: its drives were made by other code than today's; wanted another file")
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    return drives


def each_result(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    processes: int,
    report_progress: ReportProgress = silent,
) -> list[Result]:
    """The results of ``function`` on the items, in order; the progress is reported after each."""
    results: list[Result] = []
    with Workers(processes) as workers:
        for result in workers.map(function, items):
            results.append(result)
            report_progress(len(results), len(items))
    return results
