"""All attacks, or some of them, over any number of processes; with what is needed to run them again."""

from __future__ import annotations

import hashlib
import json
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
from safedpa_lab.experiments.adversary.drives import Drives, LateDrives, Standing
from safedpa_lab.experiments.adversary.mirrors import Mirrors
from safedpa_lab.experiments.adversary.peers import Peers
from safedpa_lab.experiments.adversary.programs import Programs
from safedpa_lab.experiments.adversary.scales import Scales
from safedpa_lab.experiments.adversary.systems import Systems
from safedpa_lab.experiments.common.workers import Progress, Workers
from safedpa_lab.experiments.record import Options, ReportProgress, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.provenance.record import write_result

_SAME = ("experiment", "seed", "small", "code")


def with_parts_before(result: dict[str, Any], out: Path, order: Sequence[str]) -> dict[str, Any]:
    """With the attacks that were run into the folder before by the same code on the same seed, in the order given.

    What was run again takes the place of what was there. Results of other code, seed or size are not looked at.
    """
    path = out / "adversary.json"
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if any(before.get(key) != result[key] for key in _SAME):
        return result
    parts = {part["name"]: part for part in (*before["attacks"], *result["attacks"])}
    return result | {"attacks": [parts[name] for name in order if name in parts]}


def write_adversary(result: dict[str, Any], out: Path) -> None:
    """``adversary.json`` and ``adversary.md`` in the folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "adversary.json", result)
    (out / "adversary.md").write_text(adversary_markdown(result), encoding="utf-8")


def adversary_markdown(result: dict[str, Any]) -> str:
    """One table per attack: measured values, their limits, and whether they were met."""
    size = ", small sizes" if result["small"] else ""
    command = f"`{result['command']}`, " if "command" in result else ""
    parts = [f"{command}{result['date']}, seed {result['seed']}{size}, digest of the code {result['code']}."]
    for attack in result["attacks"]:
        about = (
            f"## {attack['name']}\n\n{attack['sentence'][:1].upper()}{attack['sentence'][1:]}. {attack['held']} of "
            f"{attack['held'] + attack['failed']} figures are as asked ({attack['seconds']:g} s)."
        )
        parts.append(markdown_table("what | measured | of | asked |", map(_line, attack["rows"]), above=about))
    return "\n\n".join(parts) + "\n"


def _line(row: dict[str, Any]) -> str:
    held = {True: "held", False: "**not held**", None: ""}[row["held"]]
    measured = f"{row['measured']:.6g} {row['unit']}".strip()
    return (
        f"{row['what']} | {measured} | {'' if row['of'] is None else format(row['of'], ',')} | {row['asked']} | {held}"
    )


Keep = Callable[[dict[str, Any]], None]


def all_attacks(interpreters: Sequence[str] = ()) -> list[AbstractAttack]:
    """Every attack, the quick ones first; peers are searched in these Python interpreters, and in this one."""
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
    report_progress: ReportProgress = silent,
    keep: Keep = lambda _found: None,
) -> dict[str, Any]:
    """Runs the attacks and returns their results.

    Progress is reported after each piece of work; ``keep(found)`` is called after each attack, with all that was found
    so far, so that nothing is lost where someone ends a run of hours.
    """
    pieces = [attack.pieces(seed, small) for attack in attacks]
    progress = Progress(sum(map(len, pieces)), report_progress)
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
                progress.advance()
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


def listing(options: Options) -> list[str]:
    """One line per attack."""
    return [f"{attack.name:12}{attack.sentence}" for attack in attacks_named(options["only"], options["peers"])]


def run(options: Options, report_progress: ReportProgress) -> dict[str, Any]:
    """Runs ``safedpa experiment adversary``; the result so far is written after each attack."""
    everything, out = [attack.name for attack in all_attacks()], options["out"]

    def whole(found: dict[str, Any]) -> dict[str, Any]:
        if out is not None:
            found = with_parts_before(found, out, everything)
        names = [part["name"] for part in found["attacks"]]
        return {"command": _command(options, () if names == everything else names), **found}

    def keep(found: dict[str, Any]) -> None:
        if out is not None:
            write_adversary(whole(found), out)

    attacks = attacks_named(options["only"], options["peers"])
    return whole(adversary(attacks, options["seed"], options["small"], options["workers"], report_progress, keep))


def _command(options: Options, names: Sequence[str]) -> str:
    only = "".join(f" --only {name}" for name in names)
    return f"safedpa experiment adversary{only}{' --small' if options['small'] else ''} --seed {options['seed']}"
