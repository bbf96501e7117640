"""What comes from outside is measured before it is parsed: one table of limits, and the only doors to the parsers.

Text, tables and archives from people, files, the bus and pages are read through the functions here. They refuse with
one line that says which limit was passed, in a time and a memory that do not depend on what was sent.
"""

from __future__ import annotations

from safedpa.limits.archive import check_archive
from safedpa.limits.numbers import finite_number, whole_number
from safedpa.limits.plain_model import check_plain_model
from safedpa.limits.readable import printable, readable
from safedpa.limits.reading import file_of_at_most, text_of_file, text_of_file_or_shipped
from safedpa.limits.table import TABLE, VARIABLE, Limit, LimitError, limit, too_much
from safedpa.limits.tensors import check_tensor_file
from safedpa.limits.text import parse_json, parse_toml, refuse_unknown

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
