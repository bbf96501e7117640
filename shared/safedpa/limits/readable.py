"""Makes foreign names and sentences safe to show in a terminal, a log or a web page."""

from __future__ import annotations

from safedpa.limits.table import limit

__all__ = ["printable", "readable"]


def readable(text: str, longest: int | None = None) -> str:
    r"""Returns the text with every unprintable character escaped as ``\xNN`` or ``\uNNNN``.

    Unprintable are control, format and unassigned characters, and all spaces but the ordinary one: they can move,
    colour, hide or reorder text. A text longer than ``longest`` characters (default: the limit ``name_letters``) is
    cut, with a note of its length.
    """
    most = limit("name_letters") if longest is None else longest
    shown = text[:most]
    if not shown.isprintable():
        shown = "".join(sign if sign.isprintable() else _visible(sign) for sign in shown)
    return shown if len(text) <= most else f"{shown}... ({len(text)} characters)"


def printable(text: str, but: str = "", also: str = "") -> str:
    """Replaces each unprintable character, and each of ``but``, by ``?``; keeps those of ``also``. The length stays."""
    return "".join(sign if (sign.isprintable() or sign in also) and sign not in but else "?" for sign in text)


def _visible(sign: str) -> str:
    code = ord(sign)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
