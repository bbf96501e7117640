"""All attacks, or some of them, over any number of processes; with what is needed to run them again."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import safedpa
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result
from safedpa_lab.experiments.adversary.bad_inputs import BadInputs
from safedpa_lab.experiments.adversary.bends import Bends
from safedpa_lab.experiments.adversary.car_grid import CarGrid
from safedpa_lab.experiments.adversary.drives import Drives
from safedpa_lab.experiments.adversary.late_drives import LateDrives
from safedpa_lab.experiments.adversary.mirrors import Mirrors
from safedpa_lab.experiments.adversary.peers import Peers
from safedpa_lab.experiments.adversary.programs import Programs
from safedpa_lab.experiments.adversary.scales import Scales
from safedpa_lab.experiments.adversary.standing import Standing
from safedpa_lab.experiments.adversary.systems import Systems
from safedpa_lab.experiments.car_workers import Workers

__all__ = ["adversary", "all_attacks", "attacks_named", "digest_of_code"]

ReportProgress = Callable[[int, int], None]
Keep = Callable[[dict[str, Any]], None]


def all_attacks(interpreters: Sequence[str] = ()) -> list[AbstractAttack]:
    """Every attack, the quick ones first; peers are looked for in these Pythons, and in this one."""
    problems = (BadInputs(), Scales(), Systems(), Bends(), Mirrors(), CarGrid(), Programs())
    return [*problems, Drives(), LateDrives(), Standing(), Peers(interpreters)]


def attacks_named(names: Sequence[str], interpreters: Sequence[str] = ()) -> list[AbstractAttack]:
    """Those of these names, or all; raises InputError for a name that there is not."""
    attacks = {attack.name: attack for attack in all_attacks(interpreters)}
    for name in names:
        if name not in attacks:
            raise InputError(f"--only: got '{name}'; {did_you_mean(name, list(attacks))}")
    return [attack for name, attack in attacks.items() if not names or name in names]


def adversary(
    attacks: Sequence[AbstractAttack],
    seed: int,
    small: bool = False,
    workers: int = 1,
    report_progress: ReportProgress = lambda _done, _all: None,
    keep: Keep = lambda _found: None,
) -> dict[str, Any]:
    """Runs the attacks and tells what they found, whatever it is.

    ``tell(done, all)`` after each piece of work; ``keep(found)`` after each attack, with all that was found so far, so
    that nothing is lost where someone ends a run of hours.
    """
    pieces = [attack.pieces(seed, small) for attack in attacks]
    everything, done = sum(map(len, pieces)), 0
    result: dict[str, Any] = {
        "experiment": "adversary",
        "date": time.strftime("%Y-%m-%d"),
        "seed": seed,
        "small": small,
        "code": digest_of_code(),
        "attacks": [],
    }
    with Workers(workers) as pool:
        for attack, own in zip(attacks, pieces, strict=True):
            began, answers = time.perf_counter(), []
            for answer in pool.map(attack.work, own):
                answers.append(answer)
                done += 1
                report_progress(done, everything)
            result["attacks"].append(_reported(attack, attack.reported(answers), time.perf_counter() - began))
            keep(result)
    return result


def digest_of_code() -> str:
    """Twelve digits that change with any source of the library or of the attacks."""
    summed = hashlib.sha256()
    assert safedpa.__file__ is not None
    for root in (Path(safedpa.__file__).parent, Path(__file__).parent):
        for path in sorted(root.rglob("*.py")):
            summed.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return summed.hexdigest()[:12]


def _reported(attack: AbstractAttack, result: Result, seconds: float) -> dict[str, Any]:
    rows = [row.as_dict() for row in result.rows]
    return {
        "name": attack.name,
        "sentence": attack.sentence,
        "seconds": round(seconds, 1),
        "held": sum(row["held"] is True for row in rows),
        "failed": sum(row["held"] is False for row in rows),
        "rows": rows,
        "worst": list(result.worst),
    }
