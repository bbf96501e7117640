"""A filter for a mass that is pushed, from three things: its model, a brake, and the distance to what is there.

python docs/examples/stopping_among_discs.py
"""

import sys

import numpy as np

from safedpa.safety import FilterSession, FilterSettings, RolloutBarrier, SafetyFilter, check_filter

PERIOD, STRONGEST = 0.05, 1.0  # s, m/s2
DISCS = np.array([[1.5, 0.2, 0.4], [1.0, 1.5, 0.4]])  # x, y, radius in m

A = np.eye(4) + PERIOD * np.eye(4, k=2)  # x, y, vx, vy
B = np.vstack((0.5 * PERIOD**2 * np.eye(2), PERIOD * np.eye(2)))


def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x[t+1] = f + g a."""
    return A @ x, B


def brake(x: np.ndarray) -> np.ndarray:
    """Takes all speed away, as quickly as it may: at rest after a finite number of ticks."""
    return np.clip(-x[2:] / PERIOD, -STRONGEST, STRONGEST)


def room(x: np.ndarray) -> np.ndarray:
    """Distance less radius; the action moves it through two integrators."""
    return np.hypot(*(DISCS[:, :2] - x[:2]).T) - DISCS[:, 2]


def main() -> str:
    """Drives at the first disc, and says how it went."""
    barrier = RolloutBarrier(model, brake, room, horizon=40, names=("near", "far"))  # at rest from 2 m/s
    settings = FilterSettings(
        action_low=(-STRONGEST, -STRONGEST), action_high=(STRONGEST, STRONGEST), eta=0.2, epsilon=0.002
    )
    safe = SafetyFilter(model, [barrier], settings, backup=barrier.backup)
    session = FilterSession(safe, period=PERIOD, states=4)  # brakes along the prediction if the state is lost
    report = check_filter(session, [[0.0, 0.0, 0.0, 0.0], [0.3, 0.1, 0.5, 0.0]])
    x, least = np.zeros(4), np.inf
    for _ in range(80):
        verdict = session.decide(x, nominal=[1.0, 0.1])
        x = A @ x + B @ verdict.action
        least = min(least, room(x).min())
    return f"{report}\nAt {x[0]:.2f}, {x[1]:.2f} m after {80 * PERIOD:g} s; least room {100 * least:.1f} cm.\n"


if __name__ == "__main__":
    sys.stdout.write(main())
