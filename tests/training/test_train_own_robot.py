"""``safedpa train --robot-file``: a robot of one's own learns its dynamics and its history encoder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from safedpa.dynamics import LearnedBase, load_model
from safedpa.robot import forget_robot
from safedpa_services.command_line.group import safedpa

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "cleaner"
OWN = [
    "train", "cleaner", "--robot-file", str(EXAMPLE / "cleaner.py"),
    "--configuration", str(EXAMPLE / "learned.toml"), "--json",
]  # fmt: skip


@pytest.fixture(autouse=True)
def _strangers_leave():
    torch.set_num_threads(1)
    yield
    forget_robot("cleaner")


@pytest.mark.long
def test_an_own_robot_learns_what_it_is_and_in_what_it_drives(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code = safedpa.run([*OWN, "--out", str(tmp_path)])
    printed = capsys.readouterr()
    assert (code, printed.err) == (0, "")
    records = json.loads(printed.out)
    assert set(records) == {"1a", "2"}
    ahead, _, turned = records["1a"]["explained"]  # aside it hardly moves
    assert min(ahead, turned) > 0.98
    assert min(records["2"]["explained"]) > 0.3
    model = load_model(tmp_path / "cleaner_learned.toml")
    assert isinstance(model.base, LearnedBase)
    assert model.base.weights.has("phi")


def test_what_is_missing_is_reported_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments, told in (
        ([*OWN, "--phases", "1b"], "1b"),
        (["train", "cleane", *OWN[2:4]], "did you mean 'cleaner'"),
        (["train", "cleaner", *OWN[2:4]], "wanted a configuration"),
        (["train", "drone"], "--robot-file FILE.py loads one of your own"),
    ):
        code = safedpa.run([*arguments, "--out", str(tmp_path)])
        error = capsys.readouterr().err
        assert code == 2
        assert told in error
        assert len(error.strip().splitlines()) == 1
