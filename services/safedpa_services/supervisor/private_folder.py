"""A temporary folder for one run that only this user can read, and that is removed however the run ends.

The folder is in memory if the system has a memory file system, so it does not survive a loss of power. A small process
removes it when the run's process ends, even if that is killed. Folders that were left behind nevertheless are removed
by the next run.
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

_PREFIX = "safedpa-run-"
_LOCK = "held"
"""File in the folder that the run locks; an unlocked folder was left behind."""
_CLEANUP = "import os,shutil,sys;os.read(0,1);shutil.rmtree(sys.argv[1],True)"
"""Waits until standard input closes, then removes the folder."""


@contextmanager
def private_folder() -> Iterator[Path]:
    """Yields the folder. Raises InputError if it cannot be created."""
    parent = _parent()
    _remove_abandoned(parent)
    try:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))  # created with mode 0700
    except OSError as error:
        raise InputError(
            f"{parent}: cannot create a folder there ({error.strerror}); set TMPDIR to another one"
        ) from error
    lock = _locked(folder / _LOCK)
    cleaner = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", _CLEANUP, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a signal to our process group must not end it
        cwd="/",
    )
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)
        if cleaner.stdin is not None:
            cleaner.stdin.close()
        cleaner.wait()


def _parent() -> Path:
    """Returns TMPDIR if set, else a memory file system, else the system's temporary folder."""
    if os.environ.get("TMPDIR"):
        return Path(os.environ["TMPDIR"])
    for name in (os.environ.get("XDG_RUNTIME_DIR", ""), "/dev/shm"):
        if name and os.access(name, os.W_OK | os.X_OK):
            return Path(name)
    return Path(tempfile.gettempdir())


def _locked(path: Path) -> int | None:
    """Returns a descriptor that holds a lock on the file; None if it is locked already or cannot be opened."""
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


def _remove_abandoned(parent: Path) -> None:
    """Removes folders of this user that no process has locked."""
    with contextlib.suppress(OSError):
        for folder in parent.glob(f"{_PREFIX}*"):
            about = folder.lstat()
            if about.st_uid != os.getuid() or folder.is_symlink() or not (folder / _LOCK).exists():
                continue
            lock = _locked(folder / _LOCK)
            if lock is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(lock)
