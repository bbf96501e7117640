"""Phase 1b at small scale: it reports progress, resumes after an interruption, and needs mu."""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.policy import LearnedPolicy
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.environments import car_task
from safedpa_sim.training.environments.car_task import evaluate
from safedpa_sim.training.phases.phase_1b import train_policy

pytestmark = [pytest.mark.long, pytest.mark.slow]

SMALL = load_configuration("car_small")
SHORT = replace(
    SMALL, phase_1b=replace(SMALL.phase_1b, cars=16, batch=128, steps=1024, evaluate_every=2, evaluation_cars=8)
)


@pytest.fixture(autouse=True, scope="module")
def brief_evaluations() -> Iterator[None]:
    """Shortens drives to 2 s: these tests check how evaluations are used, not their figures.

    The last test of evaluations, and ``test_whole_pipeline.py``, drive at full length.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(car_task, "EPISODE_TICKS", 40)
        yield


@pytest.fixture(scope="module")
def weights(untrained: Callable[[Configuration], Weights]) -> Weights:
    torch.set_num_threads(1)
    return untrained(SMALL)


WHOLE = car_task.EPISODE_TICKS
ALONE: dict[str, Any] = {"with_filter": False}
"""Without the filter training takes an eighth of the time; resuming does not depend on it."""


def trained(configuration: Configuration, weights: Weights, out: Path, **options: Any):
    reported: list[tuple[str, int, int, str]] = []
    made, summary = train_policy(
        configuration, weights, out, lambda *reported_now: reported.append(reported_now), **options
    )
    return made, {**summary, "reported": reported}


@pytest.fixture(scope="module")
def short(weights: Weights, tmp_path_factory: pytest.TempPathFactory) -> tuple[Weights, dict[str, Any]]:
    """Runs a short training to its end and checks that it leaves no file behind."""
    out = tmp_path_factory.mktemp("short")
    made, summary = trained(SHORT, weights, out)
    return made, {**summary, "left": list(out.iterdir())}


def test_phase_1b_reports_progress_and_changes_only_the_policy(weights: Weights, short: Any) -> None:
    made, summary = short
    assert [step for _, step, _, _ in summary["reported"]] == [512, 1024]
    assert summary["left"] == [], "the checkpoint goes when the training is done"
    assert LearnedPolicy(made).act(np.zeros((3, made["policy.0.weight"].shape[1]))).shape == (3, 2)
    assert all(name == "1b" and most == 1024 and "reached" in note for name, _, most, note in summary["reported"])
    for name, tensor in weights.tensors.items():
        np.testing.assert_array_equal(made[name], tensor)
    assert set(made.tensors) - set(weights.tensors) == {
        *(f"policy.{index}.{part}" for index in range(3) for part in ("weight", "bias")),
        "observation_middle",
        "observation_scale",
    }


def test_the_same_seed_gives_the_same_policy_and_nothing_is_left_elsewhere(weights, short, tmp_path, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    assert trained(SHORT, weights, tmp_path)[0].digest == short[0].digest
    first, other = (
        trained(replace(SHORT, seed=seed), weights, tmp_path, **ALONE)[0].digest for seed in (SHORT.seed, 1)
    )
    assert first != other
    assert [path.name for path in elsewhere.iterdir() if "torchinductor" not in path.name] == []  # torch's own cache


def test_an_interrupted_training_resumes_from_the_last_evaluation(weights: Weights, tmp_path: Path) -> None:
    def interrupt(_name: str, done: int, _all: int, _note: str) -> None:
        if done >= 512:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy(SHORT, weights, tmp_path, interrupt)
    _, summary = trained(SHORT, weights, tmp_path)
    assert [step for _, step, _, _ in summary["reported"]] == [1024]
    assert [entry["steps"] for entry in summary["learning_curve"]] == [512, 1024]


def test_a_checkpoint_of_another_training_is_ignored_and_a_damaged_one_refused(weights, tmp_path) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy(SHORT, weights, tmp_path, interrupt, **ALONE)
    _, summary = trained(replace(SHORT, seed=1), weights, tmp_path, **ALONE)
    assert summary["reported"][0][1] == 512
    (tmp_path / "checkpoint_1b.pt").write_bytes(b"nothing of use")
    with pytest.raises(InputError, match="remove it to train from the beginning"):
        train_policy(SHORT, weights, tmp_path, **ALONE)


def test_rma_p_trains_without_the_filter(weights, short, tmp_path) -> None:
    made, summary = trained(SHORT, weights, tmp_path, name="rma_p", penalty=10.0, with_filter=False)
    assert summary["reported"][0][0] == "rma_p"
    assert made.digest != short[0].digest


def test_training_ends_when_the_policy_is_good_enough(weights: Weights, tmp_path: Path) -> None:
    easy = replace(SHORT, phase_1b=replace(SHORT.phase_1b, enough=0.0))
    _, summary = trained(easy, weights, tmp_path, **ALONE)
    assert len(summary["learning_curve"]) == 1


def test_evaluation_repeats_and_counts_by_footprint(short: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made, _ = short
    monkeypatch.setattr(car_task, "EPISODE_TICKS", WHOLE)
    figures = evaluate(SHORT, made, cars=32, seed=3)
    assert figures == evaluate(SHORT, made, cars=32, seed=3)
    assert set(figures["success_by_radius"]) <= {"0.12", "0.25", "0.35", "0.45"}
    assert 0.0 <= figures["success"] <= 1.0


def test_weights_without_mu_are_refused(weights: Weights, tmp_path: Path) -> None:
    without = Weights({k: v for k, v in weights.tensors.items() if not k.startswith("mu")}, weights.description)
    with pytest.raises(InputError, match="without mu"):
        train_policy(SHORT, without, tmp_path)
