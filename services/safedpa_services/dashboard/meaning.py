"""What the panes mean, in a line each: a page beside them."""

from __future__ import annotations

from safedpa_services.dashboard.look import Look

__all__ = ["meaning"]


def meaning(look: Look) -> str:
    """The page, in Markdown."""
    world = _PENDULUM if look.is_pendulum else _WORLD
    return "\n\n".join(f"**{name}**: {text}" for name, text in (*world, *_PANES))


_WORLD = (
    (
        "world from above",
        "robot white, load pink, goal yellow, obstacles grey. Orange: the room that it needs to stop, and the rings "
        "which that room's middle line must not cross. The trail has the colour of the verdict.",
    ),
)
_PENDULUM = (
    ("pendulum", "green: where it may be, red: where not; the arrow is the wind as it is estimated, its ring 5 m/s."),
    ("angle and its rate", "inside the orange edge the filter can still keep it in the corridor."),
)
_PANES = (
    (
        "room left h",
        "the smallest barrier value, now and predicted for the next tick. Above the threshold 0: safe. Each step must "
        "keep it above the margin's condition. A gap: the filter could not compute it.",
    ),
    ("action", "what the policy wished and what the filter let through, between the actuator's limits."),
    (
        "verdict",
        "filter: passed, corrected, relaxed (less than the margin), violated (outside), fallback (no decision), "
        "disabled, stopped. in_force: whose action the robot follows. diagnosis and model: their stage and number.",
    ),
    ("estimate", "what the model leaves free, as the adaptation estimates it; the band is one standard deviation."),
    ("residual", "measured minus predicted, one tick ahead. Around 0: the model is right."),
    ("error", "of predictions over 1 s. Above the end of its band for long: the diagnosis raises a finding."),
    ("time of a step", "what each service computed for its last tick."),
    ("services", "ready, running, failing, or silent: no sign of life for a second."),
)
