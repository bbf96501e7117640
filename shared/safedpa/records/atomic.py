"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from safedpa.disk import why_not_written
from safedpa.errors import RecordingError

__all__ = ["atomic_path"]


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path``; renamed to it at the end, removed when the block raises.

    Raises RecordingError when it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be written ({why_not_written(error)}); nothing was changed there; choose another place"
        ) from error
    finally:
        with suppress(OSError):  # the folder may be what is missing
            temporary.unlink(missing_ok=True)
