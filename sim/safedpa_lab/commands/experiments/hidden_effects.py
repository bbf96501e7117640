"""``safedpa experiment hidden-effects``: diagnosis against truths that it cannot see."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.names import SuggestingChoice

__all__ = ["command"]

_SUITES = (
    "ordinary", "fifth", "two", "three", "hard", "none", "none_hard", "pendulum", "towing", "patches", "sags",
    "speed_gains", "bad", "wheels", "wheels_none", "all",
)  # fmt: skip


@click.command(name="hidden-effects")
@click.option("--cases", type=int, default=48, show_default=True, help="of each suite")
@click.option("--seed", type=int, default=0, show_default=True, help="draws strengths, drives and noise")
@click.option(
    "--suite", "suites", type=SuggestingChoice(_SUITES), multiple=True, help="may be given several times; default: all"
)
@click.option("--processes", type=int, default=2, show_default=True, help="with one thread each")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="write every case there as JSON as well, after every few cases; what the file holds already is not done again",
)
@click.option("--page", type=click.Path(path_type=Path), help="write the tables there as Markdown as well")
@click.option("--horizons", is_flag=True, help="only whether verdict and names are equal for horizons of 0.2 to 1 s")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim", "diagnosis")
def command(**options: Any) -> None:
    """How often diagnosis names what is hidden.

    The logs are those of simulators that share no code with the fitted models; the truth is opened afterwards.
    ordinary, fifth: each car effect in turn, at ordinary strength and at a fifth of it. two, three: so many at once.
    hard: coloured disturbance, three times the noise, lost rows, tracking glitches, servo gain 10 % off. none,
    none_hard: nothing hidden. pendulum: each of its effects. towing: the pymunk car with a chair hitched. patches,
    sags, speed_gains: an effect acts in a place only, its number falls with the time, or with the speed. bad: nothing
    hidden, but one of three runs spoiled in one of twenty ways. wheels, wheels_none: each effect of a differential
    drive in turn, and nothing hidden in one.

    With --horizons each case is diagnosed once for each of five horizons instead, in one process, and nothing is judged
    but whether they say the same.

    An interrupted experiment goes on with the same --out; other suites and seeds may be added to it.
    """
    from safedpa_lab.experiments.hidden_effects import ALL, hidden_effects_experiment
    from safedpa_lab.experiments.hidden_page import page_of
    from safedpa_services.progress import progress

    if options["cases"] < 1 or options["processes"] < 1 or options["seed"] < 0:
        raise InputError("--cases and --processes: wanted more than 0; --seed: wanted 0 or more")
    for name in ("out", "page"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
    suites = ALL if "all" in (options["suites"] or ("all",)) else options["suites"]
    if options["horizons"]:
        _horizons(suites, options)
        return
    with progress("experiment hidden-effects") as report_progress:
        result = hidden_effects_experiment(
            suites, options["cases"], options["seed"], options["processes"], report_progress, options["out"]
        )
    if options["page"] is not None:
        options["page"].write_text(page_of(result), encoding="utf-8")
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _horizons(suites: Sequence[str], options: dict[str, Any]) -> None:
    from safedpa_lab.experiments.hidden_horizons import hidden_horizons
    from safedpa_lab.provenance.record import write_result
    from safedpa_services.progress import progress

    if options["page"] is not None:
        raise InputError("--page: got it with --horizons, which has no page; leave it out")
    with progress("experiment hidden-effects") as report_progress:
        result = hidden_horizons(suites, options["cases"], options["seed"], report_progress=report_progress)
    if options["out"] is not None:
        write_result(options["out"], result)
    if options["as_json"]:
        click.echo(json.dumps(result))
        return
    click.echo(f"verdict and names equal for every horizon in {result['equal']} of {result['of']} cases")
    for row in result["cases"]:
        if not row["equal"]:
            notice = "; ".join(f"{own['horizon']} s {own['verdict']} {'+'.join(own['added'])}" for own in row["notice"])
            click.echo(f"differs {row['case']}: {notice}")


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    console.print(_table("suite", result["suites"]))
    if result["effects"]:
        console.print(_table("effect", result["effects"]))
    console.print(_LEGEND)
    for item in result["missed"]:
        hidden, added = (" + ".join(item[key]) or "nothing" for key in ("hidden", "added"))
        console.print(f"missed {item['case']}: hidden {hidden}; {item['verdict']}, added {added}", markup=False)


_LEGEND = (
    "In %: right (in its group, where and when it acts; nothing where nothing is hidden) with its 95 % interval; named "
    "first; all named; something wrong added too; where or when told of what acts always; parameters within two stated "
    "standard deviations. Then the held-out error over that of an oracle (median, worst), seconds a case by the clock, "
    "and of one core."
)


def _table(first: str, rows: list[dict[str, Any]]) -> Any:
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    table.add_column(first, no_wrap=True)
    for name in ("n", "right", "95 %", "first", "all", "wrong", "false", "2 sd", "oracle", "worst", "s", "core s"):
        table.add_column(name, justify="right", no_wrap=True)
    several = len({row["suite"] for row in rows}) > 1
    for row in rows:
        title = row["suite"] if first == "suite" else row["effect"]
        if first == "effect" and several:
            title = f"{row['suite']}: {title}"
        low, high = row["right"]["interval_95"]
        keys = ("named_first", "all_named", "wrong_additions", "false_laws", "parameters_within_two")
        shares = [row[key] for key in keys]
        table.add_row(
            title,
            str(row["cases"]),
            _percent(row["right"]),
            f"{100 * low:.0f}-{100 * high:.0f}",
            *(_percent(share) for share in shares),
            _number(row["error_ratio_median"]),
            _number(row["error_ratio_largest"]),
            f"{row['seconds_median']:.1f}",
            "" if row["processor_seconds_median"] is None else f"{row['processor_seconds_median']:.1f}",
        )
    return table


def _percent(share: dict[str, Any] | None) -> str:
    return "" if share is None else f"{100 * share['hits'] / share['of']:.0f}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
