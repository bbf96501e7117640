"""What the attacks found, as Markdown and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from safedpa_lab.provenance.record import write_result

__all__ = ["adversary_markdown", "with_parts_before", "write_adversary"]

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
    """One table for each attack: what was asked, what was measured, and whether it held."""
    size = ", small sizes" if result["small"] else ""
    command = f"`{result['command']}`, " if "command" in result else ""
    parts = [f"{command}{result['date']}, seed {result['seed']}{size}, digest of the code {result['code']}.\n"]
    for attack in result["attacks"]:
        parts.append(
            f"## {attack['name']}\n\n{attack['sentence'][:1].upper()}{attack['sentence'][1:]}. {attack['held']} of "
            f"{attack['held'] + attack['failed']} figures are as asked ({attack['seconds']:g} s).\n"
        )
        parts.append("| what | measured | of | asked | |\n|---|---|---|---|---|")
        parts += [_line(row) for row in attack["rows"]]
        parts.append("")
    return "\n".join(parts)


def _line(row: dict[str, Any]) -> str:
    held = {True: "held", False: "**not held**", None: ""}[row["held"]]
    measured = f"{row['measured']:.6g} {row['unit']}".strip()
    of = "" if row["of"] is None else f"{row['of']:,}"
    return f"| {row['what']} | {measured} | {of} | {row['asked']} | {held} |"
