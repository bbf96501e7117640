"""The model as the filter asks for it: the next state, and its tangent in the action.

A model that is affine in the action, at one state: where any action leads is a few products of known numbers.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel
from safedpa.errors import InputError
from safedpa.safety.prediction.dead_time import ActuatorModel, EffectStart
from safedpa.safety.validation import checked_output
from safedpa.systems import System

__all__ = [
    "AffineMotion",
    "Prediction",
]

_IMAGINARY = 1e-30
"""As ``_IMAGINARY`` of ``safedpa.dynamics.tangent``: with it the slopes are those of complex steps to the last bit."""


@final
class AffineMotion:
    """x[t+1] = x + period (f + g a) / trained_period, in the order in which the recorded equations compute it.

    ``known`` holds f (states,), then g (states, actions) row by row, for one state x (states,).
    """

    def __init__(self, state: tuple[float, ...], known: list[float], period: float, trained_period: float) -> None:
        self._state, self._known = state, known
        self._period, self._trained_period = period, trained_period
        self._actions = len(known) // len(state) - 1

    def after(self, action: Sequence[float]) -> list[float]:
        """x[t+1] (states,) under ``action`` (actions,)."""
        known, state, actions = self._known, self._state, self._actions
        states = len(state)
        place = states
        reached: list[float] = []
        for row in range(states):
            felt = 0.0
            for column in range(actions):
                felt += known[place] * action[column]
                place += 1
            reached.append(state[row] + self._period * ((known[row] + felt) / self._trained_period))
        return reached

    def slopes(self) -> list[list[float]]:
        """d(x[t+1])/d(a) (states, actions), the same about every action."""
        known, actions = self._known, self._actions
        place = len(self._state)
        rows: list[list[float]] = []
        for _ in range(len(self._state)):
            row: list[float] = []
            for _ in range(actions):
                nudge = self._period * (known[place] * _IMAGINARY / self._trained_period)
                row.append(nudge / _IMAGINARY)
                place += 1
            rows.append(row)
        return rows


@final
class Prediction:
    """x[t+1] = step(x, a), or f + g a where there is no ``step``; and (f, g) = affine(x) about an action.

    ``affine`` takes (state), (state, latent) and, if it has them, the keywords ``around`` (the action about which to
    linearise) and ``memory``; it returns f (states,) and g (states, actions). ``step`` takes (state, action), (state,
    action, latent) and, if it has it, ``memory``. Raises InputError for what is no function, or does not tell what it
    takes, and when asked for numbers of another shape.
    """

    def __init__(self, affine: Callable[..., Any], step: Callable[..., Any] | None = None) -> None:
        self._affine, self._step = affine, step
        self._affine_counts, self._affine_text = _accepted("affine", affine, 2)
        self._step_counts, self._step_text = ((0, 0), frozenset[str]()) if step is None else _accepted("step", step, 3)
        self._model: AbstractDynamics | None = None
        self.system: System | None = None
        """Of a model of this project; functions alone do not say of which they are."""
        self._physics: PhysicsModel | None = None
        self._fixed: tuple[float, ...] = ()
        self._recorded_step: Any = None
        self._recorded_tangent: Any = None
        self._learned: LearnedBase | None = None
        self._actuators: ActuatorModel | None = None
        self.affine = step is None and "around" not in self._affine_text
        """Whether the model is known to be affine in the action: then its slopes are the same about every action."""

    @classmethod
    def of_model(cls, model: AbstractDynamics) -> Prediction:
        """The prediction of a model of this project, with what its actuators remember."""
        prediction = cls(model.affine)
        prediction._model, prediction.system, prediction.affine = model, model.system, False
        if isinstance(model, PhysicsModel):
            prediction._physics, prediction._fixed = model, tuple(model.latent.tolist())
            prediction._actuators = ActuatorModel(model)
            if isinstance(model.base, LearnedBase) and not model.effects:
                prediction.affine = True
                prediction._learned = model.base if model.base.is_latent(model.latent_names) else None
        return prediction

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is made again: what is compiled cannot be made without its arguments."""
        if self._model is not None:
            return Prediction.of_model, (self._model,)
        return Prediction, (self._affine, self._step)

    @property
    def timed(self) -> bool:
        """Whether the model depends on the time since the start of the run."""
        return self._physics is not None and self._physics.timed

    def report_time(self, seconds: float) -> None:
        """Seconds since the start of the run, for the questions that follow."""
        if self._physics is not None:
            self._physics.clock.seconds = seconds

    @property
    def remembers(self) -> bool:
        """Whether what follows from a state depends on what actuators remember."""
        return self._actuators is not None and self._actuators.remember

    def dead_time(self, latent: tuple[float, ...] | None) -> float:
        """s from where an action is put in force until its slowest channel begins to act; 0: at once, or not known."""
        return 0.0 if self._actuators is None else self._actuators.dead_time(latent)

    def begin(self, state: tuple[float, ...], latent: tuple[float, ...] | None, memory: Any) -> EffectStart | None:
        """Where an action that is chosen at ``state`` begins to act; None: there and then."""
        return None if self._actuators is None or not memory else self._actuators.begin(state, latent, memory)

    def after(self, begin: EffectStart, action: Sequence[float], latent: tuple[float, ...] | None) -> list[float]:
        """(begin.rows * states,) what is judged of ``action``: the state after each period from ``begin.near`` on."""
        assert self._actuators is not None
        return self._actuators.after(begin, action, latent)

    def slopes_after(
        self, begin: EffectStart, around: Sequence[float], latent: tuple[float, ...] | None
    ) -> list[list[float]]:
        """d(after)/d(action) (begin.rows * states, actions) about the action ``around``."""
        assert self._actuators is not None
        return self._actuators.slopes(begin, around, latent)

    @property
    def of_this_project(self) -> bool:
        """Whether it came from ``of_model``."""
        return self._model is not None

    def sensitivity_of_one(
        self, state: Sequence[float], around: Sequence[float], latent: tuple[float, ...] | None
    ) -> list[list[float]] | None:
        """Slopes of the next state in state and action (states, states + actions), by recorded equations, or None.

        Raises ValueError or ArithmeticError for numbers that Python's math refuses.
        """
        physics = self._physics
        if physics is None or (recorded := physics.straight_sensitivity) is None:
            return None
        return recorded(state, around, self._fixed if latent is None else latent, physics.clock.seconds)[1]

    def affine_motion(self, state: tuple[float, ...], latent: tuple[float, ...] | None) -> AffineMotion | None:
        """All of ``following`` and ``slopes_of_one`` at this state; None: ask those.

        Only of a model that is known to be affine, without effects. The networks are asked once.
        """
        base, model = self._learned, self._physics
        if base is None or model is None:
            return None
        free = self._fixed if latent is None else latent
        if len(state) != len(model.system.state_names) or len(free) != len(model.latent_names):
            return None
        try:
            known = base.known_at(state, free)
        except (ValueError, ArithmeticError):  # numbers that Python's math refuses
            return None
        return AffineMotion(state, known, model.period, base.weights.description.period)

    def following(
        self, state: tuple[float, ...], action: Sequence[float], latent: tuple[float, ...] | None, memory: Any
    ) -> list[float]:
        """``next_state`` for plain numbers. Raises InputError when the model returns another shape."""
        physics, step = self._physics, self._recorded_step
        if step is None and physics is not None:  # once there is one it stays
            step = self._recorded_step = physics.straight(physics.period)
        if step is not None and physics is not None:
            try:
                after: list[float] = step(
                    state, action, self._fixed if latent is None else latent, physics.clock.seconds
                )
                return after
            except (ValueError, ArithmeticError):  # numbers that Python's math refuses
                pass
        given = None if latent is None else _unwritten(latent)
        found = self.next_state(_unwritten(state), _unwritten(action), given, memory)
        reached: list[float] = _plain("predicted state", found, (len(state),))
        return reached

    def slopes_of_one(
        self, state: tuple[float, ...], around: Sequence[float], latent: tuple[float, ...] | None, memory: Any
    ) -> list[list[float]]:
        """``slopes`` for plain numbers. Raises InputError when the model returns another shape."""
        physics, tangent = self._physics, self._recorded_tangent
        if tangent is None and physics is not None:
            tangent = self._recorded_tangent = physics.straight_tangent()
        if tangent is not None and physics is not None:
            try:
                free = self._fixed if latent is None else latent
                slopes: list[list[float]] = tangent(state, around, free, physics.clock.seconds)[1]
                return slopes
            except (ValueError, ArithmeticError):
                pass
        given = None if latent is None else _unwritten(latent)
        found = self.slopes(_unwritten(state), _unwritten(around), given, memory)
        g: list[list[float]] = _plain("g of the model", found, (len(state), len(around)))
        return g

    def next_state(self, state: FloatArray, action: FloatArray, latent: FloatArray | None, memory: Any) -> FloatArray:
        """x[t+1] (states,) under ``action`` (actions,)."""
        model = self._model
        if model is not None:
            cached = model.initial_memory(action) if memory is None else memory
            return checked_output("predicted state", model.advance(state, action, cached, latent)[0])
        if self._step is None:
            f, g = self._tangent(state, action, latent, memory)
            states = len(state)
            if f.shape != (states,) and (f.ndim != 0 or states != 1):
                raise InputError(f"f of the model: got shape {f.shape}, wanted {(states,)}")
            if g.shape != (states, len(action)):  # numpy would add one number to every entry of the state
                raise InputError(f"g of the model: got shape {g.shape}, wanted {(states, len(action))}")
            return np.asarray(f + g @ action)
        phrase = {"memory": memory} if "memory" in self._step_text else {}
        found = self._step(*(state, action, latent)[: self._step_counts[latent is not None]], **phrase)
        return checked_output("predicted state", found)

    def slopes(self, state: FloatArray, around: FloatArray, latent: FloatArray | None, memory: Any) -> FloatArray:
        """g (states, actions), exact at the action ``around`` (actions,) where ``affine`` accepts it."""
        if self._model is not None:
            return checked_output("g of the model", self._model.slopes(state, latent, around, memory))
        return self._tangent(state, around, latent, memory)[1]

    def _tangent(
        self, state: FloatArray, around: FloatArray, latent: FloatArray | None, memory: Any
    ) -> tuple[FloatArray, FloatArray]:
        offered = {"around": around, "memory": memory}
        phrase = {word: offered[word] for word in self._affine_text}
        f, g = self._affine(*(state, latent)[: self._affine_counts[latent is not None]], **phrase)
        return checked_output("f of the model", f), checked_output("g of the model", g)


