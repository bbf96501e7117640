"""Progress bars in a terminal, on standard error, and in a notebook; elsewhere nothing is shown."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["progress", "progress_with_notes"]


@contextmanager
def progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """Yields ``report_progress(done, total)``, which updates a bar with the remaining time."""
    console = _console()
    if console is None:
        yield lambda _done, _all: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title)

        def report_progress(done: int, everything: int) -> None:
            bar.update(task, completed=done, total=everything)

        yield report_progress


@contextmanager
def progress_with_notes(title: str) -> Iterator[Callable[[int, int, str], None]]:
    """Yields ``report_progress(done, total, notice)``, for work whose duration cannot be predicted.

    The bar shows the elapsed instead of the remaining time. A changed ``notice`` is printed above the bar; a
    notebook shows it in the bar.
    """
    console = _console()
    if console is None:
        yield lambda _done, _all, _message: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task, last = bar.add_task(title), ""

        def report_progress(done: int, everything: int, notice: str) -> None:
            nonlocal last
            if notice != last and not console.is_jupyter:
                bar.console.print(f"{title}: {notice}", highlight=False, markup=False)
                last = notice
            # A cell keeps what is printed, so a notebook has the notice in the bar.
            description = f"{title}: {notice}" if console.is_jupyter else title
            bar.update(task, completed=done, total=everything, description=description)

        yield report_progress


def _console() -> Console | None:
    """Returns the console that shows a bar, or None where none can be shown."""
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_jupyter:  # Rich draws there with ipywidgets, and warns without it
        return console if importlib.util.find_spec("ipywidgets") else None
    return console if console.is_terminal else None
