"""Where a replay may write: never what would be read as a part of the run the next time."""

from __future__ import annotations

from pathlib import Path

import pytest

from safedpa.errors import InputError
from safedpa_services.command_line.replay import _check_out


@pytest.mark.parametrize(
    ("runs", "out", "refused"),
    [
        (["drives"], "drives/new.mcap", True),  # it would be read as one more file of the run
        (["drives"], "drives/a.mcap", True),
        (["drives"], "drives/report.json", False),
        (["drives"], "elsewhere/new.mcap", False),
        (["drives"], "new.mcap", False),
        (["drives/a.mcap"], "drives/a.mcap", True),
        (["drives/a.mcap"], "drives/new.mcap", False),  # the file alone is the run
        (["drives/a.mcap"], "drives/../drives/a.mcap", True),
        (["drives"], None, False),
    ],
)
def test_a_recording_is_not_written_into_the_run_that_was_read(
    runs: list[str], out: str | None, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("drives/a.mcap", "drives/b.mcap"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_bytes(b"")
    options = {"out": None if out is None else Path(out), "runs": [Path(run) for run in runs]}
    if refused:
        with pytest.raises(InputError, match="stands for a recording of this run"):
            _check_out(options)
        return
    _check_out(options)