def _accepted(what: str, function: Callable[..., Any], most: int) -> tuple[tuple[int, int], frozenset[str]]:
    """How many positional arguments (at most ``most``) and which of the filter's keywords a function takes.

    Two numbers: without a latent and with one, which is the last. A last one with a default may be anything, such as a
    period: where no latent is given, neither is it.
    """
    if not callable(function):
        raise InputError(f"{what}: got {type(function).__name__}, wanted a function: affine(x) -> (f, g), step(x, a)")
    try:
        parameters = inspect.signature(function).parameters.values()
    except ValueError as error:
        raise InputError(
            f"{what}: got {type(function).__name__}, which does not tell its arguments; wanted a function of Python "
            "around it"
        ) from error
    phrase = frozenset(p.name for p in parameters if p.name in ("around", "memory"))
    positional = [
        p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.name not in phrase
    ]
    count = most if any(p.kind is p.VAR_POSITIONAL for p in parameters) else min(most, len(positional))
    own = len(positional) >= most and positional[most - 1].default is not inspect.Parameter.empty
    return (most - 1 if own else count, count), phrase


def _unwritten(numbers: Sequence[float]) -> FloatArray:
    """What a function of the user's may read and may not write into: what it is asked next would be changed."""
    array = np.array(numbers)
    array.setflags(write=False)
    return array


def _plain(what: str, array: FloatArray, shape: tuple[int, ...]) -> Any:
    if array.shape != shape:
        raise InputError(f"{what}: got shape {array.shape}, wanted {shape}")
    return array.tolist()
