"""Limits for everything that comes from outside: inputs are measured before they are parsed.

``table`` lists the limits; read it first. All text, tables and archives from users, files, the bus and web pages are
parsed through the functions here. A refusal is one line that names the limit; its time and memory are bounded whatever
the input. ``text`` parses and checks text, ``files`` reads files and checks archives and weights.
"""

from __future__ import annotations

from safedpa.limits.files import (
    check_archive,
    check_tensor_file,
    file_of_at_most,
    text_of_file,
    text_of_file_or_shipped,
)
from safedpa.limits.table import TABLE, VARIABLE, Limit, LimitError, limit, too_much
from safedpa.limits.text import (
    check_plain_model,
    finite_number,
    parse_json,
    parse_toml,
    printable,
    readable,
    refuse_unknown,
    whole_number,
)

__all__ = [
    "TABLE",
    "VARIABLE",
    "Limit",
    "LimitError",
    "check_archive",
    "check_plain_model",
    "check_tensor_file",
    "file_of_at_most",
    "finite_number",
    "limit",
    "parse_json",
    "parse_toml",
    "printable",
    "readable",
    "refuse_unknown",
    "text_of_file",
    "text_of_file_or_shipped",
    "too_much",
    "whole_number",
]
