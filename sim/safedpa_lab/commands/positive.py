"""What an experiment counts or lasts is more than nothing, and less than for ever."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any

from safedpa.errors import InputError

__all__ = ["check_positive"]


def check_positive(options: Mapping[str, Any], *names: str) -> None:
    """Raises InputError for the first of these options that is not a number above 0, or is infinite."""
    for name in names:
        if not 0 < options[name] < inf:
            raise InputError(f"--{name.replace('_', '-')}: got {options[name]}, wanted more than 0")
