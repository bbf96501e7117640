"""What a page reports when the disk is full."""

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.comparison.output import require_writable_folder
from safedpa.disk import why_not_written
from safedpa.errors import InputError, RecordingError
from safedpa_services.workbench.rerun_viewer import write_view
from safedpa_services.workbench.session.files import SavedSession, write_session
from safedpa_services.workbench.session.inputs import InputSelection

pytest.importorskip("nicegui")
FULL = "the disk is full: free some space"


def _full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_called_so(number):
    assert why_not_written(OSError(number, os.strerror(number))) == FULL
    assert why_not_written(OSError(errno.EACCES, "Permission denied")) == "Permission denied"
    assert why_not_written(OSError()) == "OSError"


def test_nothing_is_left_of_a_file_that_found_no_room(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "replace", _full)
    with pytest.raises(RecordingError, match=FULL):
        write_session(SavedSession(InputSelection("car", ("run.csv",))), tmp_path)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(Path, "mkdir", _full)
    with pytest.raises(InputError, match=FULL):
        require_writable_folder(tmp_path / "new", create=True)


def test_no_view_is_begun_without_room(tmp_path, monkeypatch):
    many = SimpleNamespace(begin=[0], run=[0], select=lambda rows: rows)
    windows = type("Windows", (), {**vars(many), "__len__": lambda _: 1, "select": lambda _, rows: rows})()
    session: Any = SimpleNamespace(comparison=SimpleNamespace(windows=windows), start=0)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    with pytest.raises(RecordingError, match=FULL):
        write_view(session, tmp_path / "view.rrd")
    assert list(tmp_path.iterdir()) == []
