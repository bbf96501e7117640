"""Every experiment whose figures the pages quote, one after the other, each in a process of its own.

Results of the current code are not made again, so an interrupted run continues.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import click

from safedpa.errors import InputError, SafedpaError, did_you_mean
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.experiments.car.methods import FAMILIES, Family
from safedpa_lab.experiments.record import Experiment, Options, Parameter, ReportProgress, Result
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.experiments.table import EXPERIMENTS
from safedpa_lab.provenance.check import standings

_ACCOUNT: Final = "all.json"
_LAST_TEXT: Final = 500


@final
@dataclass(frozen=True)
class Part:
    """One command ``safedpa experiment ...`` whose result is one JSON file."""

    name: str
    minutes: float
    """Approximate time on two cores; the measured one is kept in ``all.json``."""
    arguments: str = ""
    """After ``safedpa experiment``. Default: the name alone."""
    small: str | None = None
    """Options of a short version. Default: those of the experiment."""
    data: bool = False
    """Whether it needs the recordings of ``--data``."""
    family: str = ""
    """Name of the family whose models, which are not shipped, it needs."""

    @property
    def phrase(self) -> str:
        """The command without ``safedpa experiment``."""
        return self.arguments or self.name

    @property
    def experiment(self) -> Experiment:
        """The experiment that it runs."""
        return EXPERIMENTS[self.phrase.split()[0]]

    @property
    def needs(self) -> Family | None:
        """The family whose models, which are not shipped, it needs."""
        return FAMILIES.get(self.family)

    def result(self, out: Path) -> Path:
        """The file of its result below the folder of all."""
        stem = (self.experiment.stem or self.experiment.name) if self._writes_folder else self.name
        return out / self.name / f"{stem}.json"

    def command(self, out: Path, data: Path | None, *, small: bool) -> list[str]:
        """The arguments after ``safedpa``."""
        path = self.result(out)
        extra = self.experiment.small if self.small is None else tuple(self.small.split())
        place = path.parent if self._writes_folder else path
        phrase = ["experiment", *self.phrase.split(), *(extra if small else ()), self._output.opts[0], str(place)]
        return [*phrase, "--data", str(data)] if self.data and data is not None else phrase

    @property
    def _output(self) -> Parameter:
        """The option that names the file or folder of the result."""
        by_kind = {each.writes: each for each in self.experiment.parameters if isinstance(each, Parameter)}
        return next(by_kind[kind] for kind in ("json", "folder", "records", "record") if kind in by_kind)

    @property
    def _writes_folder(self) -> bool:
        return self._output.writes in ("folder", "records")


_LOADS: Final = "--load none --load box --load chair --load large_chair"
PARTS: Final = (
    Part("safety", 12),
    Part("safety-pays", 15),
    Part("controllers", 10),
    Part("implausible-states", 90),
    Part("false-stops", 60),
    Part("long-drives", 15),
    Part("differential-drive", 10, "differential-drive --first-seed 100"),
    Part("sensing", 40, f"sensing --seeds 5 --first-seed 3500 --seconds 20 --no-peers {_LOADS}"),
    Part(
        "steps-out",
        25,
        "sensing --seeds 100 --first-seed 3400 --seconds 12 --no-peers --no-perfect-knowledge --scene steps-out",
        "--seeds 1 --seconds 1",
    ),
    Part(
        "sensing-minute",
        60,
        "sensing --seeds 34 --first-seed 5100 --seconds 60 --no-peers --no-perfect-knowledge "
        f"--scene pillars --scene people --scene rooms {_LOADS}",
        "--seeds 1 --seconds 1",
    ),
    Part("sensing-robots", 60, "sensing-robots --seeds 100 --first-seed 4000 --seconds 15", "--seeds 1 --seconds 1"),
    Part("sensing-peers", 5, "sensing --seeds 4 --first-seed 5100 --no-perfect-knowledge"),
    Part("sensing-curves", 10, "sensing-curves --seeds 8 --first-seed 4900"),
    Part("sensing-losses", 60, f"sensing-losses --seeds 10 --first-seed 7100 {_LOADS}", "--seeds 1 --seconds 1"),
    Part("sensing-margins", 20),
    Part("meeting", 15, "meeting --seeds 3 --first-seed 4700 --seconds 20"),
    Part("adversary", 45, "adversary --seed 2000"),
    Part("margins", 90),
    Part("tuning", 30),
    Part("tuning-real", 10, "tuning --part real", "--small", data=True),
    Part("theory", 2, "theory car_learned"),
    Part("car", 15),
    Part("car-paper", 15, "car --family paper", family="paper"),
    Part(
        "car-planner",
        10,
        "car --family paper --method safedpa --method planner --part table",
        "--episodes 1 --load none",
        family="paper",
    ),
    Part("car-curves", 40),
    Part("car-curves-paper", 40, "car-curves --family paper", family="paper"),
    Part("pendulum", 6, "pendulum --seed 2100"),
    Part("pendulum-story", 6),
    Part("point", 60, "point --seed 2300 --episodes 8"),
    Part("point-heat-map", 5, "point-heat-map --moments 480"),
    Part("point-learning", 90),
    Part("point-relinearised", 10, "point-relinearised --episodes 1 --steps 250 --drive-steps 40 --car 600000"),
    Part("point-story", 5),
    Part("hidden-effects", 240, "hidden-effects --seed 7002"),
    Part("own-robots", 120, "own-robots --seed 7003"),
    Part("live", 60),
    Part("fleet-diagnosis", 5, "fleet-diagnosis --robots 60 --seed 2026"),
    Part("real-logs", 10, data=True),
    Part("faults", 20, "faults --seed 9"),
    Part("ros", 40, "ros --drives 100 --seconds 10"),
    Part("demo", 40),
    Part("hostile-mutations", 60, "hostile --attack mutations --seconds 3600", "--seconds 2"),
    Part("hostile-roads", 3, "hostile --attack roads", ""),
    Part("hostile-offers", 2, "hostile --attack offers", "--seconds 2"),
    Part("hostile-silent", 2, "hostile --attack silent", "--seconds 2"),
    Part("hostile-flood", 2, "hostile --attack flood", "--seconds 2"),
)


ELSEWHERE: Final = {
    "all": "this one",
    "bad-data": "spoils a log of one's own",
    "data-faults": "reads spoiled logs; a test requires its counts",
    "diagnosis-pictures": "draws pictures",
    "state-limits": "measures the limits that ship in safedpa/safety/named_state_limits",
    "log-faults": "reads spoiled logs; tests require its counts",
    "full-disk": "mounts file systems; exit code 1 where a run fails",
    "long-logs": "times one size of logs; docs/evidence/speed.md has the sizes",
    "object-storage": "kills workers next to a local S3 server; exit code 1 where results are missing",
    "silences": "hangs processes in real time; exit code 1 where a place reports it too late",
    "soak": "an hour in real time; exit code 1 where a limit is exceeded",
}
"""Experiments whose results no page quotes, and why."""


def chosen(names: Sequence[str], data: Path | None) -> list[Part]:
    """The parts of these names, or all whose recordings and models are available.

    Raises InputError for an unknown name, or for a part whose recordings or models are missing.
    """
    known = {part.name: part for part in PARTS}
    for name in names:
        if name not in known:
            raise InputError(f"--only {name}: {did_you_mean(name, known)}")
        if known[name].data and data is None:
            raise InputError(f"--only {name}: got no --data, wanted the folder of the recordings that it reads")
        if (needs := known[name].needs) and not needs.models.is_dir():
            raise InputError(f"--only {name}: no {needs.models}; '{needs.training}' makes it")
    wanted = [known[name] for name in names] if names else list(PARTS)
    trained = [part for part in wanted if part.needs is None or part.needs.models.is_dir()]
    return [part for part in trained if data is not None or not part.data]


def is_made(part: Part, out: Path, account: Mapping[str, Any], *, small: bool) -> bool:
    """Whether its result exists, is complete, of this size, and made by the current code."""
    reported, path = account.get(part.name), part.result(out)
    if not isinstance(reported, dict) or reported.get("exit_code") != 0 or reported.get("small") is not small:
        return False
    own = (found for found in standings(path.parent) if found.name == path.name)
    return path.is_file() and all(found.is_current for found in own)


def make(
    parts: Sequence[Part],
    out: Path,
    data: Path | None = None,
    *,
    small: bool = False,
    report_progress: Callable[[Part, str], None] = lambda _part, _message: None,
) -> dict[str, Any]:
    """Runs the missing parts, and returns for each part its time [s] and exit code.

    This table is saved in ``all.json`` after every part. The other parts run even if one fails.
    """
    account = _read(out / _ACCOUNT)
    for part in parts:
        if is_made(part, out, account, small=small):
            report_progress(part, "is up to date")
            continue
        report_progress(part, f"runs; about {1.0 if small else part.minutes:g} minutes")
        account[part.name] = reported = _run(part, out, data, small=small)
        with atomic_path(out / _ACCOUNT) as unfinished:
            unfinished.write_text(json.dumps(account, indent=1) + "\n", encoding="utf-8")
        phrase = (
            f"done in {reported['seconds']:.0f} s" if reported["exit_code"] == 0 else f"failed: {reported['last_text']}"
        )
        report_progress(part, phrase)
    return {part.name: account[part.name] for part in parts}


def _run(part: Part, out: Path, data: Path | None, *, small: bool) -> dict[str, Any]:
    part.result(out).parent.mkdir(parents=True, exist_ok=True)
    log = out / f"{part.name}.log"
    began = time.monotonic()
    with log.open("wb") as phrase:
        command = [sys.executable, "-m", "safedpa_services", *part.command(out, data, small=small)]
        code = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=phrase, stderr=phrase, check=False).returncode
    seconds = time.monotonic() - began
    last = log.read_text(errors="replace").strip().splitlines()[-1:] or ["no output"]
    if code == 0 and not part.result(out).is_file():
        code, last = 1, [f"it wrote no {part.result(out).name}"]
    reported = {"seconds": round(seconds, 1), "exit_code": code, "small": small}
    return reported if code == 0 else {**reported, "last_text": last[0][:_LAST_TEXT]}


def _read(path: Path) -> dict[str, Any]:
    """The saved table; empty if the file is none: then everything is made again."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def listing(options: Options) -> list[str]:
    """One line per part, with its time."""
    del options
    return [f"{part.name:20} {part.minutes:5g} min  safedpa experiment {part.phrase}" for part in PARTS]


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment all``. Raises InputError without a folder for the results."""
    out, data = options["out"], options["data"]
    if out is None:
        raise InputError("experiment all: got no --out, wanted a folder for the results")
    if data is not None and not data.is_dir():
        raise InputError(f"--data {data}: got no folder, wanted that of the recordings")
    parts = chosen(options["only"], data)
    out.mkdir(parents=True, exist_ok=True)
    place = {part.name: number for number, part in enumerate(parts, 1)}

    def report_part(part: Part, notice: str) -> None:
        report_progress(place[part.name] - 1, len(parts))
        click.echo(f"{place[part.name]} of {len(parts)}: {part.name}: {notice}", err=True)

    return make(parts, out.absolute(), data, small=options["small"], report_progress=report_part)


def report(result: Result) -> str:
    """One row per part."""
    rows = (
        f"{name} | {row['seconds']:g} | {row['exit_code']} | {row.get('last_text', '')}"
        for name, row in result.items()
        if "exit_code" in row
    )
    return markdown_table("part | seconds | exit code | message", rows)


def verdict(result: Result) -> None:
    """Raises SafedpaError naming the parts that failed."""
    failed = [name for name, row in result.items() if row["exit_code"] != 0]
    if failed:
        raise SafedpaError(f"experiment all: {', '.join(failed)} failed; see their logs in the output folder")
