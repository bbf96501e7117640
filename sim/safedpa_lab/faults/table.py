"""The table of faults."""

from __future__ import annotations

import random

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.faults.fault import Fault
from safedpa_lab.faults.model_changes import partitioned_changes
from safedpa_lab.faults.network import bent, cut, disconnected
from safedpa_lab.faults.processes import hung, killed, paused, twins
from safedpa_lab.faults.resources import clocks, disks, overload

__all__ = ["all_faults", "faults_for", "faults_named", "small_faults"]

_SHORTEST_SECONDS = 2.5
"""That a fault takes, with the second that is waited for afterwards."""


def all_faults() -> list[Fault]:
    """Every fault, kind by kind; those that need the stand-in for the diagnosis last."""
    return [
        *killed(), *paused(), *hung(), *twins(), *disconnected(), *cut(), *bent(), *disks(), *clocks(), *overload(),
        *partitioned_changes(),
    ]  # fmt: skip


def small_faults() -> list[Fault]:
    """At least one of every kind that a machine can bring about within seconds."""
    return [fault for fault in all_faults() if fault.small]


def faults_for(seconds: float, seed: int) -> list[Fault]:
    """Enough for so long, in rounds of all that one fleet can suffer, each in an order of its own by the seed.

    Those that need the stand-in for the diagnosis would ask for another fleet, and are left out.
    """
    once = [fault for fault in all_faults() if fault.diagnosis == "real"]
    chance, faults = random.Random(seed), list[Fault]()
    while len(faults) < seconds / _SHORTEST_SECONDS:
        faults += chance.sample(once, len(once))
    return faults


def faults_named(name: str) -> list[Fault]:
    """One fault by its name, or all of a kind (first word), such as ``kill``. Raises InputError for another name."""
    faults = all_faults()
    found = [fault for fault in faults if name in (fault.name, fault.kind)]
    if not found:
        names = [fault.name for fault in faults]
        raise InputError(f"--only '{name}': {did_you_mean(name, [*names, *dict.fromkeys(f.kind for f in faults)])}")
    return found
