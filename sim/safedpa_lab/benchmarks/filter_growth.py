"""How a decision's cost grows: over obstacles, with the peers on the same scenes, and over effects in the model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa_lab.benchmarks.filter_decisions import MODELS, decisions
from safedpa_lab.benchmarks.filter_problem import FilterProblem, problem_with
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.results import Curve, Effort

__all__ = ["over_effects", "over_obstacles"]

_COUNTS: Final = (1, 4, 16, 64, 256, 1024)
_PATIENCE_SECONDS: Final = 60.0
"""Of a peer on one scene: compiling, a few decisions, and the answer."""
_EFFECTS: Final = (
    "quadratic_drag",
    "rolling_resistance",
    "steering_offset",
    "understeer",
    "viscous_drag",
    "turning_drag",
)
Peer = tuple[str, str, str, str]
"""Name, package, its option, and script."""
Times = tuple[float | None, ...]


def over_obstacles(peers: Sequence[Peer], effort: Effort) -> Curve:
    """p50 of a decision with 1 to 1,024 obstacles, of this project and of ``peers``; None where a peer does not answer.

    A peer that gives no answer in time is not asked about more obstacles.
    """
    counts = effort.of((1, 8), _COUNTS)
    calls, seconds = effort.of((100, 0.2), (2000, 1.0))
    scenes = [problem_with(count) for count in counts]
    series: dict[str, Times] = {}
    for model, what in MODELS.items():
        times = [decisions(scene, load_model(model), calls, seconds)["wall"]["p50"] for scene in scenes]
        series[f"safedpa, {what}"] = tuple(times)
    for peer in peers:
        times_of_peer = _of_peer(peer, scenes, calls, seconds, effort.interpreters)
        if any(value is not None for value in times_of_peer):
            series[peer[0]] = times_of_peer
    return Curve("filter_obstacles", "obstacles", "one decision, p50 [us]", tuple(map(float, counts)), series)


def _of_peer(
    peer: Peer, scenes: Sequence[FilterProblem], calls: int, seconds: float, interpreters: Sequence[str]
) -> Times:
    _, package, backend, script = peer
    found: list[float | None] = []
    for scene in scenes:
        question = {"problems": [scene.question(calls, seconds, backend)]}
        reply = ask_peer(script, package, question, interpreters, _PATIENCE_SECONDS)
        if "missing" in reply:
            break
        found.append(float(reply["answers"][0]["wall"]["p50"]))
    return (*found, *[None] * (len(scenes) - len(found)))


def over_effects(problem: FilterProblem, effort: Effort) -> Curve:
    """The physics model with more and more of the library's effects in it."""
    model: Any = load_model("car")
    times = []
    calls, seconds = effort.of((100, 0.2), (3000, 1.0))
    names = _EFFECTS[: effort.of(1, len(_EFFECTS))]
    for name in ("", *names):
        model = model.with_effect(effect("car", name), {}) if name else model
        times.append(decisions(problem, model, calls, seconds)["wall"]["p50"])
    x = tuple(float(1 + number) for number in range(len(times)))
    series: dict[str, Times] = {"safedpa, physics with effects": tuple(times)}
    return Curve("filter_effects", "effects in the model", "one decision, p50 [us]", x, series)
