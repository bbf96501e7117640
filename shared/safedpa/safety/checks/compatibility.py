"""Checks that settings, barriers and model belong to one robot: once, when a filter is made, never during a drive.

A filter of the wrong robot would read a height as a heading and call the result safe. So settings name the system that
they were made for, barriers name the states that they read, and a mismatch is refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError, did_you_mean
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.settings import FilterSettings
from safedpa.safety.validation import checked_output
from safedpa.systems import System, systems
from safedpa.systems.robots import robots

__all__ = [
    "check_backup",
    "check_barriers",
    "check_margins",
    "check_reads",
    "check_settings",
    "check_settings_of_functions",
    "known_kinds",
]


def known_kinds() -> tuple[str, ...]:
    """The kinds of barriers of all known robots and of the library: settings may hold margins for kinds not in use."""
    return tuple(sorted({"function", "rollout", *(kind for robot in robots().values() for kind in robot.kinds)}))


def check_settings(settings: FilterSettings, system: System) -> None:
    """Raises InputError unless the settings were made for this system and its actions can take their bounds.

    Settings that name no system are checked by their bounds alone.
    """
    if not isinstance(settings, FilterSettings):
        raise InputError(f"settings: got {type(settings).__name__}, wanted FilterSettings")
    # An empty name means the user's own system, which cannot be compared by name.
    if settings.system and settings.system != system.name:
        raise InputError(
            f"settings: made for the system '{settings.system}', the model is of '{system.name}' "
            f"({_listed(system.state_names)}; {_listed(system.action_names)}); wanted settings with "
            f'system = "{system.name}" and the bounds of its actions'
        )
    if len(settings.action_low) != len(system.action):
        raise InputError(
            f"settings: got bounds of {len(settings.action_low)} actions, the system '{system.name}' has "
            f"{len(system.action)} ({_listed(system.action_names)}); wanted as many in action_low and action_high"
        )
    # Bounds beyond the model's range would let the filter rely on actions that the model has never seen.
    for variable, low, high in zip(system.action, settings.action_low, settings.action_high, strict=True):
        if low < variable.low or high > variable.high:
            raise InputError(
                f"settings: got bounds of {low:g} to {high:g} {variable.unit} for {variable.name}, the system "
                f"'{system.name}' takes {variable.low:g} to {variable.high:g}; wanted bounds within these"
            )


def check_settings_of_functions(
    settings: FilterSettings, states: Sequence[str], barriers: Sequence[AbstractBarrier] | None
) -> None:
    """As ``check_settings`` for a user's functions, whose system is not known.

    Settings that name a known system are accepted only if ``states`` (the names of the entries, if given) or what a
    barrier reads show that the functions belong to it. Raises InputError otherwise.
    """
    if not isinstance(settings, FilterSettings):
        raise InputError(f"settings: got {type(settings).__name__}, wanted FilterSettings")
    system = systems().get(settings.system)
    if system is None:
        return
    # Either source may name the states; one that matches is enough, since both would have to be wrong otherwise.
    reported = [tuple(states), *(part.reads for part in barriers or ())]
    if system.state_names not in reported:
        raise InputError(
            f"settings: made for the system '{system.name}' ({_listed(system.state_names)}; "
            f"{_listed(system.action_names)}), which the given functions do not say to be; wanted action_low and "
            "action_high of their own actions, and no system"
        )


def check_barriers(barriers: Any, states: Sequence[str]) -> tuple[AbstractBarrier, ...] | None:
    """The barriers of a filter as a tuple; None if every decision passes its own.

    Raises InputError if there is none, or one that is no barrier or reads other states.
    """
    if barriers is None:
        return None
    if not isinstance(barriers, Sequence):
        raise InputError(f"barriers: got {type(barriers).__name__}, wanted a list of them")
    check_reads(barriers, states)
    for part in barriers:
        _check_named(part)
    # A barrier may be empty for now (no obstacle in sight), but not all of them: nothing would be enforced.
    if not any(part.names for part in barriers):
        raise InputError(
            "barriers: got none, wanted at least one, or None in place of the list where every decision brings its own"
        )
    return tuple(barriers)


def check_reads(barriers: Iterable[Any], states: Sequence[str], entries: int | None = None) -> None:
    """Raises InputError unless each barrier reads the first of these states, by name and in order.

    Without names only their number can be compared, once it is known: it must then be that of the barrier.
    """
    for part in barriers:
        if not isinstance(part, AbstractBarrier):
            raise InputError(f"barriers: got one of type {type(part).__name__}, wanted an AbstractBarrier")
        reads = tuple(part.reads)
        if not reads:
            continue
        if states:
            # Only the first entries are compared: a model may have further states that no barrier reads.
            if tuple(states[: len(reads)]) != reads:
                raise InputError(
                    f"barrier '{part.kind}': reads the states {_listed(reads)}, the model has {_listed(states)}; "
                    "wanted a barrier that is written for these"
                )
        elif entries is not None and entries != len(reads):
            raise InputError(
                f"barrier '{part.kind}': reads the states {_listed(reads)}, got a state of {entries} entries; wanted "
                f"{len(reads)}, or the names of the states in state_range"
            )


def _check_named(part: AbstractBarrier) -> None:
    """Raises InputError if a user's barrier lacks its kind or the names of its values."""
    kind, names = getattr(part, "kind", None), getattr(part, "names", None)
    if not isinstance(kind, str):
        raise InputError(f"barrier {type(part).__name__}: got kind {kind!r}, wanted the name of its margin in epsilon")
    if not isinstance(names, (tuple, list)) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"barrier '{kind}': got names {names!r}, wanted a tuple with one for each value of h, such as ('wall',)"
        )


def check_margins(epsilon: Mapping[str, float], barriers: Sequence[AbstractBarrier] | None) -> None:
    """Raises InputError for a margin of a kind without barriers: a misspelt kind would leave its barrier unprotected.

    If the barriers are not known yet, only a name that resembles that of a known kind is refused; with an empty list,
    every unknown kind.
    """
    kinds = known_kinds()
    if barriers is None:
        # Barriers come later with each decision, so an unknown kind may be valid; a near miss of a known one is a
        # typing error.
        without = [kind for kind in kinds if kind not in epsilon]
        foreign = [kind for kind in epsilon if kind not in (*kinds, "default") and get_close_matches(kind, without)]
        known: set[str] = set(kinds)
    else:
        known = {part.kind for part in barriers if part.names} or set(kinds)
        foreign = [kind for kind in epsilon if kind not in known and kind not in (*kinds, "default")]
    if foreign:
        raise InputError(
            f"epsilon.{foreign[0]}: no barrier is of this kind, so the margin would protect nothing; "
            f"{did_you_mean(foreign[0], known)}"
        )


def check_backup(backup: Callable[[NDArray[np.float64] | None], Any] | None, actions: int) -> None:
    """Raises InputError if a backup without a state returns anything but (actions,) finite numbers.

    A backup that raises without a state is accepted: the resting action is used in that case.
    """
    if backup is None:
        return
    if not callable(backup):
        raise InputError(f"backup: got {type(backup).__name__}, wanted a function of the state or None")
    try:
        # The filter calls it without a state if the state is unusable, so the answer for None is checked as well.
        answer = backup(None)
    except Exception:  # noqa: BLE001 - a user's function may need a state, and raise anything without one
        return
    action = checked_output("backup", answer)
    if action.shape != (actions,) or not np.isfinite(action).all():
        raise InputError(f"backup: got {action.tolist()}, wanted {actions} finite numbers, one for each action")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"
