"""A progress bar on a terminal, nothing in a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["progress", "progress_with_notes"]


@contextmanager
def progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """Yields ``tell(done, all)``; with the expected end, on standard error, and only there on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _done, _all: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title)

        def report_progress(done: int, everything: int) -> None:
            bar.update(task, completed=done, total=everything)

        yield report_progress


@contextmanager
def progress_with_notes(title: str) -> Iterator[Callable[[int, int, str], None]]:
    """Yields ``tell(done, all, said)`` for work of which no one knows how much is left: the seconds that passed are
    shown, none that are to come, and what is ``notice`` stands above the bar whenever it changes. Only on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _done, _all, _message: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task, last = bar.add_task(title), ""

        def report_progress(done: int, everything: int, notice: str) -> None:
            nonlocal last
            if notice != last:
                bar.console.print(f"{title}: {notice}", highlight=False, markup=False)
                last = notice
            bar.update(task, completed=done, total=everything)

        yield report_progress
