"""Progress bars on standard error; nothing is shown unless it is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """Yields ``report_progress(done, total)``, which updates a bar with the remaining time."""
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
    """Yields ``report_progress(done, total, notice)``, for work whose duration cannot be predicted.

    The bar shows the elapsed instead of the remaining time. A changed ``notice`` is printed above the bar.
    """
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
