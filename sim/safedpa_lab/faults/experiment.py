"""``safedpa experiment faults``: the table of faults, which to inject, the measurement, its verdict and its page."""

from __future__ import annotations

import dataclasses
import math
import os
import random
import time
from collections.abc import Mapping, Sequence
from typing import Any

from safedpa.errors import InputError, SafedpaError, did_you_mean
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.faults.campaign import run_faults
from safedpa_lab.faults.endurance import Resources, retained_by
from safedpa_lab.faults.fault import Fault
from safedpa_lab.faults.model_changes import partitioned_changes
from safedpa_lab.faults.network import bent, cut, disconnected
from safedpa_lab.faults.processes import hung, killed, paused, twins
from safedpa_lab.faults.resources import clocks, disks, overload

_SHORTEST_SECONDS = 2.5
"""That a fault takes, with the second that is waited for afterwards."""


def all_faults() -> list[Fault]:
    """Every fault, kind by kind; those that need the stand-in for the diagnosis last."""
    return [
        *killed(), *paused(), *hung(), *twins(), *disconnected(), *cut(), *bent(), *disks(), *clocks(), *overload(),
        *partitioned_changes(),
    ]  # fmt: skip


def small_faults() -> list[Fault]:
    """At least one of every kind that a machine can bring about within seconds."""
    return [fault for fault in all_faults() if fault.small]


def faults_for(seconds: float, seed: int) -> list[Fault]:
    """Enough for so long, in rounds of all that one fleet can suffer, each in an order of its own by the seed.

    Those that need the stand-in for the diagnosis would ask for another fleet, and are left out.
    """
    once = [fault for fault in all_faults() if fault.diagnosis == "real"]
    chance, faults = random.Random(seed), list[Fault]()
    while len(faults) < seconds / _SHORTEST_SECONDS:
        faults += chance.sample(once, len(once))
    return faults


def faults_named(name: str) -> list[Fault]:
    """One fault by its name, or all of a kind (first word), such as ``kill``. Raises InputError for another name."""
    faults = all_faults()
    found = [fault for fault in faults if name in (fault.name, fault.kind)]
    if not found:
        names = [fault.name for fault in faults]
        raise InputError(f"--only '{name}': {did_you_mean(name, [*names, *dict.fromkeys(f.kind for f in faults)])}")
    return found


_MOST_MINUTES = 1440


def _chosen(options: Options) -> Sequence[Any]:
    """The faults that the options select. Raises InputError for options that exclude each other."""
    minutes, only = options["minutes"], options["only"]
    if minutes and (only or options["small"]):
        raise InputError("--minutes: takes all faults that one fleet can suffer; leave --only and --small out")
    if minutes and not minutes <= _MOST_MINUTES:  # also refuses NaN
        raise InputError(f"--minutes: got {minutes:g}, wanted {_MOST_MINUTES} at most, which is a day")
    faults = faults_named(only) if only else all_faults()
    if minutes:
        faults = faults_for(60.0 * minutes, options["seed"])
    if options["small"]:
        faults = [fault for fault in faults if fault in small_faults()] if only else small_faults()
    if not faults:
        raise InputError(f"--only '{only}': none of these is in the small version; leave --small out")
    return faults


