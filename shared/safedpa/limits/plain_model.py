"""A cheap check of an offered model before it is parsed: its size, and that each line has a form that we write.

The TOML parser then needs a bounded time, also for a malicious model.
"""

from __future__ import annotations

import re

from safedpa.errors import InputError
from safedpa.limits.table import limit, too_much

__all__ = ["check_plain_model"]

_NAME = r"[A-Za-z_][A-Za-z0-9_]{0,63}"
_NUMBER = r"[-+]?[0-9.][0-9.eE+-]{0,39}|[-+]?inf|[-+]?nan|true|false"
_TEXT = r"""\"[^"\\\x00-\x1f]{0,200}"|'[^'\x00-\x1f]{0,200}'"""
_INLINE_TABLE = r"\{[^{}\[\]]{0,300}\}"
"""An inline table such as ``{ value = 0.3, free = true }``."""
_STATEMENT = rf"\[\[?{_NAME}\]?\]|{_NAME}[ \t]*+=[ \t]*+(?:{_NUMBER}|{_TEXT}|{_INLINE_TABLE})"
_LINE = re.compile(rf"[ \t]*+(?:{_STATEMENT})?[ \t]*+(?:#.{{0,400}})?\r?")


def check_plain_model(document: str) -> None:
    """Raises LimitError if the document is too large, and InputError that names the first line of another form."""
    if len(document) > limit("offer_bytes"):
        raise too_much("offer_bytes", f"{len(document)} characters")
    lines = document.split("\n")
    if len(lines) > limit("offer_lines"):
        raise too_much("offer_lines", len(lines))
    for number, line in enumerate(lines, 1):
        if _LINE.fullmatch(line) is None:
            raise InputError(
                f"not TOML as this program writes models: line {number}; wanted 'name = value' or a table's name, no "
                "dotted keys and no lists; write it by the diagnosis or with 'safedpa add'"
            )
