"""A model driven by its backup: which functions and models it takes, and that nobody writes into its states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.safety.closed_loop import ClosedLoop, fixed, prediction_of


def halved(x: Any, latent: Any = None) -> Any:
    """Affine: a second argument that need not be given makes no step of it."""
    return 0.5 * x, np.eye(1)


def test_a_function_is_told_by_the_arguments_that_it_needs() -> None:
    assert ClosedLoop(halved, [1.0]).after(np.array([4.0]), np.array([1.0])) == [3.0]
    assert ClosedLoop(lambda x, a: x + 2.0 * a, [1.0]).after(np.array([4.0]), np.array([1.0])) == [6.0]


def test_an_actuator_that_changes_commands_and_remembers_nothing_is_taken() -> None:
    model = load_model("car").with_effect(effect("car", "steering_gain"), {"gain": Setting(1.1)})
    assert prediction_of(model).of_this_project


@pytest.mark.parametrize("model", [halved, load_model("car")])
def test_nobody_writes_into_what_the_next_one_sees(model: Any) -> None:
    size, actions = (1, [0.0]) if model is halved else (4, [0.0, 0.0])
    loop = ClosedLoop(model, actions)
    for kept in (loop.after(np.ones(size), np.array(actions)), fixed(np.ones(size)), loop.action(np.ones(size))):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 7.0


def test_a_path_ends_where_nothing_moves() -> None:
    path = ClosedLoop(lambda x, a: np.maximum(x - 1.0, 0.0), [0.0]).path(np.array([2.0]), 50)
    assert [float(x[0]) for x in path] == [2.0, 1.0, 0.0, 0.0]
