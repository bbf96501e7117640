"""Whoever has the oldest Python that is promised can install all that is pinned."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

from packaging.specifiers import SpecifierSet

PROJECTS = ("pyproject.toml", "sim/pyproject.toml")


def _pinned(repository: Path) -> dict[str, str]:
    lines = (repository / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(re.findall(r"^([\w.-]+)==([\w.]+)$", "\n".join(lines), re.MULTILINE))


def test_every_pinned_package_takes_the_oldest_python(repository: Path) -> None:
    """One wanted 3.11.5 at least, and Debian 12, whose Python is 3.11.2, could make no environment."""
    projects = [tomllib.loads((repository / name).read_text(encoding="utf-8")) for name in PROJECTS]
    (promised,) = {project["project"]["requires-python"] for project in projects}
    oldest = promised.removeprefix(">=") + ".0"
    assert re.fullmatch(r"3\.\d+\.0", oldest)
    looked_at, refused = 0, []
    for name, version in _pinned(repository).items():
        try:
            about = metadata(name)
        except PackageNotFoundError:  # of an extra that is not installed here
            continue
        if about["Version"].split("+")[0] != version:
            refused.append(f"{name} {about['Version']} is installed, and {version} pinned")
        wanted = about.get("Requires-Python") or ""
        looked_at += 1
        if not SpecifierSet(wanted).contains(oldest):
            refused.append(f"{name} {version} wants Python {wanted}, promised is {promised}")
    assert looked_at > 60
    assert refused == []
