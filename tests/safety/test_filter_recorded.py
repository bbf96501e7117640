"""The filter decides as it did when ``recorded_verdicts.json`` was written: what makes it faster must not change it.

Run this file as a script to write the recording again, after a change that is meant to change decisions.
"""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import AbstractBarrier, FilterSettings, SafetyFilter, Verdict

RECORDING = Path(__file__).with_name("recorded_verdicts.json")
FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
SCENES, CASES, TIGHT = 30, 10, 7


def verdict_on(safe: SafetyFilter, scene: list[list[float]], case: dict[str, Any]) -> Verdict:
    barriers = car_barriers(safe.settings, FOOTPRINT, scene, FIELD)
    return safe.decide(case["state"], case["nominal"], case["latent"], barriers=barriers)


def answer(verdict: Verdict) -> dict[str, Any]:
    """What is recorded of a verdict."""
    return {
        "status": verdict.status.value, "reason": verdict.reason, "active": list(verdict.active),
        "action": verdict.action.tolist(), "slack": verdict.slack, "h_now": verdict.h_now, "h_next": verdict.h_next,
        "solver": verdict.solver,
    }  # fmt: skip


def drawn_state(random: np.random.Generator, barriers: Sequence[AbstractBarrier], tight: bool) -> list[float]:
    """Anywhere; or ``tight``: where the least h is 0 to 0.05, the margin's own boundary layer."""
    while True:
        state = np.round(random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0)), 3)
        if not tight or 0.0 <= min(part.h(state).min() for part in barriers) < 0.05:
            return list(state.tolist())


def record() -> None:
    """Random scenes of 6 to 8 obstacles, random states inside, outside and at the edge of the safe set, ordinary and
    extreme nominal actions."""
    random, safe = np.random.default_rng(20), SafetyFilter.for_model(load_model("car"), FilterSettings.for_robot("car"))
    scenes = []
    for index in range(SCENES):
        count = 6 + index % 3
        obstacles = np.column_stack([random.uniform(-3.5, 3.5, (count, 2)), random.uniform(0.2, 0.35, count)])
        scene = np.round(obstacles, 3).tolist()
        cases = []
        barriers = car_barriers(safe.settings, FOOTPRINT, scene, FIELD)
        for number in range(CASES + TIGHT):
            spread = 1.0 if random.random() < 0.7 else 1.4
            case: dict[str, Any] = {
                "state": drawn_state(random, barriers, number >= CASES),
                "nominal": np.round(random.uniform((-0.6, -0.34), (2.0, 0.34)) * spread, 3).tolist(),
                "latent": np.round(random.uniform((0.0, 0.0), (1.0, 4.0)), 3).tolist(),
            }
            cases.append({**case, "verdict": answer(verdict_on(safe, scene, case))})
        scenes.append({"obstacles": scene, "cases": cases})
    lines = ",\n".join(json.dumps(scene) for scene in scenes)
    RECORDING.write_text(f"[\n{lines}\n]\n", encoding="utf-8")


@pytest.fixture(scope="module")
def recorded() -> list[dict[str, Any]]:
    scenes: list[dict[str, Any]] = json.loads(RECORDING.read_text(encoding="utf-8"))
    return scenes


def test_decisions_are_those_recorded(recorded: list[dict[str, Any]]) -> None:
    safe = SafetyFilter.for_model(load_model("car"), FilterSettings.for_robot("car"))
    for scene in recorded:
        for case in scene["cases"]:
            found, wanted = answer(verdict_on(safe, scene["obstacles"], case)), case["verdict"]
            for phrase in ("status", "reason", "active", "solver"):
                assert found[phrase] == wanted[phrase], case
            for numbers in ("action", "slack", "h_now", "h_next"):
                np.testing.assert_allclose(found[numbers], wanted[numbers], rtol=0.0, atol=1e-6, err_msg=str(case))


def test_the_recording_holds_every_kind_of_decision(recorded: list[dict[str, Any]]) -> None:
    verdicts = [case["verdict"] for scene in recorded for case in scene["cases"]]
    assert len(verdicts) == SCENES * (CASES + TIGHT)
    kinds = Counter(verdict["status"] for verdict in verdicts)
    assert set(kinds) == {"passed", "corrected", "relaxed", "violated"}
    assert min(kinds.values()) >= 30
    reasons = {verdict["reason"] for verdict in verdicts}
    assert len(reasons) >= 4


if __name__ == "__main__":
    record()
