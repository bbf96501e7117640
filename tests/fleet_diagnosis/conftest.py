"""Outcomes of robots made up, and one small fleet that was really diagnosed."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from safedpa.fleet.outcome import EffectEvidence, Number, RobotOutcome
from safedpa_lab.experiments.fleet.diagnosis import fleet_diagnosis_experiment

UNITS = {"deceleration": "m/s2", "mass_ratio": "1", "angle": "rad", "ax": "m/s2", "ay": "m/s2", "coefficient": "1/m"}


def tried(effect: str, score: float = 8.0, std: float = 0.002, equals: tuple[str, ...] = (), **values: float):
    numbers = {name: Number(value, std, UNITS[name]) for name, value in values.items()}
    return EffectEvidence(effect, numbers, score, equals, {})


def robot(name: str, *found: EffectEvidence, status: str = "diagnosed", **more: Any) -> RobotOutcome:
    evidence = min((item.score for item in found), default=0.5)
    common = {
        "evidence": evidence, "trials": 29, "error_before": 0.2 if found else 0.02, "error_after": 0.02, "last": {},
    }  # fmt: skip
    return RobotOutcome(name, status, "", tuple(found), **(common | more))


@pytest.fixture
def make_tried() -> Callable[..., EffectEvidence]:
    return tried


@pytest.fixture
def make_robot() -> Callable[..., RobotOutcome]:
    return robot


@dataclass(frozen=True)
class Small:
    """A fleet of five, its diagnosis and what the experiment made of it."""

    folder: Path
    result: dict[str, Any]

    @property
    def out(self) -> Path:
        return self.folder / "diagnosis"

    @property
    def arguments(self) -> list[str]:
        return [str(self.folder / "model.toml"), "--fleet", str(self.folder / "recordings"), "--out", str(self.out)]


@pytest.fixture(scope="session")
def small_fleet(tmp_path_factory) -> Small:
    folder = tmp_path_factory.mktemp("fleet")
    result = fleet_diagnosis_experiment(5, 3, folder, jobs=1, hard=False, runs=2, seconds=15.0)
    return Small(folder, result)
