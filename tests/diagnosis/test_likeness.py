"""How much alike two explanations are: a cosine, by numpy's own and by what any cosine keeps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.trial import likeness


def trial(explained: Any) -> Any:
    return SimpleNamespace(explained=np.asarray(explained, dtype=float))


@pytest.mark.parametrize("seed", range(5))
def test_it_is_numpys_correlation_of_what_has_no_mean(seed: int) -> None:
    random = np.random.default_rng(seed)
    one, other = random.normal(0.0, 3.0, 50), random.normal(0.0, 0.2, 50)
    one, other = one - one.mean(), other - other.mean()
    assert likeness(trial(one), trial(other)) == pytest.approx(np.corrcoef(one, other)[0, 1])


@pytest.mark.parametrize("factor", [1e-6, 0.3, 7.0, 1e6])
def test_what_explains_the_same_in_another_size_is_one_and_its_opposite_minus_one(factor: float) -> None:
    """Its unit has no say: two effects are told apart by where they act, not by how much."""
    one = np.random.default_rng(1).normal(1.0, 2.0, (20, 3))
    assert likeness(trial(one), trial(factor * one)) == pytest.approx(1.0)
    assert likeness(trial(one), trial(-factor * one)) == pytest.approx(-1.0)
    assert likeness(trial(factor * one), trial(one)) == pytest.approx(1.0)


def test_what_acts_elsewhere_is_nothing_alike_and_what_explains_nothing_is_like_nothing() -> None:
    assert likeness(trial([3.0, 0.0]), trial([0.0, 5.0])) == 0.0
    assert likeness(trial([0.0, 0.0]), trial([1.0, 5.0])) == 0.0
