"""A model driven by its backup: which functions and models it takes, and that nobody writes into its states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import AbstractDynamics, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.safety import RolloutBarrier
from safedpa.safety.closed_loop import ClosedLoop, fixed, prediction_of


def halved(x: Any, latent: Any = None) -> Any:
    """Affine: a second argument that need not be given makes no step of it."""
    return 0.5 * x, np.eye(1)


def test_the_kind_of_a_function_follows_from_the_arguments_that_it_needs() -> None:
    assert ClosedLoop(halved, [1.0]).after(np.array([4.0]), np.array([1.0])) == [3.0]
    assert ClosedLoop(lambda x, a: x + 2.0 * a, [1.0]).after(np.array([4.0]), np.array([1.0])) == [6.0]


def test_an_actuator_that_changes_commands_and_remembers_nothing_is_taken() -> None:
    model = load_model("car").with_effect(effect("car", "steering_gain"), {"gain": Setting(1.1)})
    assert prediction_of(model).of_this_project


@pytest.mark.parametrize("model", [halved, load_model("car")])
def test_a_users_function_cannot_write_into_what_the_next_one_sees(model: Any) -> None:
    size, actions = (1, [0.0]) if model is halved else (4, [0.0, 0.0])
    loop = ClosedLoop(model, actions)
    for kept in (loop.after(np.ones(size), np.array(actions)), fixed(np.ones(size)), loop.action(np.ones(size))):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 7.0


@pytest.mark.parametrize("wrong", [None, 1.0, "model", [halved]], ids=["none", "number", "text", "list"])
def test_what_is_no_model_cannot_be_driven(wrong: Any) -> None:
    with pytest.raises(InputError, match=r"^model: got .*, wanted a model, a Prediction, affine"):
        RolloutBarrier(wrong, [0.0], lambda x: x[0], 2)


def test_a_backup_answers_with_a_row_of_actions() -> None:
    with pytest.raises(InputError, match=r"^backup: got shape .*, wanted"):
        ClosedLoop(lambda x, a: x + a, lambda _: [[1.0]]).action(np.zeros(1))
    assert ClosedLoop(lambda x, a: x + a, lambda _: [1.0]).action(np.zeros(1)).tolist() == [1.0]


def test_a_path_ends_where_nothing_moves() -> None:
    path = ClosedLoop(lambda x, a: np.maximum(x - 1.0, 0.0), [0.0]).path(np.array([2.0]), 50)
    assert [float(x[0]) for x in path] == [2.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize("backup", [1.0, [[1.0]], [1.0, np.inf], [np.nan]], ids=str)
def test_a_backup_that_is_one_action_is_a_vector_of_finite_numbers(backup: Any) -> None:
    with pytest.raises(InputError, match=r"^backup: got .*, wanted \(actions,\) finite numbers"):
        ClosedLoop(halved, backup)
    with pytest.raises(InputError, match=r"^latent: got .*, wanted \(actions,\) finite numbers"):
        ClosedLoop(halved, [1.0], latent=backup)


def test_the_backup_of_a_rollout_is_the_one_along_which_it_looks() -> None:
    def half(x: Any) -> Any:
        return [0.5 * x[0]]

    barrier = RolloutBarrier(lambda x, a: x - a, half, lambda x: x[0], 2)
    assert barrier.backup(np.array([3.0])).tolist() == [1.5]
    held = RolloutBarrier(lambda x, a: x - a, [0.25], lambda x: x[0], 2)
    assert held.backup(np.array([3.0])).tolist() == [0.25]


class Own(AbstractDynamics):
    """A model of one's own: a car that stays where it is."""

    def __init__(self, memory: Any) -> None:
        self.system, self.period, self.latent_names = load_model("car").system, 0.05, ()
        self._memory = memory

    def initial_memory(self, action: Any, latent: Any = None) -> Any:
        return self._memory

    def advance(self, state: Any, action: Any, memory: Any, latent: Any = None, **_: Any) -> tuple[Any, Any]:
        return state, memory

    def affine(self, state: Any, latent: Any = None, *_: Any, **__: Any) -> tuple[Any, Any]:
        return state, np.zeros((4, 2))


@pytest.mark.parametrize("memory", [None, (), (None,), ((), None), (np.empty(0), [])], ids=str)
def test_a_users_model_may_say_in_any_way_that_nothing_is_remembered(memory: Any) -> None:
    assert prediction_of(Own(memory)).system is not None


@pytest.mark.parametrize("memory", [(0.0,), (None, (1.0,)), (np.zeros(1),), ({"steer": 0.1},)], ids=str)
def test_a_users_model_whose_actuators_remember_is_refused(memory: Any) -> None:
    with pytest.raises(InputError, match=r"^model: got one of 'car' whose actuators remember"):
        prediction_of(Own(memory))
