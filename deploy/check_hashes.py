"""Compares what pip installed with the pinned hashes: ``python deploy/check_hashes.py REPORT...``.

A report is what ``pip install --report REPORT`` writes. The hashes are those of ``constraints-hashes.txt``. Folders and
files of this machine are not compared. Ends with exit code 1 if a downloaded package is not listed, or its file is
another one than listed.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LISTS = (ROOT / "constraints-hashes.txt",)
_PINNED = re.compile(r"^([A-Za-z0-9._-]+)==([^ \\]+)((?: \\\n +--hash=sha256:[0-9a-f]{64})+)", re.MULTILINE)


def listed(texts: list[str]) -> dict[tuple[str, str], set[str]]:
    """Returns the allowed SHA-256 hashes by name and version."""
    found: dict[tuple[str, str], set[str]] = {}
    for text in texts:
        for name, version, hashes in _PINNED.findall(text):
            found.setdefault((_plain(name), version), set()).update(re.findall(r"sha256:([0-9a-f]{64})", hashes))
    return found


def problems(report: dict[str, Any], allowed: dict[tuple[str, str], set[str]]) -> list[str]:
    """Returns a sentence for each package of a report that is not one of the allowed files."""
    found = []
    for package in report["install"]:
        download, about = package["download_info"], package["metadata"]
        # The owner of a machine decides which files lie on it, such as a build of torch for the processor alone.
        if "dir_info" in download or download["url"].startswith("file:"):
            continue
        name, version = _plain(about["name"]), about["version"]
        archive = download.get("archive_info", {})
        digest = archive.get("hashes", {}).get("sha256") or archive.get("hash", "").removeprefix("sha256=")
        if (name, version) not in allowed:
            found.append(f"{name} {version}: not listed; wanted a version of constraints.txt, or run 'make hashes'")
        elif digest not in allowed[name, version]:
            found.append(f"{name} {version}: got SHA-256 {digest or 'unknown'}, which is not listed")
    return found


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def main(reports: list[str]) -> int:
    """Prints the problems of all reports; returns the exit code."""
    allowed = listed([path.read_text(encoding="utf-8") for path in LISTS])
    found = [line for path in reports for line in problems(json.loads(Path(path).read_text(encoding="utf-8")), allowed)]
    for line in found:
        print(f"hashes: {line}", file=sys.stderr)  # noqa: T201
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
