"""Every experiment whose figures the pages quote runs by its documented command, at its smallest size."""

from pathlib import Path

import pytest

from safedpa_lab.experiments.run_all import PARTS, Part, make

ELSEWHERE = {
    "adversary": "tests/lab/adversary/test_adversary_command.py",
    "faults": "tests/lab/faults/test_campaign.py",
    "hostile-mutations": "tests/hostile/test_fuzz_small.py",
}
"""Those that other tests run, by name."""
READY = [
    part
    for part in PARTS
    if not part.data and part.name not in ELSEWHERE and (part.needs is None or part.needs.models.is_dir())
]
"""Those that need neither recordings nor models that do not ship."""


def test_those_that_other_tests_run_are_run_there() -> None:
    root = Path(__file__).resolve().parents[3]
    assert ELSEWHERE.keys() <= {part.name for part in PARTS}
    assert all((root / path).is_file() for path in ELSEWHERE.values())


@pytest.mark.long
@pytest.mark.parametrize("part", READY, ids=lambda part: part.name)
def test_an_experiment_runs_and_writes_its_result(part: Part, tmp_path: Path) -> None:
    account = make([part], tmp_path, small=True)
    assert account[part.name]["exit_code"] == 0, account[part.name]["last_text"]
    assert part.result(tmp_path).is_file()