def listing(options: Options) -> list[str]:
    """One line per fault."""
    return [f"{fault.name:28}{fault.sentence}" for fault in _chosen(options)]


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment faults``."""
    faults = _chosen(options)
    began, load, resources = time.monotonic(), os.getloadavg()[0], Resources()
    campaign = run_faults(
        faults,
        options["seed"],
        options["keep"],
        lambda _, done, count: report_progress(done, count),
        is_hasty=options["small"],
        seconds=60.0 * (options["minutes"] or math.inf),
        alongside=resources.alongside,
    )
    retained = retained_by(resources.samples) if options["minutes"] else []
    return {
        "experiment": "faults",
        "command": _command(options),
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "seed": options["seed"],
        "seconds": round(time.monotonic() - began, 1),
        "cores": os.cpu_count(),
        "load_before": load,
        "load_after": os.getloadavg()[0],
        "held": campaign.held and all(one.flat for one in retained),
        "periods": campaign.periods,
        "collisions": campaign.collisions,
        "stale_actions": campaign.stale_actions,
        "acknowledged": campaign.acknowledged,
        "recorded": campaign.recorded,
        "resources": [dataclasses.asdict(one) | {"flat": one.flat} for one in retained],
        "rows": [dataclasses.asdict(outcome) for outcome in campaign.outcomes],
    }


def _command(options: Options) -> str:
    given = f" --only '{options['only']}'" if options["only"] else ""
    given += f" --minutes {options['minutes']:g}" if options["minutes"] else ""
    return f"safedpa experiment faults{given}{' --small' if options['small'] else ''} --seed {options['seed']}"


def verdict(result: Mapping[str, Any]) -> None:
    """Raises SafedpaError naming the faults after which an invariant did not hold, and the processes that grew."""
    if result["held"]:
        return
    broken = [row["name"] for row in result["rows"] if not row["held"]]
    broken += [f"{row['name']} grew" for row in result["resources"] if not row["flat"]]
    broken = broken or ["something between the faults, or the recorder's acknowledgement"]
    raise SafedpaError(f"faults: did not hold: {', '.join(broken)}")


_KINDS_HEAD = "| kind | faults | held | braked by robot, by filter | drives again after s | all back after s |"
_HEAD = (
    "| fault | what happened | held | speed m/s | collisions | stale actions | periods | watchdog | fallback "
    "| drives again after s | all back after s | not recorded: states, verdicts |"
)


def markdown_of(result: Mapping[str, Any]) -> str:
    """A headline, one row a fault, and what did not hold."""
    rows = result["rows"]
    held = sum(row["held"] for row in rows)
    lines = [
        "# Faults, measured",
        "",
        f"`{result['command']}`, {result['date']}, {result['seconds']:.0f} s, {result['cores']} cores; load of the "
        f"machine {result['load_before']:.1f} at the beginning, {result['load_after']:.1f} at the end.",
        "",
        f"**{held} of {len(rows)} held; {result['collisions']} collisions, {result['stale_actions']} stale actions in "
        f"{result['periods']} periods, those between the faults included.** The recorders "
        f"acknowledged {result['acknowledged']} messages; "
        f"{result['recorded']} can be read.",
        "",
        _KINDS_HEAD,
        "|---|---|---|---|---|---|",
        *(_kind_line(kind, of_kind) for kind, of_kind in _kinds(rows).items()),
        "",
        "Times count from the recovery. 0.00: the loop had not stopped, but for at most two periods in a row.",
        "",
        *(
            _resources(result["resources"])
            if result.get("resources")
            else [_HEAD, "|" + "---|" * _HEAD.count(" | ") + "---|", *(_line(row) for row in rows)]
        ),
        "",
    ]
    broken = [f"- {row['name']}: {'; '.join(row['broken'])}" for row in rows if not row["held"]]
    return "\n".join([*lines, *(["What did not hold:", "", *broken, ""] if broken else [])])


def _resources(resources: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of a long run, in which each fault comes again and again: one row a process instead."""
    lines = [
        "What its processes held in the first and in the last quarter of the time, older than half a minute:",
        "",
        "| process | lives | the longest, s | resident MiB, median | open files, most | threads, most | |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in resources:
        cells = [f"{row[name][0]} to {row[name][1]}" for name in ("mib", "handles", "threads")]
        reported = "flat" if row["flat"] else "**grew**"
        life = f"{row['processes']} | {row['longest_life_seconds']:.0f}"
        lines.append(f"| {row['name']} | {life} | {' | '.join(cells)} | {reported} |")
    return lines


def _kinds(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """By the first word of the name, up to a hyphen's moment: ``change-ready policy`` is a ``change``."""
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        word = row["name"].split()[0]
        kinds.setdefault("change" if word.startswith("change-") else word, []).append(row)
    return kinds


def _kind_line(kind: str, rows: Sequence[Mapping[str, Any]]) -> str:
    periods = sum(row["periods"] for row in rows)
    braked = ", ".join(f"{sum(row[name] for row in rows) / max(periods, 1):.0%}" for name in ("watchdog", "fallbacks"))
    drives, back = (_range([row[name] for row in rows]) for name in ("recovery_seconds", "whole_seconds"))
    return f"| {kind} | {len(rows)} | {sum(row['held'] for row in rows)} | {braked} | {drives} | {back} |"


def _range(seconds: Sequence[float | None]) -> str:
    known = [value for value in seconds if value is not None]
    reported = f"{min(known):.2f} to {max(known):.2f}" if len(known) > 1 else _seconds(known[0] if known else None)
    return reported if len(known) == len(seconds) else f"{reported}, {len(seconds) - len(known)} never"


def _line(row: Mapping[str, Any]) -> str:
    cells = [row["name"], row["sentence"], "yes" if row["held"] else "**no**", f"{row['speed']:.2f}"]
    cells += [str(row[name]) for name in ("collisions", "stale_actions", "periods", "watchdog", "fallbacks")]
    cells += [_seconds(row["recovery_seconds"]), _seconds(row["whole_seconds"])]
    cells.append(f"{row['states_not_recorded']}, {row['verdicts_not_recorded']}")
    return "| " + " | ".join(cells) + " |"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f}"
