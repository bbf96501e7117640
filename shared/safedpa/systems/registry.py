"""The registry of systems: those of robots and of users; which of them ``safedpa up`` can drive."""

from __future__ import annotations

from safedpa.errors import InputError
from safedpa.systems.robots import forget_robot, robots
from safedpa.systems.system import System

REGISTERED: dict[str, System] = {}
"""The user's systems in this process, by name."""


def systems() -> dict[str, System]:
    """Returns all systems by name; of a robot with several sets of actions, the first."""
    return {**REGISTERED, **{name: robot.system for name, robot in robots().items()}}


def add_system(system: System) -> None:
    """Registers a user's system; the same name again replaces it, and also a user's robot of that name.

    Raises InputError if it has no state, repeats a name, has reversed bounds or an angle that is not in radians, names
    a rotation that is not four of its states, or has the name of a shipped robot.
    """
    names = ["t", *system.state_names, *system.action_names]
    if not system.name.isidentifier() or not all(name.isidentifier() for name in names):
        raise InputError(f"system '{system.name}': names: got {names[1:]}, wanted letters, digits and underscores")
    if not system.state:
        raise InputError(f"system '{system.name}': state: got none, wanted at least one Variable")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"system '{system.name}': '{min(twice)}' stands twice (t is the time); choose other names")
    for variable in (*system.state, *system.action):
        if not variable.low < variable.high:
            raise InputError(
                f"system '{system.name}': '{variable.name}': got bounds {variable.low:g} to {variable.high:g}, wanted "
                "the lower one first"
            )
        if variable.angle and variable.unit != "rad":
            raise InputError(
                f"system '{system.name}': '{variable.name}': got an angle in '{variable.unit}', wanted 'rad': a whole "
                "turn is 2 pi here; declare rad, and name the log's unit in a column map"
            )
    for entries in system.rotations:
        if len(set(entries)) != 4 or not set(entries) <= set(system.state_names):
            raise InputError(
                f"system '{system.name}': rotations: got {', '.join(entries)}, wanted four states, the entries "
                "w, x, y, z of a unit quaternion"
            )
    forget_robot(system.name)
    REGISTERED[system.name] = system


def why_not_driven(system: System, robot: str) -> str:
    """Returns why ``up`` rejects a model of this system: what it is, what is wanted; empty: it can be driven."""
    known = robots()
    is_ = f"a {system.name} with {', '.join(system.action_names)} (states {', '.join(system.state_names)})"
    if robot not in known:
        return f"{is_}, wanted one of {', '.join(known)}"
    driven = known[robot].of_system(system).system
    if (system.name, system.state_names, system.action_names) == (robot, driven.state_names, driven.action_names):
        return ""
    wanted = " or ".join(", ".join(one.system.action_names) for one in (known[robot], *known[robot].variants))
    return f"{is_}, wanted a {robot} with {wanted} (states {', '.join(driven.state_names)})"
