"""``safedpa bench``: how fast, next to a reference measured in the same run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs

_JSON = click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
_RATE = click.option("--rate", type=float, default=20.0, show_default=True, help="ticks per second")


@click.group(invoke_without_command=True)
@click.pass_context
def command(context: click.Context) -> None:
    """Measure how fast this project is, next to its peers; by default the latency of one robot."""
    if context.invoked_subcommand is None:
        context.invoke(latency)


@command.command()
@click.option("--seconds", type=float, default=20.0, show_default=True, help="for each of the two measurements")
@_RATE
@_JSON
@needs("sim")
def latency(seconds: float, rate: float, *, as_json: bool) -> None:
    """Sense to act over Zenoh, every service its own process, next to a bare chain of relays."""
    from safedpa_lab.benchmarks.latency import latency_benchmark

    _check(seconds, rate)
    result = latency_benchmark(seconds, rate)
    if as_json:
        click.echo(json.dumps(result))
        return
    loop, bare = result["real_loop_us"], result["bare_chain_us"]
    click.echo(f"sense to act at {rate:g} Hz for {seconds:g} s, microseconds:")
    click.echo(f"  real loop   p50 {loop['p50']:7.0f}   p99 {loop['p99']:7.0f}   watchdog {loop['watchdog_ticks']}")
    click.echo(f"  bare chain  p50 {bare['p50']:7.0f}   p99 {bare['p99']:7.0f}")
    click.echo(f"  ratio       p50 {result['ratio_p50']:7.2f}   p99 {result['ratio_p99']:7.2f}")


@command.command()
@click.option("--robots", type=int, default=50, show_default=True, help="simulated cars, all in one process")
@click.option("--seconds", type=float, default=20.0, show_default=True, help="for each fleet")
@_RATE
@click.option("--loads", default="none,box,chair,large_chair", show_default=True, help="what they tow, in turn")
@click.option("--model", default="car", show_default=True, help="model file, or the name of one that ships")
@click.option("--controller", default="", help="the policy's; by default the one that the model allows")
@click.option("--in-step", is_flag=True, help="all robots sense at the same moment; else spread over the period")
@click.option("--realtime", is_flag=True, help="ask for real-time scheduling, as 'safedpa up' does")
@click.option("--stacks", type=int, default=0, help="so many processes with all three services each share the robots")
@click.option("--flood", is_flag=True, help="one more robot floods the bus with 1000 messages a second")
@click.option("--find-largest", is_flag=True, help="double and bisect, from --robots on, for the largest that holds")
@_JSON
@needs("sim")
def fleet(robots: int, seconds: float, *, find_largest: bool, as_json: bool, **options: Any) -> None:
    """Many robots through one process of each service: late ticks, sense to act, processor time, memory."""
    from safedpa.progress import progress
    from safedpa_lab.benchmarks.fleet import FleetTrial, fleet_benchmark, largest_fleet
    from safedpa_lab.benchmarks.latency import bare_chain

    _check(seconds, options["rate"])
    if not 1 <= robots <= 1000:
        raise InputError(f"got --robots {robots}, wanted 1 to 1000")
    if not 0 <= options["stacks"] <= 64:
        raise InputError(f"got --stacks {options['stacks']}, wanted 0 (a process of each service) to 64")
    trial = FleetTrial(robots, seconds, **options)
    bare = bare_chain(min(seconds, 5.0), trial.rate)
    results: list[dict[str, Any]] = []

    def measured(result: dict[str, Any]) -> None:
        results.append(result)
        if not as_json:
            _show(result)

    def measure(wanted: FleetTrial) -> dict[str, Any]:
        with progress(f"{wanted.robots} robots") as report_progress:
            return fleet_benchmark(wanted, report_progress)

    if not as_json:
        click.echo(f"bare chain of as many processes, one robot: p50 {bare['p50']:.0f}, p99 {bare['p99']:.0f} us")
    largest = largest_fleet(trial, measured, measure) if find_largest else None
    if not find_largest:
        measured(measure(trial))
    if as_json:
        found = {} if largest is None else {"largest_fleet": largest}
        click.echo(json.dumps({"bare_chain_us": bare, **found, "trials": results}))
    elif largest is not None:
        click.echo(f"largest fleet with at most 0.1 % late ticks at {trial.rate:g} Hz: {largest} robots")


@command.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--pairs", type=click.IntRange(1, 1000), default=20, show_default=True, help="drives of each, in turn")
@click.option("--seconds", type=click.FloatRange(1.0, 600.0), default=5.0, show_default=True, help="of each drive")
@click.option("--only", multiple=True, metavar="NAME", help="this row of `bench all`, not drives; again for more")
@click.option("--most", type=float, metavar="RATIO", help="exit code 1 where the median ratio of a figure is above it")
@_JSON
@needs("sim")
def against(
    folder: Path, pairs: int, seconds: float, only: tuple[str, ...], most: float | None, *, as_json: bool
) -> None:
    """This checkout next to another one, such as an older commit in a git worktree: ratios of sense to act and start.

    Short drives of the two in turn, with this Python, so that what the machine does meanwhile happens to both. With
    --only, quick rows of `bench all` in turn: the medians of those that both checkouts have.
    """
    from safedpa.errors import SafedpaError
    from safedpa.progress import progress
    from safedpa_lab.benchmarks.against import against as compared
    from safedpa_lab.benchmarks.against import checkout_of
    from safedpa_lab.benchmarks.results import Effort
    from safedpa_lab.benchmarks.suite import chosen_rows

    ours, other = checkout_of(Path(__file__).parents[3]), checkout_of(folder)
    rows = chosen_rows(only, Effort(quick=True)) if only else []
    with progress(f"{pairs} pairs of {'rows' if rows else 'drives'}") as report_progress:
        result = compared(ours, other, pairs, seconds, report_progress, rows=rows)
    if as_json:
        click.echo(json.dumps(result))
    else:
        widest = max(map(len, result["figures"]), default=0)
        for name, row in result["figures"].items():
            click.echo(
                f"{name:{widest}} {row['ours']:9.4g} {row['unit']:2} next to {row['other']:9.4g} {row['unit']:2}   "
                f"ratio {row['ratio']:.3f} (95 %: {row['interval'][0]:.3f} to {row['interval'][1]:.3f})"
            )
    over = [name for name, row in result["figures"].items() if most is not None and row["ratio"] > most]
    if over:
        raise SafedpaError(f"bench against {folder}: {', '.join(over)}: more than {most:g} times as long")


@command.command(name="list")
def list_rows() -> None:
    """The rows of `safedpa bench all`."""
    from safedpa_lab.benchmarks.rows import ROWS

    for name, listed in ROWS.items():
        length = "less than half a minute" if listed.minutes < 0.5 else f"about {listed.minutes:g} min"
        click.echo(f"{name:14} {listed.work} ({length}{', only when named or with --full' if listed.long else ''})")


@command.command(name="all")
@click.option("--quick", is_flag=True, help="a minute, to see that everything works; the numbers mean little")
@click.option("--full", is_flag=True, help="the long rows too, and nothing scaled")
@click.option("--only", multiple=True, metavar="NAME", help="this row alone; may be repeated")
@click.option("--resume", is_flag=True, help="with --json FILE: leave out rows that are in it")
@click.option(
    "--peers", multiple=True, metavar="PYTHON", help="another Python that has peers installed; may be repeated"
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="folder with the DART drives, for the row diagnosis; see docs/evidence/diagnosis.md",
)
@click.option("--json", "file", type=click.Path(path_type=Path, dir_okay=False), help="results, kept up to date")
@click.option("--markdown", type=click.Path(path_type=Path, dir_okay=False), help="the same as a page")
@click.option("--pictures", type=click.Path(path_type=Path, file_okay=False), help="folder for speed*.png")
def all_rows(file: Path | None, markdown: Path | None, pictures: Path | None, **options: Any) -> None:
    """This project and its peers on the same problems in one run: p50, p99, p99.9, and how many times ahead.

    Peers are looked for in every --peers PYTHON and in this one; a peer that is not there says so. What was measured
    before stays in the --json file, so that rows can be measured one by one.
    """
    from safedpa_lab.benchmarks.pictures import write_pictures
    from safedpa_lab.benchmarks.results import Effort
    from safedpa_lab.benchmarks.suite import chosen_rows, run_rows
    from safedpa_lab.benchmarks.table import markdown as page

    if options["quick"] and options["full"]:
        raise InputError("--quick: got --full too; choose one")
    if options["data"] is not None and not options["data"].is_dir():
        where = "docs/evidence/diagnosis.md says where the drives are"
        raise InputError(f"--data {options['data']}: no such folder; {where}")
    effort = Effort(options["quick"], options["full"], options["peers"], options["data"])
    names = chosen_rows(options["only"], effort)
    document = run_rows(names, effort, file, _show_row, resume=options["resume"])
    if markdown is not None:
        markdown.write_text(page(document), encoding="utf-8")
    if pictures is not None:
        for path in write_pictures(document, pictures):
            click.echo(str(path))


def _show_row(name: str, row: dict[str, Any]) -> None:
    """One row on the terminal."""
    from rich.console import Console
    from rich.table import Table

    from safedpa_lab.benchmarks.table import row_lines, target_texts

    console = Console(highlight=False, soft_wrap=True, width=max(Console().width, 130))
    console.print(f"\n[bold]{name}[/bold]: {row['work']}")
    if "failed" not in row:
        columns, lines = row_lines(row)
        table = Table(box=None, padding=(0, 1, 0, 0))
        for column in columns:
            table.add_column(column, justify="left" if column in ("program", "problem") else "right", no_wrap=True)
        for line in lines:
            table.add_row(*line)
        console.print(table)
    entries = (*row.get("ours", ()), *row.get("peers", ()))
    absent = [f"{entry['name']}: {entry['missing']}" for entry in entries if entry["missing"]]
    for phrase in (*target_texts(row), *row.get("notes", ()), *dict.fromkeys(absent)):
        console.print(f"  {phrase}", markup=False)


def _check(seconds: float, rate: float) -> None:
    if not (1.0 <= seconds <= 3600.0 and 1.0 <= rate <= 500.0):
        raise InputError(f"got --seconds {seconds} --rate {rate}, wanted 1 to 3600 s and 1 to 500 ticks per second")


def _show(result: dict[str, Any]) -> None:
    """One fleet as a few lines."""
    sense, own = result["sense_to_act_us"], result["own_lateness_us"]
    click.echo(
        f"{result['robots']} robots at {result['rate_hz']:g} Hz for {result['seconds']:g} s: "
        f"{result['late_ticks']} of {result['robot_ticks']} ticks late ({100.0 * result['late_share']:.3f} %, "
        f"{result['late_while_held_up']} of them while the simulation itself was late), "
        f"load average {result['load_average'][0]} to {result['load_average'][1]}"
    )
    for name, times in (("sense to act, us", sense), ("states sent late by, us", own)):
        reported = "   ".join(f"{key} {_number(times[key])}" for key in ("p50", "p99", "p999", "longest"))
        click.echo(f"  {name:24} {reported}")
    for name, used in result["processes"].items():
        if used is not None:
            click.echo(
                f"  {name:24} {100.0 * used['cores']:5.1f} % of a core   {used['us_per_robot_tick']:6.0f} us a "
                f"robot-tick   {used['mib_begin']:.1f} to {used['mib_end']:.1f} MiB   "
                f"{used['handles_begin']} to {used['handles_end']} open files"
            )
    click.echo(f"  goals {result['goals_reached']}, collisions {result['collisions']}, refused {result['refusals']}")


def _number(value: float | None) -> str:
    return "     -" if value is None else f"{value:6d}"
