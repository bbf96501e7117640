"""``safedpa experiment demo``: the demonstration over many scenes; does it end well in each?"""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.provenance.record import write_result
from safedpa_services.lines import print_plain

__all__ = ["command", "judged"]

_WANTED_FALL, _WANTED_WAY, _LONGEST_UNSAID = 0.6, 5.0, 10.0
"""Of the error; m driven in the 20 s after the model was changed; s for which a robot may stand without a word."""
_PATIENCE = 300.0
"""s for one drive, on a busy machine."""
_STEPS = ("found", "accepted", "fell", "drove_on", "notice", "all")


@click.command(name="demo")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="of the first scene")
@click.option("--drives", type=click.IntRange(1), default=20, show_default=True, help="scenes")
@click.option(
    "--beside", type=click.IntRange(1, 8), default=1, show_default=True, help="drives at a time, half a core each"
)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--recordings", type=click.Path(path_type=Path), default=Path("runs"), show_default=True, metavar="DIR")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """'safedpa demo --yes' in many scenes, in real time, each with processes of its own.

    Counted in each: a finding is raised; its effect accepted; the error falls by 60 % or more; the car drives 5 m or
    more in the 20 s afterwards; and at no time does it stand for more than 10 s without a word about it.
    """
    from safedpa_services.progress import progress

    out = options["out"]
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    seeds = range(options["seed"], options["seed"] + options["drives"])
    drives: list[dict[str, Any]] = []
    with progress("experiment demo") as report_progress, ThreadPoolExecutor(options["alongside"]) as pool:
        for drive in pool.map(partial(_drive, folder=options["recordings"]), seeds):
            drives.append(drive)
            report_progress(len(drives), len(seeds))
    result = {
        "experiment": "demo",
        "date": datetime.date.today().isoformat(),
        "seeds": [seeds.start, seeds.stop - 1],
        "alongside": options["alongside"],
        "wanted": {"fall": _WANTED_FALL, "way_after_m": _WANTED_WAY, "longest_stand_unsaid_s": _LONGEST_UNSAID},
        "drives": len(drives),
        **{step: sum(drive[step] for drive in drives) for step in _STEPS},
        "each": drives,
    }
    if out is not None:
        write_result(out, result)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _drive(seed: int, folder: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "safedpa_services", "demo", "--yes", "--headless", "--json"]
    command += ["--seed", str(seed), "--out", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE, check=False)
        return judged(json.loads(done.stdout))
    except subprocess.TimeoutExpired:
        failure = f"not over after {_PATIENCE:.0f} s"
    except json.JSONDecodeError:
        failure = done.stderr.strip().splitlines()[-1][:300] if done.stderr.strip() else "no word"
    return {"seed": seed, "failure": failure, **dict.fromkeys(_STEPS, False)}


def judged(reported: dict[str, Any]) -> dict[str, Any]:
    """The account of one demonstration, and which steps of it went as they should."""
    changed = reported["changed"]
    steps = {
        "found": reported["raised"] is not None and changed is not None and reported["raised"] >= changed,
        "accepted": reported["taken"] is not None,
        "fell": reported["fall"] is not None and reported["fall"] >= _WANTED_FALL,
        "drove_on": reported["way_after"] >= _WANTED_WAY,
        "notice": reported["longest_stand_unsaid"] <= _LONGEST_UNSAID,
    }
    retained = {name: value for name, value in reported.items() if name not in ("recording", "report", "picture")}
    return {**retained, **steps, "all": all(steps.values())}


def _report(result: dict[str, Any]) -> None:
    phrase = (
        "a finding raised",
        "its effect accepted",
        "error down by 60 %",
        "drove on",
        "no stand without a word",
        "all of it",
    )
    for step, word in zip(_STEPS, phrase, strict=True):
        click.echo(f"{word:24} {result[step]}/{result['drives']}")
    for drive in result["each"]:
        if not drive["all"]:
            missing = ", ".join(step for step in _STEPS[:-1] if not drive[step])
            print_plain(f"seed {drive['seed']}: not {missing}; {drive['failure']}")
