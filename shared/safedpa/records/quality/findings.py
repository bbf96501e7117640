"""Builds findings: a sentence with the defect, its count, its first time and what was done."""

from __future__ import annotations

import math

from safedpa.records.run import Finding

__all__ = ["count_text", "finding"]


def count_text(count: int, one: str, many: str) -> str:
    """Returns a count with its noun, such as ``1 row`` or ``3 rows``."""
    return f"{count} {one if count == 1 else many}"


def finding(kind: str, text: str, count: int = 1, start_t: float | None = None, done: str = "") -> Finding:
    """Returns a finding whose sentence ends with the first time and what was done."""
    if start_t is not None and math.isfinite(start_t):
        text += f", first at t = {float(start_t):.3f} s"
    return Finding(kind, f"{text}; {done}" if done else text, count, None if start_t is None else float(start_t))
