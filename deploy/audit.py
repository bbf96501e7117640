"""Asks for known holes in what is pinned: ``python deploy/audit.py PIP-AUDIT FILE...``.

Exit code 0: no hole, or only waived ones; 1: a hole that is not waived, or a waiver that has ended or covers nothing;
3: the index answered for no package, so nothing is known. ``deploy/waivers.toml`` lists the waivers.
"""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

WAIVERS = Path(__file__).with_name("waivers.toml")
_FIELDS = {"id": str, "package": str, "reason": str, "until": datetime.date}
CLEAN, HOLES, UNKNOWN = 0, 1, 3


def waivers_of(text: str) -> list[dict[str, Any]]:
    """Returns the waivers; raises ValueError if one lacks a field or has a field of another type."""
    found: list[dict[str, Any]] = tomllib.loads(text).get("waiver", [])
    for waiver in found:
        if set(waiver) != set(_FIELDS) or any(type(waiver[name]) is not kind for name, kind in _FIELDS.items()):
            raise ValueError(f"waivers.toml: got {waiver}, wanted id, package, reason and until (a date)")
    return found


def judge(audited: list[dict[str, Any]], waivers: list[dict[str, Any]], today: datetime.date) -> tuple[int, list[str]]:
    """Returns the exit code and a sentence for each finding.

    :param audited: the ``dependencies`` of pip-audit's report
    """
    answered = [one for one in audited if "vulns" in one]
    if not answered:
        return UNKNOWN, ["the index answered for no package: nothing is known about holes"]
    valid = {(one["package"].lower(), one["id"]): one for one in waivers if one["until"] >= today}
    code, lines, used = CLEAN, [], set()
    for one in answered:
        for hole in one["vulns"]:
            names = {hole["id"], *hole.get("aliases", ())}
            key = next((pair for name in names if (pair := (one["name"].lower(), name)) in valid), None)
            used |= {key}
            text = f"{one['name']} {one['version']}: {hole['id']}, fixed in {', '.join(hole['fix_versions']) or 'none'}"
            lines.append(text if key is None else f"{text} (waived: {valid[key]['reason']})")
            code = max(code, HOLES if key is None else CLEAN)
    for waiver in waivers:
        if (waiver["package"].lower(), waiver["id"]) not in used:
            code = HOLES
            lines.append(f"waiver of {waiver['package']} {waiver['id']}: has ended or covers nothing; remove it")
    unknown = len(audited) - len(answered)
    return code, lines + ([f"{unknown} packages could not be looked up"] if unknown else [])


def main(program: str, files: list[str]) -> int:
    """Audits requirement files; prints the findings and returns the exit code."""
    found: list[dict[str, Any]] = []
    for file in files:
        with tempfile.NamedTemporaryFile(suffix=".json") as report:
            command = [program, "--requirement", file, "--no-deps", "--disable-pip", "--progress-spinner", "off"]
            subprocess.run([*command, "--format", "json", "--output", report.name], capture_output=True, check=False)
            content = Path(report.name).read_text(encoding="utf-8")
            found += json.loads(content)["dependencies"] if content else []
    code, lines = judge(found, waivers_of(WAIVERS.read_text(encoding="utf-8")), datetime.date.today())
    for line in lines:
        print(f"audit: {line}")  # noqa: T201
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
