"""What is true of a robot now, from the ages of its newest messages: the headline of every display.

A value is shown with its age, counted from its measurement. An old verdict is never the headline.
"""

from __future__ import annotations

from typing import Final

STALE_SECONDS: Final = 0.75
"""Age [s] from which a state or verdict is old, or three periods of a slow robot; displays redraw within 0.25 s."""


def is_stale(age: float | None, period: float = 0.0) -> bool:
    """Whether a message of this age [s] says nothing about the present; None: none arrived."""
    return age is None or age > max(STALE_SECONDS, 3.0 * period)


def headline(state_age: float | None, verdict_age: float | None, period: float = 0.0) -> str:
    """Returns what is wrong now with the robot's messages and the consequence; empty if both are recent.

    :param state_age: age of the newest state [s]; None: none arrived
    :param verdict_age: the same of the verdict
    :param period: control period [s]
    """
    if state_age is None:
        return "no state yet"
    if is_stale(state_age, period):
        return f"no state for {state_age:.0f} s; the robot has ended, hangs or is cut off, and brakes by itself"
    if verdict_age is None:
        return "no verdict yet; the robot brakes"
    if is_stale(verdict_age, period):
        return f"no verdict for {verdict_age:.0f} s; the robot brakes"
    return ""


def age_text(age: float) -> str:
    """Returns an age [s] for people."""
    return f"{age:.1f} s old" if age < 10.0 else f"{age:.0f} s old"
