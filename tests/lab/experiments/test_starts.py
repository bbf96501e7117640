"""Every experiment whose figures the pages quote runs by its documented command, at its smallest size."""

from pathlib import Path

import pytest

from safedpa_lab.experiments.run_all import PARTS, Part, make

READY = [part for part in PARTS if not part.data and (part.needs is None or part.needs.models.is_dir())]
"""Those that need neither recordings nor models that do not ship."""


@pytest.mark.long
@pytest.mark.parametrize("part", READY, ids=lambda part: part.name)
def test_an_experiment_runs_and_writes_its_result(part: Part, tmp_path: Path) -> None:
    account = make([part], tmp_path, small=True)
    assert account[part.name]["exit_code"] == 0, account[part.name]["last_text"]
    assert part.result(tmp_path).is_file()
