"""One kind of attack on readers of input, or on whole drives in real time."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.hostile.floods import floods_benchmark
from safedpa_lab.benchmarks.hostile.offered import offers_benchmark
from safedpa_lab.benchmarks.hostile.page import attack_tables, write_page
from safedpa_lab.benchmarks.hostile.silent import silent_benchmark
from safedpa_lab.benchmarks.usage import load_average
from safedpa_lab.experiments.hostile.fuzz import fuzz
from safedpa_lab.experiments.hostile.roads import pairs, walk
from safedpa_lab.experiments.hostile.targets import page_targets, recording_targets
from safedpa_lab.experiments.record import Options, ReportProgress, Result

_SECONDS = {"mutations": 60.0, "roads": 0.0, "offers": 60.0, "silent": 20.0, "flood": 5.0}
"""Default duration. Roads take as long as they take."""


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment hostile``; the page keeps the results of the other attacks."""
    attack, seed = options["attack"], options["seed"]
    seconds = _SECONDS[attack] if options["seconds"] is None else options["seconds"]
    command = f"safedpa experiment hostile --attack {attack}" + (f" --seconds {seconds:g}" if seconds else "")
    result: Result = {
        "format": 1,
        "command": command + (f" --seed {seed}" if attack == "mutations" else ""),
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "cores": os.cpu_count(),
    }
    if attack == "offers":
        result |= offers_benchmark(seconds, report_progress)
    elif attack == "silent":
        result |= silent_benchmark(seconds, report_progress=report_progress)
    elif attack == "flood":
        result |= floods_benchmark(seconds, report_progress=report_progress)
    else:
        load = load_average()
        if attack == "roads":
            rows = walk(list(pairs()), report_progress)
            result |= {"held": not any(row["hole"] for row in rows), "pairs": rows}
        else:
            result |= _mutations(seconds, seed, options["out"], report_progress)
        result["load_average"] = [load, load_average()]
    if options["page"] is not None:
        write_page(options["page"], attack, result)
    return result


def _mutations(seconds: float, seed: int, out: Path | None, report_progress: ReportProgress) -> dict[str, Any]:
    with page_targets() as pages, tempfile.TemporaryDirectory(prefix="safedpa-hostile-drive-") as folder:
        further = (*pages, *recording_targets(Path(folder)))
        tallies = fuzz(seconds, seed, out, lambda share: report_progress(round(100.0 * share), 100), further)
    held = not any(tally.holes for tally in tallies)
    return {"seconds": seconds, "seed": seed, "held": held, "targets": [tally.as_row() for tally in tallies]}


def _attack(result: Result) -> str:
    return str(result["command"]).split()[4]


def _holes(result: Result) -> list[str]:
    holes = [f"{row['target']}: {hole}" for row in result.get("targets", ()) for hole in row["holes"]]
    return holes + [f"{row['road']}, {row['bomb']}: {row['hole']}" for row in result.get("pairs", ()) if row["hole"]]


def report(result: Result) -> str:
    """The tables of the attack, and every hole."""
    return "\n".join([*attack_tables(_attack(result), result), *(f"HOLE: {hole}" for hole in _holes(result))])


def verdict(result: Result) -> None:
    """Raises SafedpaError where the attack succeeded."""
    if not result["held"]:
        holes = _holes(result)
        reason = f"{len(holes)} holes" if holes else "it did not hold"
        raise SafedpaError(f"hostile: {_attack(result)}: {reason}; see above")
