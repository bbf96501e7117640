"""How long a decision takes, status by status, of several source trees or installations in turn.

    python deploy/filter_by_status.py before=FOLDER after=FOLDER [--model car] [--seed N] [--scenes N]

A folder holds the package ``safedpa``: ``shared`` of a tree, or what ``pip install --target`` made. Problems are drawn
by the seed: rooms with 6 to 8 obstacles, states anywhere, half of them where the least h is 0 to 0.05, nominal actions
within and beyond the actuators. A process for each folder decides them all, one process at a time and the order turned
round each time; of each problem the best time counts. Prints p50 and p99 in microseconds, their share of the first
folder's, of source that is not compiled (``SAFEDPA_COMPILE=0``) how many actions a decision looks at, and by how much
statuses and actions differ from the first folder's. Times are those of problems with one status in all folders.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

FOOTPRINT, FIELD = (0.08, 0.40, 0.12), (-4.0, 4.0, -4.0, 4.0)
CASES = 16
EDGE = 0.05
"""Of the least h, to which a state lies at the edge."""


def problems(safe: Any, latent: Values, seed: int, scenes: int) -> list[tuple[Values, Values, Values, Any]]:
    """State, nominal action, latent and barriers of each decision."""
    from safedpa.robots.car.barriers.obstacles import car_barriers

    random, drawn = np.random.default_rng(seed), list[tuple[Values, Values, Values, Any]]()
    for _ in range(scenes):
        count = int(random.integers(6, 9))
        obstacles = np.column_stack([random.uniform(-3.5, 3.5, (count, 2)), random.uniform(0.2, 0.35, count)])
        barriers = car_barriers(safe.settings, FOOTPRINT, obstacles, FIELD)
        for case in range(CASES):
            while True:
                state = random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0))
                if case % 2 or 0.0 <= min(float(part.h(state).min()) for part in barriers) < EDGE:
                    break
            nominal = random.uniform((-0.6, -0.34), (2.0, 0.34)) * random.choice([1.0, 1.4])
            drawn.append((state, nominal, latent, barriers))
    return drawn


def decide(model_name: str, seed: int, scenes: int) -> None:
    """In the process of one folder: the verdicts, then a line of times for each line that comes in."""
    from safedpa.compiled import compiled_modules
    from safedpa.dynamics import load_model
    from safedpa.safety import FilterSettings, SafetyFilter

    model: Any = load_model(model_name)
    safe = SafetyFilter.for_model(model, FilterSettings.for_robot("car"))
    drawn = problems(safe, model.latent, seed, scenes)
    compiled, reported = len(compiled_modules()), list[tuple[str, list[float], float]]()
    with looked_at(counts := not compiled and not decides_in_c()) as looks:
        for state, nominal, latent, barriers in drawn:
            before = len(looks)
            verdict = safe.decide(state, nominal, latent, barriers=barriers)
            reported.append((verdict.status.value, verdict.action.tolist(), len(looks) - before if counts else -1))
    sys.stdout.write(json.dumps([compiled, reported]) + "\n")
    sys.stdout.flush()
    for _ in sys.stdin:
        times = []
        for state, nominal, latent, barriers in drawn:
            begun = perf_counter()
            safe.decide(state, nominal, latent, barriers=barriers)
            times.append(1e6 * (perf_counter() - begun))
        sys.stdout.write(json.dumps(times) + "\n")
        sys.stdout.flush()


def decides_in_c() -> bool:
    """Whether this tree decides by compiled kernels; older ones have none."""
    try:
        from safedpa.native.library import why_not_compiled
    except ImportError:
        return False
    return not why_not_compiled()


@contextmanager
def looked_at(counts: bool) -> Iterator[list[None]]:
    """Grows by one with each action that is evaluated; a compiled class lets no one count."""
    from safedpa.safety.solver.constraints import Constraints

    evaluate: Any = Constraints.evaluate
    looks: list[None] = []

    def counted(*arguments: Any) -> Any:
        looks.append(None)
        return evaluate(*arguments)

    if counts:
        setattr(Constraints, "evaluate", counted)  # noqa: B010 - assigned by name it is a change of type
    yield looks
    if counts:
        setattr(Constraints, "evaluate", evaluate)  # noqa: B010


class Tree:
    """One folder and its process."""

    def __init__(self, name: str, folder: str, arguments: list[str]) -> None:
        command = [sys.executable, __file__, "--decide", *arguments]
        where = {**os.environ, "PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
        self.name = name
        self._process: Any = subprocess.Popen(
            command, env=where, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        compiled, reported = self._answer()
        self.phrase = f"{name} ({compiled} modules compiled)"
        self.statuses = np.array([status for status, _, _ in reported])
        self.actions = np.array([action for _, action, _ in reported])
        self.looks = np.array([looks for _, _, looks in reported], dtype=float)
        self.best = np.full(len(reported), np.inf)

    def round(self) -> None:
        """All problems again."""
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        self.best = np.minimum(self.best, self._answer())

    def close(self) -> None:
        """Ends the process."""
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> Any:
        return json.loads(self._process.stdout.readline())


def report(trees: list[Tree]) -> list[str]:
    """The lines that are printed."""
    first, lines = trees[0], list[str]()
    for tree in trees:
        apart = np.abs(tree.actions - first.actions).max(axis=1)
        other = int((tree.statuses != first.statuses).sum())
        lines.append(
            f"{tree.phrase}: {other} of {len(apart)} statuses differ, actions by {apart.max():.1e} at most, "
            f"{int((apart > 1e-6).sum())} by more than 1e-6"
        )
    alike = np.all([tree.statuses == first.statuses for tree in trees], axis=0)
    for status in sorted(set(first.statuses[alike].tolist())):
        which, shown = alike & (first.statuses == status), list[str]()
        base = np.percentile(first.best[which], [50, 99])
        for tree in trees:
            half, most = np.percentile(tree.best[which], [50, 99])
            looks = f", {tree.looks[which].mean():.1f} actions looked at" if tree.looks.min() >= 0.0 else ""
            shown.append(f"{tree.name} {half:.0f} ({half / base[0]:.2f}), {most:.0f} ({most / base[1]:.2f}){looks}")
        lines.append(f"{status}, {int(which.sum())}: " + "; ".join(shown))
    return lines


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trees", nargs="*", metavar="NAME=FOLDER")
    parser.add_argument("--model", default="car")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=40, help=f"{CASES} problems each")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--decide", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.decide:
        decide(options.model, options.seed, options.scenes)
        return
    named = [word.partition("=") for word in options.trees]
    if not named or not all(name and folder for name, _, folder in named):
        parser.error(f"got {' '.join(options.trees) or 'nothing'}, wanted NAME=FOLDER once for each tree")
    arguments = ["--model", options.model, "--seed", str(options.seed), "--scenes", str(options.scenes)]
    trees = [Tree(name, folder, arguments) for name, _, folder in named]
    for index in range(options.rounds):
        for tree in trees[:: 1 if index % 2 else -1]:
            tree.round()
    sys.stdout.write("\n".join(report(trees)) + "\n")
    for tree in trees:
        tree.close()


if __name__ == "__main__":
    main()
