"""Seeds by what they are for: nothing that is chosen, fitted or calibrated sees what is evaluated.

Trials use seeds of ``development``. Margins are calibrated on ``calibration``. Published figures are counted on
``evaluation``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from safedpa.errors import InputError, did_you_mean

SEEDS: Final = {
    "development": range(100_000),
    "calibration": range(1_000_000, 1_100_000),
    "evaluation": range(2_000_000, 2_100_000),
}


def seeds_for(purpose: str, count: int, skip: int = 0) -> range:
    """``count`` seeds of one purpose, after the first ``skip``. Raises InputError beyond its range."""
    if purpose not in SEEDS:
        raise InputError(f"seeds for '{purpose}': {did_you_mean(purpose, SEEDS)}")
    known = SEEDS[purpose]
    if count < 0 or skip < 0 or skip + count > len(known):
        raise InputError(f"seeds for {purpose}: got {skip} + {count}, wanted at most {len(known)}")
    return known[skip : skip + count]


def seeds_of(options: Mapping[str, Any]) -> range:
    """The seeds that ``--first-seed`` and ``--seeds`` ask for."""
    return range(options["first_seed"], options["first_seed"] + options["seeds"])
