"""A folder of one run, for this user alone, that is gone when the run is, whichever way it ends.

It lies in memory where the system has such a place, so a loss of power takes it along. A small process of its own
removes it when the run's process is gone, also where that one was killed; and what a killed machine left behind goes
when the next run begins.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safedpa.errors import InputError

__all__ = ["private_folder"]

_PREFIX = "safedpa-run-"
_HELD = "held"
"""A file in the folder, locked for as long as the run lives."""
_SWEEP = "import os,shutil,sys;os.read(0,1);shutil.rmtree(sys.argv[1],True)"


@contextmanager
def private_folder() -> Iterator[Path]:
    """The folder. Raises InputError where none can be made."""
    parent = _parent()
    _remove_forgotten(parent)
    try:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))  # with mode 0700
    except OSError as error:
        raise InputError(f"{parent}: no folder can be made there ({error.strerror}); name one by TMPDIR") from error
    held = _locked(folder / _HELD)
    sweeper = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", _SWEEP, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # what ends our group leaves it alone
        cwd="/",
    )
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if held is not None:
            os.close(held)
        if sweeper.stdin is not None:
            sweeper.stdin.close()
        sweeper.wait()


def _parent() -> Path:
    """In memory and this user's own, where there is such a place."""
    if os.environ.get("TMPDIR"):
        return Path(os.environ["TMPDIR"])
    for name in (os.environ.get("XDG_RUNTIME_DIR", ""), "/dev/shm"):
        if name and os.access(name, os.W_OK | os.X_OK):
            return Path(name)
    return Path(tempfile.gettempdir())


def _locked(path: Path) -> int | None:
    """A descriptor that holds the file; None where someone else does, or it cannot be opened."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _remove_forgotten(parent: Path) -> None:
    """Folders of this user that no one holds any more."""
    with contextlib.suppress(OSError):
        for folder in parent.glob(f"{_PREFIX}*"):
            about = folder.lstat()
            if about.st_uid != os.getuid() or folder.is_symlink() or not (folder / _HELD).exists():
                continue
            held = _locked(folder / _HELD)
            if held is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(held)
