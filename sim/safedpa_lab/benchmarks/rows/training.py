"""Training data and phase 1a: pairs a second, and how long 2 x 10^7 of them take."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from safedpa_lab.benchmarks.results import Effort, Entry, Row
from safedpa_lab.benchmarks.timing import rate

_ALL = 20_000_000
_AT_ONCE = 65_536
_NO_TARGET = "no target: the row weights has one, for everything that is trained"


def measure(effort: Effort) -> Row:
    """Draws pairs for a while; trains on two numbers of pairs and scales by their difference, unless ``full``."""
    from safedpa_sim.training.configuration import load_configuration
    from safedpa_sim.training.data.transitions import draw_transitions
    from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

    configuration = load_configuration("car")
    cars = BatchedSimulator(configuration)
    generator = cars.generator(0)
    drawn = rate(lambda: draw_transitions(cars, _AT_ONCE, generator), _AT_ONCE, effort.of(0.3, 3.0))
    data = Entry(
        f"safedpa, {_ALL:.0e} pairs drawn",
        {"minutes": _ALL / drawn["per_second"] / 60.0, "pairs_per_second": drawn["per_second"]},
        "",
        note=f"{_AT_ONCE} at a time, environment, state and action of each redrawn; scaled from a few seconds",
    )
    entry = _phase_1a(configuration, effort)
    work = "training data of 2 x 10^7 pairs, and phase 1a on them"
    return Row("training", work, "minutes", (data, entry), notes=(_NO_TARGET,))


def _phase_1a(configuration: object, effort: Effort) -> Entry:
    name = f"safedpa, phase 1a on {_ALL:.0e} pairs"
    if effort.full:
        seconds = _trained(configuration, _ALL)
        return Entry(name, {"minutes": seconds / 60.0, "pairs_per_second": _ALL / seconds}, "", note="all of them")
    few, many = effort.of((10_240, 30_720), (102_400, 614_400))
    begin, end = _trained(configuration, few), _trained(configuration, many)
    slope = (end - begin) / (many - few) if end > begin else end / many  # so few that the beginning is all of it
    seconds = begin + slope * (_ALL - few)
    note = f"measured on {few} and {many} pairs ({begin:.1f} and {end:.1f} s), scaled by their difference"
    return Entry(name, {"minutes": seconds / 60.0, "pairs_per_second": _ALL / seconds}, "", note=note)


def _trained(configuration: object, pairs: int) -> float:
    """Seconds of phase 1a on so many pairs, evaluation and weights included."""
    from safedpa_sim.training.configuration import Configuration
    from safedpa_sim.training.phases.phase_1a import train_affine

    assert isinstance(configuration, Configuration)
    chosen = replace(configuration, phase_1a=replace(configuration.phase_1a, pairs=pairs))
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        train_affine(chosen, Path(folder))
        return time.perf_counter() - began
