"""A unicycle drives among discs: a plain distance stalls it, a barrier at a point ahead lets it pass.

python docs/examples/unicycle_among_discs.py [PICTURE.png]
"""

import sys

import numpy as np

from safedpa.safety import FilterSettings, FunctionBarrier, LookAheadBarrier, SafetyFilter, check_filter

PERIOD = 0.05  # s
DISCS = np.array([[1.0, 0.05, 0.3], [2.0, -0.3, 0.25], [2.2, 0.8, 0.3]])  # x, y, radius in m
NAMES = ("first", "second", "third")
GOAL = np.array([3.0, 0.0])  # m
SETTINGS = FilterSettings(
    action_low=(0.0, -2.0), action_high=(0.5, 2.0), backup_action=(0.0, 0.0), eta=0.2, epsilon=0.002
)


def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x[t+1] = f + g a; the state is x, y, yaw, the action speed [m/s] and turn rate [rad/s]."""
    return x, PERIOD * np.array([[np.cos(x[2]), 0.0], [np.sin(x[2]), 0.0], [0.0, 1.0]])


def room(x: np.ndarray) -> np.ndarray:
    """Distance to each disc [m]; a turn changes the position only one step later, so h does not depend on it."""
    return np.hypot(*(DISCS[:, :2] - x[:2]).T) - DISCS[:, 2] - 0.1


def to_goal(x: np.ndarray) -> np.ndarray:
    """Nominal action: drives straight at the goal, and knows no discs."""
    error = np.arctan2(GOAL[1] - x[1], GOAL[0] - x[0]) - x[2]
    return np.array([0.5, 2.0 * np.arctan2(np.sin(error), np.cos(error))])


def drive(safe: SafetyFilter, seconds: float = 15.0) -> np.ndarray:
    """States (k, 3) of one drive to the goal."""
    states = [np.array([0.0, 0.0, 0.0])]
    while np.hypot(*(GOAL - states[-1][:2])) > 0.1 and len(states) < seconds / PERIOD:
        f, g = model(states[-1])
        states.append(f + g @ safe.decide(states[-1], nominal=to_goal(states[-1])).action)
    return np.array(states)


def drives() -> dict[str, np.ndarray]:
    """The same drive with both barriers."""
    plain = FunctionBarrier(room, names=NAMES)
    barriers = {"plain distance": plain, "look-ahead": LookAheadBarrier(plain, ahead=0.15)}
    return {name: drive(SafetyFilter(model, [barrier], SETTINGS)) for name, barrier in barriers.items()}


def picture(path: str, paths: dict[str, np.ndarray]) -> None:
    """Draws the paths among the discs."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    axes = (figure := Figure(figsize=(6.4, 3.2), layout="constrained")).subplots()
    for x, y, radius in DISCS:
        axes.add_patch(Circle((x, y), radius, color="0.75"))
    for name, states in paths.items():
        axes.plot(states[:, 0], states[:, 1], label=name)
    axes.plot(*GOAL, "k*", label="goal")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", ylim=(-0.8, 1.3))
    axes.legend(loc="upper left")
    figure.savefig(path, dpi=100)


def main(arguments: list[str]) -> str:
    """Drives twice, and reports what check_filter says of the plain distance."""
    paths = drives()
    if arguments:
        picture(arguments[0], paths)
    lines = [
        f"{name}: ends at {states[-1, 0]:.2f}, {states[-1, 1]:.2f} m after {PERIOD * (len(states) - 1):.1f} s; "
        f"least distance {100 * min(room(x).min() for x in states):.1f} cm"
        for name, states in paths.items()
    ]
    found = check_filter(SafetyFilter(model, [FunctionBarrier(room, names=NAMES)], SETTINGS), [0.2, 0.0, 0.0])
    return "\n".join([*lines, "check_filter, plain distance:", str(found)]) + "\n"


if __name__ == "__main__":
    sys.stdout.write(main(sys.argv[1:]))
