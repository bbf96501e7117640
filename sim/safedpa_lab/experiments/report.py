"""Tables in Markdown, and the one writer of what an experiment leaves: tables, JSON with provenance, figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa_lab.experiments.record import Experiment, Options, Result, resolve
from safedpa_lab.provenance.record import KEY, provenance, write_result


def markdown_table(head: str, rows: Iterable[str], *, above: str = "") -> str:
    """A Markdown table. ``head`` and each row hold cells separated by " | "; ``above`` is a paragraph before it."""
    columns = head.count("|") + 1
    lines = [f"| {head} |", "|" + "---|" * columns, *(f"| {row} |" for row in rows)]
    return "\n".join([above, "", *lines] if above else lines)


def interval(
    found: Sequence[float], scale: float = 1.0, digits: int = 1, least: float = -inf, most: float = inf
) -> str:
    """Mean and 95 % interval, scaled and clipped to the possible range: "2.5 (1.9 to 3.1)"."""
    mean, low, high = (scale * part for part in found)
    return f"{mean:.{digits}f} ({max(low, least):.{digits}f} to {min(high, most):.{digits}f})"


def percent(ends: Sequence[float], digits: int = 1) -> str:
    """The ends of an interval of a share in per cent: "90.2 to 99.5 %"."""
    return f"{100.0 * ends[0]:.{digits}f} to {100.0 * ends[1]:.{digits}f} %"


def share_percent(share: float, ends: Sequence[float]) -> str:
    """A share and its interval in per cent, without the sign: "97.10 (90.21 to 99.50)"."""
    return f"{100.0 * share:.2f} ({100.0 * ends[0]:.2f} to {100.0 * ends[1]:.2f})"


def page(title: str, about: str, result: Mapping[str, Any], *blocks: str) -> str:
    """A Markdown page: title, what was done, the command that made it, and tables and lists that are not empty."""
    return "\n\n".join([f"# {title}", about, made_by(result), *filter(None, blocks)]) + "\n"


def made_by(result: Mapping[str, Any]) -> str:
    """The command and day that made a result, from its provenance."""
    made = result.get(KEY, {})
    return f"`{made.get('command')}`, {str(made.get('date'))[:10]}"


def report_text(experiment: Experiment, result: Result) -> str:
    """The tables of a result, with the command that made it."""
    text: str = resolve(experiment.report)({**result, KEY: provenance()})
    return text.rstrip() + "\n"


def write_report(experiment: Experiment, result: Result, options: Options) -> None:
    """Writes the files that the options name: JSON, Markdown, figure, or a folder with all three."""
    outputs = experiment.outputs(options)
    document = resolve(experiment.document)(result) if experiment.document else result
    if (folder := outputs.get("folder")) is not None:
        stem = experiment.stem or experiment.name
        outputs |= {"json": folder / f"{stem}.json", "markdown": folder / f"{stem}.md", "figure": folder}
    if "json" in outputs:
        write_result(outputs["json"], document)
    if "markdown" in outputs:
        outputs["markdown"].write_text(report_text(experiment, result), encoding="utf-8")
    if "figure" in outputs and experiment.figures:
        resolve(experiment.figures)(result, outputs["figure"])


@contextmanager
def output_folder(folder: Path | None) -> Iterator[None]:
    """Makes the folder before the work begins, so that hours of work are not lost at their end.

    Raises InputError where it cannot be made. A run that is refused leaves no empty folder behind.
    """
    if folder is None:
        yield
        return
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be made ({error.strerror}); choose another folder") from error
    try:
        yield
    except InputError:
        for each in made:
            if not any(each.iterdir()):
                each.rmdir()
        raise
