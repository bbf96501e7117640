"""Every experiment whose figures the pages quote, one after the other, each in a process of its own.

What was made by the code of today is not made again: a run that was cut off goes on where it stood.
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

from safedpa.errors import InputError, did_you_mean
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.experiments.car_family import FAMILIES
from safedpa_lab.provenance.check import Standing, standings

__all__ = ["ELSEWHERE", "PARTS", "Part", "chosen", "is_made", "make"]

_ACCOUNT: Final = "all.json"
_LAST_TEXT: Final = 500


@final
@dataclass(frozen=True)
class Part:
    """One command ``safedpa experiment ...`` whose result stands in one file."""

    name: str
    phrase: tuple[str, ...]
    """After ``safedpa experiment``."""
    small: tuple[str, ...]
    """Options that make it short: to see that it runs, no more."""
    minutes: float
    """That two cores need for it, roughly; what it took stands in the account."""
    file: str = ""
    """Its result within the folder that it is told; empty: it is told a file."""
    where: str = "--out"
    data: bool = False
    """Whether it needs the recordings of ``--data``."""
    models: str = ""
    """Folder of models that do not ship, which it needs."""
    training: str = ""
    """The command that makes them."""

    def result(self, out: Path) -> Path:
        """The file of its result below the folder of all."""
        return out / self.name / self.file if self.file else out / self.name / f"{self.name}.json"

    def command(self, out: Path, data: Path | None, *, small: bool) -> list[str]:
        """As one types it, after ``safedpa``."""
        place = out / self.name if self.file else self.result(out)
        phrase = ["experiment", *self.phrase, *(self.small if small else ()), self.where, str(place)]
        return [*phrase, "--data", str(data)] if self.data and data is not None else phrase


PARTS: Final = (
    Part("safety", ("safety",), ("--seeds", "1", "--seconds", "1"), 12),
    Part("safety-pays", ("safety-pays",), ("--seeds", "1", "--seconds", "1", "--drives", "2"), 15),
    Part("controllers", ("controllers",), ("--seeds", "1", "--seconds", "1", "--controller", "goal_seeker"), 10),
    Part("differential-drive", ("differential-drive", "--first-seed", "100"), ("--drives", "1", "--seconds", "1"), 10),
    Part(
        "sensing",
        (
            "sensing",
            "--seeds",
            "5",
            "--first-seed",
            "3500",
            "--seconds",
            "20",
            "--no-peers",
            *tuple(word for load in ("none", "box", "chair", "large_chair") for word in ("--load", load)),
        ),
        ("--seeds", "1", "--seconds", "1", "--scene", "pillars"),
        40,
    ),
    Part(
        "steps-out",
        (
            "sensing",
            "--seeds",
            "100",
            "--first-seed",
            "3400",
            "--seconds",
            "12",
            "--no-peers",
            "--not-told",
            "--scene",
            "steps-out",
        ),
        ("--seeds", "1", "--seconds", "1"),
        25,
    ),
    Part(
        "sensing-minute",
        (
            *("sensing", "--seeds", "34", "--first-seed", "5100", "--seconds", "60", "--no-peers", "--not-told"),
            *tuple(word for scene in ("pillars", "people", "rooms") for word in ("--scene", scene)),
            *tuple(word for load in ("none", "box", "chair", "large_chair") for word in ("--load", load)),
        ),
        ("--seeds", "1", "--seconds", "1"),
        60,
    ),
    Part(
        "sensing-peers",
        ("sensing", "--seeds", "4", "--first-seed", "5100", "--not-told"),
        ("--seeds", "1", "--seconds", "1", "--scene", "pillars"),
        5,
    ),
    Part(
        "sensing-curves",
        ("sensing-curves", "--seeds", "8", "--first-seed", "4900"),
        ("--seeds", "1", "--seconds", "1"),
        10,
    ),
    Part(
        "sensing-margins",
        ("sensing-margins",),
        ("--drives", "2", "--fresh", "1", "--seconds", "1", "--coverage", "0.6"),
        20,
    ),
    Part(
        "meeting",
        ("meeting", "--seeds", "3", "--first-seed", "4700", "--seconds", "20"),
        ("--robots", "2", "--seeds", "1", "--seconds", "1"),
        15,
    ),
    Part("adversary", ("adversary", "--seed", "2000"), ("--small",), 45, "adversary.json"),
    Part("margins", ("margins",), ("--robot", "pendulum", "--drives", "2", "--fresh", "2"), 90, "margins.json"),
    Part("tuning", ("tuning",), ("--small", "--drives", "2", "--row", "shipped"), 30, "tuning.json"),
    Part("tuning-real", ("tuning", "--part", "real"), ("--small",), 10, "tuning.json", data=True),
    Part("theory", ("theory", "car_learned"), ("--states", "2000"), 2),
    Part("car", ("car",), ("--episodes", "1", "--part", "table", "--load", "none"), 15, "car.json"),
    Part(
        "car-paper",
        ("car", "--family", "paper"),
        ("--episodes", "1", "--part", "table", "--load", "none"),
        15,
        "car.json",
        models=str(FAMILIES["paper"].models),
        training=FAMILIES["paper"].training,
    ),
    Part(
        "car-planner",
        ("car", "--family", "paper", "--method", "safedpa", "--method", "planner", "--part", "table"),
        ("--episodes", "1", "--load", "none"),
        10,
        "car.json",
        models=str(FAMILIES["paper"].models),
        training=FAMILIES["paper"].training,
    ),
    Part(
        "car-curves",
        ("car-curves",),
        ("--episodes", "1", "--drives", "1", "--sweep", "friction", "--method", "safedpa"),
        40,
        "car-curves.json",
    ),
    Part(
        "car-curves-paper",
        ("car-curves", "--family", "paper"),
        ("--episodes", "1", "--drives", "1", "--sweep", "friction", "--method", "safedpa"),
        40,
        "car-curves.json",
        models=str(FAMILIES["paper"].models),
        training=FAMILIES["paper"].training,
    ),
    Part(
        "pendulum",
        ("pendulum", "--seed", "2100"),
        ("--directions", "2", "--episodes", "1", "--sweep-episodes", "0", "--drives", "4"),
        6,
        "pendulum.json",
    ),
    Part("pendulum-story", ("pendulum-story",), ("--directions", "1", "--episodes", "1"), 6, "pendulum-story.json"),
    Part(
        "point",
        ("point", "--seed", "2300", "--episodes", "8"),
        ("--quick", "--methods", "unfiltered"),
        60,
        "point.json",
    ),
    Part("point-heat-map", ("point-heat-map", "--moments", "480"), ("--moments", "2"), 5, "point-heat-map.json"),
    Part("point-learning", ("point-learning",), ("--quick", "--starts", "shipped"), 90, "point-learning.json"),
    Part(
        "point-relinearised",
        ("point-relinearised", "--episodes", "1", "--steps", "250", "--drive-steps", "40", "--car", "600000"),
        ("--quick", "--drives", "99", "--car", "4096"),
        10,
        "relinearised.json",
    ),
    Part("point-story", ("point-story",), ("--robots", "2", "--seconds", "1"), 5, "point-story.json"),
    Part("hidden-effects", ("hidden-effects", "--seed", "7002"), ("--cases", "1", "--suite", "ordinary"), 240),
    Part("live", ("live",), ("--case", "hitch", "--drives", "1", "--after", "5"), 60),
    Part(
        "fleet-diagnosis",
        ("fleet-diagnosis", "--robots", "60", "--seed", "2026"),
        ("--robots", "2", "--runs", "2", "--seconds", "10"),
        5,
        where="--record",
    ),
    Part("real-logs", ("real-logs",), ("--part", "balls"), 10, data=True),
    Part("faults", ("faults", "--seed", "9"), ("--small",), 20, "faults.json"),
    Part("ros", ("ros", "--drives", "100", "--seconds", "10"), ("--drives", "1", "--seconds", "2"), 40),
    Part("demo", ("demo",), ("--drives", "1"), 40),
    *(
        Part(
            f"hostile-{attack}",
            ("hostile", "--attack", attack, *(("--seconds", "3600") if attack == "mutations" else ())),
            () if attack == "roads" else ("--seconds", "2"),
            minutes,
            "hostile.json",
            where="--page",
        )
        for attack, minutes in (("mutations", 60), ("roads", 3), ("offers", 2), ("silent", 2), ("flood", 2))
    ),
)


ELSEWHERE: Final = {
    "all": "this one",
    "bad-data": "spoils a log of one's own",
    "diagnosis-pictures": "draws pictures",
    "long-logs": "times one size of logs; docs/diagnosis-speed.md has the sizes",
}
"""Experiments without a file of results that a page quotes, and why."""


def chosen(names: Sequence[str], data: Path | None) -> list[Part]:
    """The parts of these names, all without any; those that need recordings or models only where there are some.

    Raises InputError for a name that there is not, or one that needs recordings or models without these.
    """
    known = {part.name: part for part in PARTS}
    for name in names:
        if name not in known:
            raise InputError(f"--only {name}: {did_you_mean(name, known)}")
        if known[name].data and data is None:
            raise InputError(f"--only {name}: got no --data, wanted the folder of the recordings that it reads")
        if not _is_trained(known[name]):
            raise InputError(f"--only {name}: no {known[name].models}; '{known[name].training}' makes it")
    wanted = [known[name] for name in names] if names else list(PARTS)
    return [part for part in wanted if (data is not None or not part.data) and _is_trained(part)]


def _is_trained(part: Part) -> bool:
    return not part.models or Path(part.models).is_dir()


def is_made(part: Part, out: Path, account: Mapping[str, Any], *, small: bool) -> bool:
    """Whether its result is there, whole, of this size, and made by the code of today."""
    reported, path = account.get(part.name), part.result(out)
    if not isinstance(reported, dict) or reported.get("exit_code") != 0 or reported.get("small") is not small:
        return False
    return path.is_file() and all(_of_today(found) for found in standings(path.parent) if found.name == path.name)


def make(
    parts: Sequence[Part],
    out: Path,
    data: Path | None = None,
    *,
    small: bool = False,
    report_progress: Callable[[Part, str], None] = lambda _part, _message: None,
) -> dict[str, Any]:
    """Runs what is not made yet, and returns the account: of each part what it took [s] and its exit code.

    The account is kept in ``all.json`` after every part. A part that fails does not keep the others from running.
    """
    account = _read(out / _ACCOUNT)
    for part in parts:
        if is_made(part, out, account, small=small):
            report_progress(part, "made before, by the code of today")
            continue
        report_progress(part, f"runs; about {1.0 if small else part.minutes:g} minutes")
        account[part.name] = reported = _run(part, out, data, small=small)
        _write(out / _ACCOUNT, account)
        phrase = (
            f"done in {reported['seconds']:.0f} s"
            if reported["exit_code"] == 0
            else f"failed: {reported['last_words']}"
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
    last = log.read_text(errors="replace").strip().splitlines()[-1:] or ["it said nothing"]
    if code == 0 and not part.result(out).is_file():
        code, last = 1, [f"it left no {part.result(out).name}"]
    reported = {"seconds": round(seconds, 1), "exit_code": code, "small": small}
    return reported if code == 0 else {**reported, "last_text": last[0][:_LAST_TEXT]}


def _of_today(found: Standing) -> bool:
    return found.rooms > 0 and not found.changed


def _read(path: Path) -> dict[str, Any]:
    """What is kept there; nothing where it is no such account: then all is made again."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _write(path: Path, account: Mapping[str, Any]) -> None:
    with atomic_path(path) as unfinished:
        unfinished.write_text(json.dumps(account, indent=1) + "\n", encoding="utf-8")
