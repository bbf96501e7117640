"""The exception classes of the project.

    SafedpaError
    ├── InputError            unusable input: exit code 2, one line
    │   ├── ModelFileError    a model file; the message names the key
    │   ├── ColumnMapError    a column map; the message names the key
    │   ├── RunError          a recording: unreadable, empty, wrong columns
    │   └── MessageError      a message from the bus: wrong shape, type or not finite
    ├── MissingExtraError     a package that `pip install safedpa` alone does not install
    ├── BusError              the bus cannot be opened or a name on it is in use
    │   └── JoinError         the bus cannot be joined now; a later attempt may succeed
    └── RecordingError        a recording could not be written, for example because the disk is full

Every message says what was received, what was expected, and what to do.
"""

from __future__ import annotations

import difflib
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Final

__all__ = [
    "BusError",
    "ColumnMapError",
    "InputError",
    "JoinError",
    "MessageError",
    "MissingExtraError",
    "ModelFileError",
    "RecordingError",
    "RunError",
    "SafedpaError",
    "described",
    "did_you_mean",
    "escaped",
    "near_files",
]

# Maximum number of names listed in a message; a wide table has thousands of columns. Beyond it, only the most similar.
_NAMED: Final = 60
_LIKE: Final = 12


class SafedpaError(Exception):
    """Base class of all errors that this project raises on purpose; the message says what to do.

    Example:

        >>> issubclass(safedpa.InputError, safedpa.SafedpaError)
        True
    """


class InputError(SafedpaError):
    """Invalid input from a user or a file; the command line prints one line and exits with code 2.

    The message is one line: unprintable characters, as of a file's name, are escaped.

    Example:

        >>> try:
        ...     safedpa.load_model("penduluum")
        ... except safedpa.InputError as error:
        ...     print(error)
        penduluum: ...did you mean 'pendulum'?...
    """

    def __init__(self, *arguments: object) -> None:
        super().__init__(*(escaped(item) if isinstance(item, str) else item for item in arguments))


class ModelFileError(InputError):
    """A model file that cannot be used."""


class ColumnMapError(InputError):
    """A column map that cannot be used."""


class RunError(InputError):
    """A recorded run that cannot be used."""


class MessageError(InputError):
    """A message from the bus that cannot be used."""


class MissingExtraError(SafedpaError):
    """A package is missing that ``pip install safedpa`` alone does not install; the message names the extra."""


class BusError(SafedpaError):
    """The bus cannot be opened, or a name on it is in use."""


class JoinError(BusError):
    """The bus cannot be joined now: the router is missing or has no capacity. A later attempt may succeed."""


class RecordingError(SafedpaError):
    """A recording could not be written."""


def described(error: BaseException) -> str:
    """Returns type and message of an error, and the line of the user's code that raised it.

    Frames of this package and of installed libraries are not the user's.
    """
    own = str(Path(__file__).parent)
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith(own) and "site-packages" not in frame.filename
    ]
    place = "".join(f" ({Path(frame.filename).name}, line {frame.lineno}, in {frame.name})" for frame in frames[-1:])
    return f"{type(error).__name__}: {escaped(str(error))}{place}"


def escaped(text: str) -> str:
    r"""Returns the text with every unprintable character, line breaks included, as ``\xNN`` or ``\uNNNN``."""
    return text if text.isprintable() else "".join(sign if sign.isprintable() else _visible(sign) for sign in text)


def _visible(sign: str) -> str:
    code = ord(sign)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Returns a sentence for look-up errors, with the most similar name first and a list of the known names.

    If there are many names, only the most similar ones are listed.
    """
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    if len(names) <= _NAMED:
        return f"{hint}known: {', '.join(names)}"
    like = sorted(difflib.get_close_matches(name, names, n=_LIKE, cutoff=0.0))
    return f"{hint}known: {', '.join(like)} and {len(names) - len(like)} more"


def near_files(path: Path, shipped: Iterable[str] = ()) -> str:
    """Returns ``did you mean 'drive.csv'? `` for a missing file, from the files next to it and the shipped names.

    Empty without a similar name. Never raises.
    """
    try:
        alongside = [item.name for item in path.parent.iterdir() if item.name not in (path.name, "pyproject.toml")]
    except OSError:
        alongside = []
    near = difflib.get_close_matches(path.name, [*shipped, *alongside], n=1)
    if not near:
        return ""
    return f"did you mean '{near[0] if near[0] not in alongside else path.parent / near[0]}'? "
