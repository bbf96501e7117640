"""``safedpa experiment faults``: which faults to inject, the measurement, and its verdict."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

from safedpa.errors import InputError, SafedpaError
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.faults.campaign import run_faults
from safedpa_lab.faults.endurance import Resources, retained_by
from safedpa_lab.faults.table import all_faults, faults_for, faults_named, small_faults

__all__ = ["listing", "run", "verdict"]

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
