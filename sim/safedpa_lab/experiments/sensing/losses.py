"""Where a car with a laser loses goals: the same drives with one assumption of perception removed at a time.

A removed assumption is no proposal: the guarantee that rests on it is gone, and contacts may follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.workers import driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import markdown_table, page
from safedpa_lab.experiments.sensing.experiment import (
    COUNTED,
    GUARDS,
    POLICIES,
    Drive,
    counted_cells,
    row_of,
    run_drive,
)

CHANGES: Final[Mapping[str, Mapping[str, Any]]] = {
    "as it is": {},
    "hidden people at 0.5 m/s": {"coming": 0.5},
    "no one comes from hidden places": {"coming": 0.0},
    "all people at 0.5 m/s at most": {"coming": 0.5, "fastest": 0.5},
    "who stops is at rest after 2 s": {"restless": 2.0},
    "objects forgotten after 5 s": {"memory": 5.0},
    "the laser looks over the load": {"sees_load": False},
    "a controller without sensors": {"policy": POLICIES[1]},
    "all is known but who hides": {"guard": GUARDS[2]},
    "everything is known": {"guard": GUARDS[1]},
}
"""What is changed in ``Drive``, by its name in the table."""


def losses_experiment(
    seeds: Sequence[int],
    seconds: float,
    people: int,
    processes: int = 2,
    loads: Sequence[str] = ("none",),
    on_drive: ReportProgress = silent,
    record: Path | None = None,
    changes: Mapping[str, Mapping[str, Any]] = CHANGES,
) -> dict[str, Any]:
    """Every change with every load and seed, among people; a row for each load and change."""
    kinds = [(load, name) for load in loads for name in changes]
    plain = Drive("people", 0, seconds, 1.5, policy=POLICIES[0], people=people)
    wanted = [replace(plain, load=load, seed=seed, **changes[name]) for load, name in kinds for seed in seeds]
    known = [replace(plain, load=load, seed=seed, guard=GUARDS[1]) for load in loads for seed in seeds]
    found = driven(run_drive, [*wanted, *known], processes, on_drive, record)
    rows = []
    for index, (load, name) in enumerate(kinds):
        first, exact = index * len(seeds), len(wanted) + loads.index(load) * len(seeds)
        drives, reported = found[first : first + len(seeds)], found[exact : exact + len(seeds)]
        rows.append({"load": load, "change": name, **row_of(("people", GUARDS[0]), drives, reported, seconds)})
    return {"seconds": seconds, "people": people, "seeds": list(seeds), "loads": list(loads), "rows": rows}


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment sensing-losses``."""
    known = {"seeds": seeds_of(options), "loads": options["loads"] or ("none",), "on_drive": report_progress}
    return {"experiment": "sensing-losses", **with_options(losses_experiment, options, **known)}


def page_of(result: Mapping[str, Any]) -> str:
    """Markdown with a table of all rows, and the command that made it."""
    seeds = result["seeds"]
    rows = [f"{row['load']} | {row['change']} | {row['drives']} | {counted_cells(row, 0.0)}" for row in result["rows"]]
    return page(
        "Where a car with a laser loses goals",
        f"Seeds {seeds[0]} to {seeds[-1]}, {result['seconds']:g} s each, {result['people']} people. One assumption is "
        "changed at a time. 'At most' is the one-sided bound at 95 %.",
        result,
        markdown_table(f"load | change | drives | {COUNTED}", rows),
    )
