"""Attack: the same linear problems through other projects' filters: how often is an unsafe action handed on unsaid?"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa_lab.benchmarks.peer_process import interpreter_with
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.adversary.linear.judge import LinearJudge
from safedpa_lab.experiments.adversary.linear.problem import LinearProblem, random_problem

OWN: Final = "safedpa"
PEER_PACKAGES: Final[Mapping[str, str]] = {
    "cbfpy, qpax": "cbfpy",
    "run-time-assurance": "run_time_assurance",
    "cvxpy, OSQP": "cvxpy",
    "cvxpy, Clarabel": "cvxpy",
}
"""By the name in ``peer_filters``: what has to be importable."""
_ETA: Final = 0.25
_ROWS, _STATES, _ACTIONS = 6, 5, 2
_FULL: Final = 2_000
"""Problems at scale 1, and as many in mixed units."""
_SMALL: Final = 40
_UNSAFE: Final = 1e-3
"""Share of its scale by which a condition is broken, beyond what any solver's tolerance excuses."""
_REPORTS_SO: Final = ("relaxed", "violated", "fallback")
_SECONDS: Final = 600.0
_QUIET: Final = {"OMP_NUM_THREADS": "1", "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"}

Answer = tuple[list[float] | None, str]
"""The action, if there is one, and the message about it."""


@final
class Peers(AbstractAttack):
    """Each filter answers the same problems; what counts is an unsafe action that comes without a word."""

    name = "peers"
    sentence = "the same problems through other projects' filters, where they are installed"

    def __init__(self, interpreters: Sequence[str] = ()) -> None:
        self._interpreters = tuple(interpreters)

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return [(who, seed, _SMALL if small else _FULL) for who in (OWN, *PEER_PACKAGES)]

    def work(self, piece: Any) -> tuple[str, list[Row]]:  # noqa: D102
        who, seed, count = piece
        sets = {"at scale 1": peer_problems(seed, count, False), "in mixed units": peer_problems(seed, count, True)}
        rows: list[Row] = []
        for units, problems in sets.items():
            if who == OWN:
                answers = [_own(problem) for problem in problems]
            else:
                asked = _asked(who, problems, self._interpreters)
                if isinstance(asked, str):
                    return who, [Row(f"{who}: {asked}", 0.0, 0)]
                answers = asked
            rows += _rows(f"{who}, {units}", problems, answers, most=0 if who == OWN else None)
        return who, rows

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        return Result([row for _, rows in answers for row in rows])


def peer_problems(seed: int, count: int, mixed: bool) -> list[LinearProblem]:
    """Problems of two actions between -1 and 1, without margins, all of the same shapes: what every peer can state."""
    found: list[LinearProblem] = []
    number = 0
    while len(found) < count:
        problem = random_problem(seed, number)
        number += 1
        rows, states, actions = len(problem.q), len(problem.f), len(problem.low)
        if rows > _ROWS or states > _STATES or actions != _ACTIONS or problem.shape in ("parallel", "costly", "feeble"):
            continue
        width = problem.high - problem.low  # as it was drawn, not in other units
        at_scale_one = bool((problem.weights == 1.0).all() and width.max() < 4.0 and width.min() > 0.4)
        if at_scale_one is mixed:
            continue
        found.append(_padded(problem))
    return found


def _padded(problem: LinearProblem) -> LinearProblem:
    rows, states = len(problem.q), len(problem.f)
    middle, half = 0.5 * (problem.low + problem.high), 0.5 * (problem.high - problem.low)
    P, g = np.zeros((_ROWS, _STATES)), np.zeros((_STATES, _ACTIONS))
    P[:rows, :states], g[:states] = problem.P, problem.g * half
    return replace(
        problem,
        state=np.pad(problem.state, (0, _STATES - states)),
        f=np.pad(problem.f + problem.g @ middle, (0, _STATES - states)),
        g=g,
        P=P,
        q=np.pad(problem.q, (0, _ROWS - rows), constant_values=1.0),
        low=-np.ones(_ACTIONS),
        high=np.ones(_ACTIONS),
        nominal=np.clip((problem.nominal - middle) / half, -9.0, 9.0),
        weights=np.ones(_ACTIONS),
        eta=_ETA,
        epsilon=np.zeros(_ROWS),
        witness=None,
    )


def _own(problem: LinearProblem) -> Answer:
    verdict = problem.decide()
    status = verdict.status.value
    return verdict.action.tolist(), status if status in _REPORTS_SO else ""


def _asked(who: str, problems: Sequence[LinearProblem], interpreters: Sequence[str]) -> list[Answer] | str:
    """A peer's answers, or why there are none."""
    package = PEER_PACKAGES[who]
    found = interpreter_with(package, tuple(interpreters))
    if found is None:
        return f"{package} is not installed here"
    names = ("state", "f", "g", "P", "q", "nominal")
    asked = [{name: getattr(problem, name).tolist() for name in names} for problem in problems]
    question = json.dumps({"peer": who, "eta": _ETA, "problems": asked})
    script = str(Path(__file__).with_name("peer_filters.py"))
    try:
        done = subprocess.run(
            [found, script],
            input=question,
            capture_output=True,
            text=True,
            timeout=_SECONDS,
            check=False,
            env={**{name: value for name, value in os.environ.items() if name != "PYTHONPATH"}, **_QUIET},
        )
    except subprocess.TimeoutExpired:
        return f"gave no answer within {_SECONDS:.0f} s"
    if done.returncode:
        return f"failed: {(done.stderr.strip().splitlines() or ['no phrase'])[-1][:200]}"
    return [(item["action"], item["notice"]) for item in json.loads(done.stdout.strip().splitlines()[-1])]


def _rows(name: str, problems: Sequence[LinearProblem], answers: Sequence[Answer], most: float | None) -> list[Row]:
    """``most`` unsafe actions may come without a message; of a peer they are only counted."""
    unsaid, notice, none, feasible = 0, 0, 0, 0
    for problem, (action, phrase) in zip(problems, answers, strict=True):
        judge = LinearJudge(problem)
        feasible += int(judge.nearest() is not None)
        if action is None:
            none += 1
        elif _unsafe(judge, np.array(action)):
            unsaid, notice = unsaid + int(not phrase), notice + int(bool(phrase))
    return [
        Row(f"{name}: unsafe action, and not a word", unsaid, len(problems), most=most),
        Row(f"{name}: unsafe action, reported as such", notice, len(problems)),
        Row(f"{name}: no action at all", none, len(problems)),
        *([Row(f"{name}: problems that can be kept", feasible, len(problems))] if most is not None else []),
    ]


def _unsafe(judge: LinearJudge, action: np.ndarray[Any, Any]) -> bool:
    """Not finite, beyond the limits, or a condition broken: what the robot would be made to do."""
    if not np.isfinite(action).all() or bool((np.abs(action) > 1.0 + _UNSAFE).any()):
        return True
    return judge.broken(np.clip(action, -1.0, 1.0)) > _UNSAFE
