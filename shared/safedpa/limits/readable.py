"""Names and sentences that others chose, made fit for a terminal, a log and a page."""

from __future__ import annotations

from safedpa.limits.table import limit

__all__ = ["printable", "readable"]


def readable(text: str, longest: int | None = None) -> str:
    r"""The text with every character that is not printable written as ``\xNN`` or ``\uNNNN``.

    Such are control and format characters, unassigned ones, and all spaces but the ordinary one: they move, colour,
    hide or reorder others, or look like what they are not.

    Cut at ``longest`` letters (else the table's ``name_letters``), and it says so.
    """
    most = limit("name_letters") if longest is None else longest
    shown = text[:most]
    if not shown.isprintable():
        shown = "".join(sign if sign.isprintable() else _visible(sign) for sign in shown)
    return shown if len(text) <= most else f"{shown}... ({len(text)} letters)"


def printable(text: str, but: str = "", also: str = "") -> str:
    """The text at its own width: ``?`` for each character that is not printed, and each of ``but``; ``also`` stays."""
    return "".join(sign if (sign.isprintable() or sign in also) and sign not in but else "?" for sign in text)


def _visible(sign: str) -> str:
    code = ord(sign)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
