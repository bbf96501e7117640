"""No traceback on a person's terminal for what a browser does: one line there, the whole of it in a file."""

from __future__ import annotations

import contextlib
import logging
import time
import traceback
from pathlib import Path
from typing import Any

from safedpa.limits import readable

__all__ = ["keep_tracebacks_in"]

_LONGEST = 300
_MOST_BYTES = 4_000_000
_LEFT = ("No response returned.",)
"""What the web framework says where a browser hangs up before its answer: nobody needs to hear of that."""


def keep_tracebacks_in(path: Path) -> None:
    """From now on every log record of this process that has a traceback is one line, and the traceback is in ``path``.

    The file is made at the first one; what does not fit into 4 MB is not kept.
    """
    plain = logging.getLogRecordFactory()

    def made(*arguments: Any, **options: Any) -> logging.LogRecord:
        record = plain(*arguments, **options)
        error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
        if error is None and isinstance(record.msg, BaseException):
            error = record.msg
        if error is None:
            return record
        record.browser_left = str(error) in _LEFT or isinstance(error, ConnectionError)
        _keep(path, error)
        said = readable(f"{type(error).__name__}: {' '.join(str(error).split())}", _LONGEST)
        record.msg, record.args = f"the page goes on after an error ({said}); more in {path}", ()
        record.exc_info = record.exc_text = None
        return record

    logging.setLogRecordFactory(made)
    logging.getLogger("uvicorn.error").addFilter(lambda record: not getattr(record, "browser_left", False))


def _keep(path: Path, error: BaseException) -> None:
    with contextlib.suppress(OSError):
        if path.exists() and path.stat().st_size > _MOST_BYTES:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(time.strftime("%Y-%m-%d %H:%M:%S\n") + "".join(traceback.format_exception(error)) + "\n")
