"""The command that looks for assertions that cannot fail finds each kind, and is silent about those that can."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

COMMAND = Path(__file__).parents[3] / "deploy" / "mutation" / "assertions.py"
CAN = """
import pytest
@pytest.mark.parametrize("number", [1, 2])
def test_it(number):
    few, none, stale = [1, 2], [], [3]
    assert few == [1, 2]
    assert len(few) > 1 and all(item > 0 for item in few)
    assert number == 1 or len(few) == number
    assert (number == 2 and few) or (number == 1 and stale)
    assert sorted(few if few else none) == few
    assert 1 in few
    assert not none
"""
CANNOT = {
    "assert all(item > 5 for item in none)": "looks through nothing",
    "assert few == [9] or stale": "alternative 1 was never needed; alternative 2 was true each time",
    "assert few == (few if few else none)": "compares an object with itself",
    "for item in none: assert item > 5": "never ran",
    "assert few.index": "a builtin_function_or_method is always true",
    "assert (few, 'message')": "a tuple is always true",
    "assert 3 <= float('inf')": "holds whatever stands on the left",
}


def told(folder: Path, text: str) -> tuple[int, list[str]]:
    (folder / "test_small.py").write_text(text, encoding="utf-8")
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --import-mode=importlib\n", encoding="utf-8")
    words = [sys.executable, "-W", "ignore::SyntaxWarning", str(COMMAND), "test_small.py"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, [line for line in done.stdout.splitlines() if line.startswith("test_small") or "," in line]


def test_what_cannot_fail_is_found_and_nothing_else(tmp_path: Path) -> None:
    code, lines = told(tmp_path, CAN + "".join(f"    {assertion}\n" for assertion in CANNOT))
    assert code == 1
    first = len(CAN.splitlines()) + 1
    assert [line.partition(": ")[0] for line in lines[:-1]] == [
        f"test_small.py:{first + number}" for number in range(len(CANNOT))
    ]
    for line, wrong in zip(lines, CANNOT.values(), strict=False):
        assert line.split(": ")[1] == wrong
    assert lines[-1] == f"{7 + len(CANNOT)} assertions, {len(CANNOT)} to look at"


def test_the_exit_code_tells_whether_the_tests_pass_and_whether_all_can_fail(tmp_path: Path) -> None:
    assert told(tmp_path, CAN)[0] == 0
    assert told(tmp_path, CAN + "    assert stale == [4]\n")[0] == 2


def test_of_skipped_tests_it_is_told_how_many_were_not_asked(tmp_path: Path) -> None:
    """Not that they never ran, which nobody can mend; one that ran once is asked as ever."""
    skipped = "\n@pytest.mark.skip\ndef test_skipped():\n    assert [] or [1]\n    assert [2]\n"
    sometimes = "\n@pytest.mark.parametrize('n', [1, 2])\ndef test_sometimes(n):\n    if n == 1: pytest.skip()\n"
    code, lines = told(tmp_path, CAN + skipped + sometimes + "    assert n == 2\n")
    assert (code, lines[-1]) == (0, "10 assertions, 0 to look at, 2 not asked, of skipped tests")
    code, lines = told(tmp_path, CAN + sometimes + "    for n in []: assert n == 2\n")
    assert (code, lines[-1]) == (1, "8 assertions, 1 to look at")
