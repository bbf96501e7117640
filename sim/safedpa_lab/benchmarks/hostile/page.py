"""What the attacks came to, as one JSON file and one page; each attack keeps its place until it is measured again."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa_lab.provenance.record import write_result

_TITLES = {
    "offers": "Eight robots in real time, and models offered that take long to read",
    "silent": "A whole drive with 1024 descriptors, and a thousand silent connections",
    "flood": "A robot, and a flood with a stolen key",
    "mutations": "Mutated input",
    "roads": "Bombs on every road that a file takes",
}


def write_page(folder: Path, attack: str, result: Mapping[str, Any]) -> None:
    """Writes hostile.json and hostile.md in ``folder``. Raises InputError when they cannot be read or written."""
    file = folder / "hostile.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        found[attack] = result
        write_result(file, found)
        (folder / "hostile.md").write_text(_page(found), encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"--page {folder}: {error}; choose another folder") from error


def _page(found: Mapping[str, Any]) -> str:
    lines = ["# Hostile input, measured", "", "What is tried, and what stops it: [security](../../guides/security.md)."]
    for attack, title in _TITLES.items():
        if attack in found:
            result = found[attack]
            held = "**It held.**" if result["held"] else "**It did not hold.**"
            lines += ["", f"## {title}", "", f"`{result['command']}`, {result['date']}, {_load(result)}. {held}", ""]
            lines += attack_tables(attack, result)
    return "\n".join(lines) + "\n"


def attack_tables(attack: str, result: Mapping[str, Any]) -> list[str]:
    """The lines of the tables of one kind of attack."""
    return _TABLES[attack](result)


def _load(result: Mapping[str, Any]) -> str:
    before, after = result["load_average"]
    return f"{result['cores']} cores, load of the machine {before} at the beginning, {after} at the end"


def _table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> list[str]:
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join("-" if cell is None else str(cell) for cell in line) + " |" for line in lines]


def _offers(result: Mapping[str, Any]) -> list[str]:
    found = result["offers"]
    stretches = {"in peace": found["in_peace"], "under attack": found["under_attack"]}
    late = _table(
        ("", "s", "robot-ticks", "late", "of these by the machine", "sense to act, ms: p50", "p99", "most"),
        (
            (
                name,
                *(row.get(key) for key in ("seconds", "robot_ticks", "late_ticks", "late_by_the_machine")),
                *row["sense_to_act_ms"].values(),
            )
            for name, row in stretches.items()
        ),
    )
    answers = _table(
        ("offer", "answers", "refused", "ms after the state of its tick: p50", "p99", "most"),
        (
            (name, row["answers"], row["refused"], *row["after_state_ms"].values())
            for name, row in found["answers"].items()
        ),
    )
    reported = (
        f"{found['offers']} offers in turn, one in 0.1 s, in every other five seconds of one drive. One that is too "
        "long is refused in the tick in which it is heard; the rest is tried apart, behind everybody else, and a newer "
        "offer to the same robot takes its place. A tick in which the attacker missed the state is not counted. By the "
        "machine: next to the fleet a loop on each core does nothing but wake up in time, before everything else; "
        "where it did not run for half a period either, the tick is late by the machine."
    )
    return [reported, "", *late, "", *answers]


def _silent(result: Mapping[str, Any]) -> list[str]:
    drives = {"in peace": result["in_peace"], "under attack": result["under_attack"]}
    return _table(
        ("", "exit code", "ticks", "braked by the watchdog", "collisions", "restarts", "joins", "slowest join, s"),
        (
            (
                name,
                *(row[key] for key in ("exit_code", "ticks", "watchdog_ticks", "collisions", "restarts", "joins")),
                row["slowest_join_seconds"],
            )
            for name, row in drives.items()
        ),
    )


def _flood(result: Mapping[str, Any]) -> list[str]:
    head = ("stolen", "messages a second", "MB a second", "s", "braked of it, s", "at a stretch", "before", "after")
    keys = (
        "flood", "messages_a_second", "megabytes_a_second", "flood_seconds", "braked_seconds", "longest_seconds",
        "before_seconds", "after_seconds",
    )  # fmt: skip
    about = (
        f"One drive of {result['periods']} periods, {result['collisions']} collisions. Braked: by the robot's watchdog "
        f"or by the filter for want of input; before and after: in {result['rest']:g} s each."
    )
    return [about, "", *_table(head, ([row[key] for key in keys] for row in result["rows"]))]


def _mutations(result: Mapping[str, Any]) -> list[str]:
    rows = result["targets"]
    return _table(
        ("target", "inputs", "refused", "slowest, ms", "holes"),
        ((row["target"], row["inputs"], row["refused"], row["worst_ms"], len(row["holes"])) for row in rows),
    )


def _roads(result: Mapping[str, Any]) -> list[str]:
    by_road: dict[str, list[Mapping[str, Any]]] = {}
    for row in result["pairs"]:
        by_road.setdefault(row["road"], []).append(row)
    about = (
        "Small files that ask for much, each to every command and option that reads a file of its kind. Refused: exit "
        "code 2, one line, at most 200 MiB and 2 s of the processor, nothing written. The command columns reads names "
        "alone, and may list them."
    )
    head = ("road", "bombs", "refused", "most processor time, s", "most memory, MiB")
    rows = (
        (
            road,
            len(own),
            sum(not row["hole"] for row in own),
            max(row["seconds"] for row in own),
            max(row["mebibytes"] for row in own),
        )
        for road, own in by_road.items()
    )
    return [about, "", *_table(head, rows)]


_TABLES = {"roads": _roads, "offers": _offers, "silent": _silent, "flood": _flood, "mutations": _mutations}
