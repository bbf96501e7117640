"""``safedpa experiment hostile``: input and company that no one wants, against readers and whole drives."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_services.command_line.options import as_json_option

__all__ = ["command"]

_SECONDS = {"mutations": 60.0, "roads": 0.0, "offers": 60.0, "silent": 20.0, "flood": 5.0}
"""Roads take as long as they take."""
ReportProgress = Callable[[int, int], None]


@click.command(name="hostile")
@click.option(
    "--attack",
    type=click.Choice(list(_SECONDS)),
    default="mutations",
    show_default=True,
    help="Mutated input; bombs on every road that a file takes; models offered to a fleet; silent connections; floods.",
)
@click.option("--seconds", type=click.FloatRange(0.1, 1e6), help="For so long; default: 60, silent 20, each flood 5.")
@click.option("--seed", type=int, default=1000, show_default=True, help="The same one gives the same mutations.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Keep mutations that opened a hole there.")
@click.option("--page", type=click.Path(path_type=Path), metavar="DIR", help="Folder for hostile.json and hostile.md.")
@as_json_option
@needs("sim")
def command(attack: str, seconds: float | None, seed: int, out: Path | None, page: Path | None, as_json: bool) -> None:
    """Attack codec, loaders, pages' handlers and a loop that drives with mutated input, or whole drives in real time.

    Mutated input is taken or refused in one line; anything else, or more time than the table of limits gives, is a
    hole. Roads: small files that ask for much, to every command that reads a file, are refused in one line with exit
    code 2, in little memory, and nothing is written. Drives go on: no tick late because of offers, people join within a
    second next to a thousand who are silent, and a flood brakes no robot for longer than it lasts. Exit code 1 where
    that did not hold.
    """
    from safedpa.errors import SafedpaError
    from safedpa_services.progress import progress

    wanted = _SECONDS[attack] if seconds is None else seconds
    with progress(f"attacking: {attack}") as report_progress:
        result = _measured(attack, wanted, seed, out, report_progress)
    if page is not None:
        from safedpa_lab.benchmarks.hostile.page import write_page

        write_page(page, attack, result)
    if as_json:
        click.echo(json.dumps(result))
    else:
        _report(attack, result)
    if not result["held"]:
        holes = [hole for target in result.get("targets", ()) for hole in target["holes"]]
        holes += [row["hole"] for row in result.get("pairs", ()) if row["hole"]]
        raise SafedpaError(f"hostile: {attack}: {f'{len(holes)} holes' if holes else 'it did not hold'}; see above")


def _measured(
    attack: str, seconds: float, seed: int, out: Path | None, report_progress: ReportProgress
) -> dict[str, Any]:
    about = {
        "format": 1,
        "command": f"safedpa experiment hostile --attack {attack}"
        + (f" --seconds {seconds:g}" if seconds else "")
        + (f" --seed {seed}" if attack == "mutations" else ""),
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "cores": os.cpu_count(),
    }
    return {**about, **_attacked(attack, seconds, seed, out, report_progress)}


def _attacked(
    attack: str, seconds: float, seed: int, out: Path | None, report_progress: ReportProgress
) -> dict[str, Any]:
    if attack == "roads":
        return _walked(report_progress)
    if attack == "offers":
        from safedpa_lab.benchmarks.hostile.offered import offers_benchmark

        return offers_benchmark(seconds, report_progress)
    if attack == "silent":
        from safedpa_lab.benchmarks.hostile.silent import silent_benchmark

        return silent_benchmark(seconds, report_progress=report_progress)
    if attack == "flood":
        from safedpa_lab.benchmarks.hostile.floods import floods_benchmark

        return floods_benchmark(seconds, report_progress=report_progress)
    return _mutated(seconds, seed, out, report_progress)


def _mutated(seconds: float, seed: int, out: Path | None, report_progress: ReportProgress) -> dict[str, Any]:
    from safedpa_lab.benchmarks.usage import load_average
    from safedpa_lab.commands.experiments.hostile_pages import page_targets
    from safedpa_lab.experiments.hostile.fuzz import fuzz
    from safedpa_lab.experiments.hostile.recordings import recording_targets

    load = load_average()
    with page_targets() as pages, tempfile.TemporaryDirectory(prefix="safedpa-hostile-drive-") as folder:
        further = (*pages, *recording_targets(Path(folder)))
        tallies = fuzz(seconds, seed, out, lambda share: report_progress(round(100.0 * share), 100), further)
    return {
        "seconds": seconds,
        "seed": seed,
        "held": not any(tally.holes for tally in tallies),
        "targets": [tally.as_row() for tally in tallies],
        "load_average": [load, load_average()],
    }


def _walked(report_progress: ReportProgress) -> dict[str, Any]:
    from safedpa_lab.benchmarks.usage import load_average
    from safedpa_lab.experiments.hostile.roads import pairs, walk

    load = load_average()
    rows = walk(list(pairs()), report_progress)
    return {
        "held": not any(row["hole"] for row in rows),
        "pairs": rows,
        "load_average": [load, load_average()],
    }


def _report(attack: str, result: dict[str, Any]) -> None:
    if attack == "roads":
        for row in result["pairs"]:
            click.echo(
                f"{row['road']:<26} {row['bomb']:<52} {row['seconds']:6.2f} s {row['mebibytes']:6.1f} MiB"
                + (f"; HOLE: {row['hole']}" if row["hole"] else "")
            )
    elif attack == "mutations":
        for row in result["targets"]:
            holes = f"; HOLES: {'; '.join(row['holes'])}" if row["holes"] else ""
            click.echo(
                f"{row['target']:<22} {row['inputs']:>9} inputs, {row['refused']:>9} refused, "
                f"slowest {row['worst_ms']:8.2f} ms{holes}"
            )
    elif attack == "offers":
        for name, key in (("in peace", "in_peace"), ("under attack", "under_attack")):
            row = result["offers"][key]
            delays = ", ".join(f"{share} {value} ms" for share, value in row["sense_to_act_ms"].items())
            click.echo(
                f"{name:<13} {row['late_ticks']} of {row['robot_ticks']} ticks late, {row['late_by_the_machine']} of "
                f"these by the machine itself; sense to act {delays}"
            )
        for name, row in result["offers"]["answers"].items():
            waits = ", ".join(f"{share} {value} ms" for share, value in row["after_state_ms"].items())
            click.echo(f"{name:<32} {row['refused']} of {row['answers']} answers refuse it; after the state: {waits}")
    elif attack == "silent":
        for name, row in (("in peace", result["in_peace"]), ("under attack", result["under_attack"])):
            click.echo(
                f"{name:<13} exit code {row['exit_code']}, {row['ticks']} ticks, {row['watchdog_ticks']} braked, "
                f"{row['restarts']} restarts; slowest of {row['joins']} joins: {row['slowest_join_seconds']} s"
            )
    else:
        for row in result["rows"]:
            click.echo(
                f"{row['flood']:<44} {row['messages_a_second']:>6} a second for {row['flood_seconds']} s: braked "
                f"{row['braked_seconds']} s, at a stretch {row['longest_seconds']} s, after it {row['after_seconds']} s"
            )
