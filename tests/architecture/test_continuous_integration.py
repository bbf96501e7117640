"""What continuous integration could not test is reported by it, in its last lines."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / ".ci" / "run"
LOG = """\
..s.s                                                                    [100%]
=========================== short test summary info ============================
SKIPPED [3] tests/operations/test_metrics.py:167: promtool is not installed; Debian's package 'prometheus' has it
SKIPPED [1] tests/dashboard/test_browser.py:57: no Chromium; install it (Debian: apt-get install chromium)
SKIPPED [2] tests/workbench/test_screens.py:7: no Chromium; install it (Debian: apt-get install chromium)
== 8000 passed, 6 skipped in 600.00s ==
"""


def test_every_reason_to_skip_is_reported_once_with_how_many_tests_it_left_out(tmp_path: Path) -> None:
    (tmp_path / "tests.log").write_text(LOG, encoding="utf-8")
    (tmp_path / "fleet.log").write_text(
        "SKIPPED [7] tests/fleet/test_fleet.py:9: no containers here\n", encoding="utf-8"
    )
    assert not_tested(tmp_path / "tests.log", tmp_path / "fleet.log", tmp_path / "is not there") == [
        "NOT TESTED: 3: no Chromium; install it (Debian: apt-get install chromium)",
        "NOT TESTED: 3: promtool is not installed; Debian's package 'prometheus' has it",
        "NOT TESTED: 7: no containers here",
    ]


def test_where_all_is_tested_nothing_is_reported(tmp_path: Path) -> None:
    (tmp_path / "tests.log").write_text("== 8000 passed in 600.00s ==\n", encoding="utf-8")
    assert not_tested(tmp_path / "tests.log") == []


def test_it_is_reported_after_all_parts_and_before_failures_and_summary() -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    order = (
        'part "quick tests" run_tests test\n',
        'part "long tests" run_tests test-long\n',
        'not_tested "$programs/test.log"',
        'echo "TIME: ',
        'echo "FAILED: $name"',
        'summary "$programs/$run.log"',
    )
    places = [text.index(part) for part in order]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("failed", "last"),
    [
        ("", "test"),
        ("types", "test"),
        ("'quick tests'", "test"),
        ("'quick tests' 'long tests'", "test"),
        ("'long tests'", "test-long"),
        ("types 'long tests' fleet", "test-long"),
    ],
)
def test_the_last_line_is_a_summary_and_that_of_the_run_that_failed(tmp_path: Path, failed: str, last: str) -> None:
    for run in ("test", "test-long"):
        (tmp_path / f"{run}.log").write_text(f"{LOG}== 1 passed of {run} in 600.00s ==\nreal 10m\n", encoding="utf-8")
    text = SCRIPT.read_text(encoding="utf-8")
    begin = text.index("summary() {")
    function = text[begin : text.index("\n}\n", begin) + 3]
    end = text[text.index("runs=(test-long test)") : text.index("[ ${#failed[@]} -eq 0 ]")]
    reported = f"set -uo pipefail\n{function}\nprograms={tmp_path} failed=({failed})\n{end}"
    lines = subprocess.run(["bash", "-c", reported], capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 2
    assert lines[-1] == f"== 1 passed of {last} in 600.00s =="


def test_without_a_compiler_the_compiled_filter_is_not_tested_and_that_is_reported(tmp_path: Path) -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    begin = text.index("compiled_tests() {")
    function = text[begin : text.index("\n}\n", begin) + 3]
    found = shutil.which("tee")
    assert found
    (tmp_path / "tee").symlink_to(found)
    reported = f"{function}\nprograms={tmp_path} PATH={tmp_path}\ncompiled_tests"
    subprocess.run(["/bin/bash", "-c", reported], check=True)
    assert not_tested(tmp_path / "compiled.log") == [
        "NOT TESTED: 1: no C compiler, so the filter was tested from source alone"
    ]


@pytest.mark.parametrize(
    ("schemas", "sound", "code"), [("false", "false", 0), ("true", "true", 0), ("true", "false", 1)]
)
def test_manifests_fail_where_they_are_wrong_and_not_where_no_one_can_report(tmp_path, schemas, sound, code):
    text = SCRIPT.read_text(encoding="utf-8")
    begin = text.index("manifests() {")
    function = text[begin : text.index("\n}\n", begin) + 3]
    make = f'make() {{ case "$2" in build/*) {schemas} ;; manifests) {sound} ;; *) exit 9 ;; esac; }}'
    done = subprocess.run(["bash", "-c", f"{make}\n{function}\nprograms={tmp_path}\nmanifests"], check=False)
    assert done.returncode == code
    unknown = ["NOT TESTED: 1: Kubernetes' schemas cannot be had"] if schemas == "false" else []
    assert not_tested(tmp_path / "manifests.log") == unknown


def test_a_part_that_fails_fails_and_its_time_is_reported() -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    begin = text.index("failed=()")
    function = text[begin : text.index("\n}\n", begin) + 3]
    reported = f'{function}\npart first true; part second false; echo "${{spent[*]}} | ${{failed[*]}}"'
    done = subprocess.run(["bash", "-c", reported], capture_output=True, text=True, check=True)
    assert re.fullmatch(r"first \d+ s second \d+ s \| second", done.stdout.splitlines()[-1])


def not_tested(*logs: Path) -> list[str]:
    """What the function of that name in the script prints."""
    text = SCRIPT.read_text(encoding="utf-8")
    begin = text.index("not_tested() {")
    function = text[begin : text.index("\n}\n", begin) + 3]
    phrase = ["bash", "-c", f'{function}\nnot_tested "$@"', "bash", *map(str, logs)]
    return subprocess.run(phrase, capture_output=True, text=True, check=True).stdout.splitlines()
