"""What a page says when the disk is full, and of names that come out of a file."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.compare.output import writable
from safedpa.disk import why_not_written
from safedpa.errors import InputError, RecordingError
from safedpa_services.workbench import rerun_view, worker
from safedpa_services.workbench.recordings import Choice
from safedpa_services.workbench.session_files import Kept, write_session

pytest.importorskip("nicegui")
FULL = "the disk is full: make room"


def _full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_called_so(number: int) -> None:
    assert why_not_written(OSError(number, os.strerror(number))) == FULL
    assert why_not_written(OSError(errno.EACCES, "Permission denied")) == "Permission denied"
    assert why_not_written(OSError()) == "OSError"


def test_nothing_is_left_of_a_file_that_found_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "replace", _full)
    with pytest.raises(RecordingError, match=FULL):
        write_session(Kept(Choice("car", ("run.csv",))), tmp_path)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(Path, "mkdir", _full)
    with pytest.raises(InputError, match=FULL):
        writable(tmp_path / "new", create=True)


def _no_room(tell: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/somewhere/model.toml")


def test_the_process_that_computes_says_it_and_lives_on() -> None:
    told: list[Any] = []
    connection: Any = SimpleNamespace(send=told.append)
    kind, error = worker._done(_no_room, (), connection)
    assert kind == "failed"
    assert str(error) == f"/somewhere/model.toml: cannot be written or read ({FULL})"
    assert worker._done(lambda tell: 3, (), connection) == ("done", 3)


def test_a_page_that_is_gone_ends_the_process() -> None:
    def says(tell: Any) -> None:
        tell(0.5)

    def gone(_: Any) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        worker._done(says, (), SimpleNamespace(send=gone))  # type: ignore[arg-type]


def test_no_view_is_begun_without_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    with pytest.raises(RecordingError, match=FULL):
        rerun_view._require_room(tmp_path / "view.rrd")


@pytest.mark.parametrize("name", ["/\x1b[2J\u202eodom:x", "/<script>alert(1)</script>:x", "/" + "a" * 5000])
def test_a_topic_of_a_bag_is_offered_as_text(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from nicegui import ui

    from safedpa_services.workbench.file_preview import RawRows
    from safedpa_services.workbench.open_dialog import ColumnsTable

    shown: dict[str, str] = {}

    class StopError(Exception):
        """The rest of the form is not drawn."""

    def select(options: dict[str, str], **_: Any) -> None:
        shown.update(options)
        raise StopError

    monkeypatch.setattr(ui, "select", select)
    table: Any = object.__new__(ColumnsTable)
    table._raw = RawRows((name,), ())
    with pytest.raises(StopError):
        table._choice(0, "source", [name], name, "column for x")
    assert list(shown) == [name], "the map gets the name as it is"
    assert shown[name].isprintable()
    assert len(shown[name]) < 300
