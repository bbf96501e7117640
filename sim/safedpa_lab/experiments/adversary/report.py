"""What the attacks found, as Markdown and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

__all__ = ["adversary_markdown", "write_adversary"]


def write_adversary(result: dict[str, Any], out: Path) -> None:
    """``adversary.json`` and ``adversary.md`` in the folder."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "adversary.json").write_text(json.dumps(result, indent=1, default=float) + "\n", encoding="utf-8")
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
