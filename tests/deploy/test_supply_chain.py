"""Everything that is installed is pinned with its hash; a known hole fails the audit unless it is waived for a time."""

import datetime
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "deploy"))

import audit  # noqa: E402
import check_hashes  # noqa: E402

TODAY = datetime.date(2026, 11, 29)
HOLE = {
    "name": "example",
    "version": "1.0",
    "vulns": [{"id": "PYSEC-1", "aliases": ["CVE-1"], "fix_versions": ["1.1"]}],
}
CLEAN = {"name": "other", "version": "2.0", "vulns": []}


def waiver(days: int, **changes: Any) -> dict[str, Any]:
    until = TODAY + datetime.timedelta(days)
    return {"id": "CVE-1", "package": "example", "reason": "not used", "until": until, **changes}


@pytest.mark.parametrize(
    ("audited", "waivers", "code"),
    [
        ([CLEAN], [], audit.CLEAN),
        ([CLEAN, HOLE], [], audit.HOLES),
        ([CLEAN, HOLE], [waiver(0)], audit.CLEAN),
        ([CLEAN, HOLE], [waiver(-1)], audit.HOLES),
        ([CLEAN, HOLE], [waiver(9, package="other")], audit.HOLES),
        ([CLEAN], [waiver(9)], audit.HOLES),
        ([{"name": "other", "skip_reason": "not found"}], [], audit.UNKNOWN),
    ],
)
def test_a_known_hole_fails_unless_a_waiver_that_has_not_ended_names_it(audited, waivers, code) -> None:
    assert audit.judge(audited, waivers, TODAY)[0] == code


def test_a_waiver_needs_a_reason_and_an_end() -> None:
    assert audit.waivers_of((ROOT / "deploy" / "waivers.toml").read_text(encoding="utf-8")) == []
    with pytest.raises(ValueError, match="wanted id, package, reason and until"):
        audit.waivers_of('[[waiver]]\nid = "CVE-1"\npackage = "example"\nreason = "not used"')


def test_every_pinned_package_has_hashes_and_everything_that_is_installed_is_pinned() -> None:
    pinned = {line.strip() for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()}
    names = {re.sub(r"[-_.]+", "-", line.partition("==")[0]).lower() for line in pinned}
    hashed = check_hashes.listed([path.read_text(encoding="utf-8") for path in check_hashes.LISTS])
    assert {name for name, _ in hashed} == names
    command = [sys.executable, "-m", "pip", "list", "--format", "freeze", "--disable-pip-version-check"]
    installed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    found = {re.sub(r"[-_.]+", "-", line.partition("==")[0]).lower() for line in installed}
    assert found - names <= {"pip", "safedpa", "safedpa-lab"}, "pip is the one that Python brings"


def test_every_package_that_a_tool_or_the_build_names_is_pinned_exactly() -> None:
    tools = (ROOT / "deploy" / "tools.in").read_text(encoding="utf-8").splitlines()
    assert all(re.fullmatch(r"[a-z-]+==[0-9.]+", line) for line in tools if line and not line.startswith("#"))
    for path in (ROOT / "pyproject.toml", ROOT / "sim" / "pyproject.toml"):
        for line in re.findall(r"^requires = \[(.+)\]", path.read_text(encoding="utf-8"), re.MULTILINE):
            assert all("==" in name for name in line.split(",")), line
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    direct = [line for line in makefile.splitlines() if "-m pip install" in line and "/constraints/" not in line]
    assert all("--constraint" in line or "--require-hashes" in line for line in direct), direct


def test_another_file_than_the_listed_one_is_reported() -> None:
    def report(version: str, digest: str, url: str = "https://index.example/an_example.whl") -> dict[str, Any]:
        download = {"archive_info": {"hashes": {"sha256": digest}}, "url": url}
        return {"install": [{"download_info": download, "metadata": {"name": "An_Example", "version": version}}]}

    allowed = check_hashes.listed([f"an-example==1.0 \\\n    --hash=sha256:{'a' * 64}\n"])
    assert check_hashes.problems(report("1.0", "a" * 64), allowed) == []
    assert "is not listed" in check_hashes.problems(report("1.0", "b" * 64), allowed)[0]
    assert "not listed; wanted" in check_hashes.problems(report("1.1", "a" * 64), allowed)[0]
    assert check_hashes.problems(report("1.1", "b" * 64, "file:///wheels/an_example.whl"), allowed) == []
    editable = {"install": [{"download_info": {"dir_info": {}}, "metadata": {"name": "safedpa", "version": "0"}}]}
    assert check_hashes.problems(editable, allowed) == []
