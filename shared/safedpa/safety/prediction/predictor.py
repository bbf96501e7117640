"""The model as the filter uses it: the next state, and its derivative with respect to the action.

``Prediction`` wraps a model of this project or the user's functions. ``AffineMotion`` is a model that is affine in the
action, at one state: the next state for any action is then a few products of known numbers.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel
from safedpa.dynamics.recorded_step import compiled_step_of, wait_for_compiler
from safedpa.errors import InputError
from safedpa.safety.prediction.dead_time import ActuatorModel, EffectStart, InFlightCommands
from safedpa.safety.validation import checked_output
from safedpa.systems import System

__all__ = [
    "AffineMotion",
    "Prediction",
]

_IMAGINARY = 1e-30
"""As ``_IMAGINARY`` of ``safedpa.dynamics.tangent``: the derivatives then equal those of complex steps bit for bit."""


@final
class AffineMotion:
    """x[t+1] = x + period (f + g a) / trained_period, in the order in which the recorded equations compute it.

    ``known`` holds f (states,), then g (states, actions) row by row, for one state x (states,).
    """

    def __init__(self, state: tuple[float, ...], known: list[float], period: float, trained_period: float) -> None:
        self._state, self._known = state, known
        self._period, self._trained_period = period, trained_period
        self.entries = known, period, trained_period
        self._actions = len(known) // len(state) - 1

    def next_state(self, action: Sequence[float]) -> list[float]:
        """x[t+1] (states,) under ``action`` (actions,)."""
        known, state, actions = self._known, self._state, self._actions
        states = len(state)
        place = states
        reached: list[float] = []
        for row in range(states):
            effect = 0.0
            for column in range(actions):
                effect += known[place] * action[column]
                place += 1
            reached.append(state[row] + self._period * ((known[row] + effect) / self._trained_period))
        return reached

    def control_matrix(self) -> list[list[float]]:
        """d(x[t+1])/d(a) (states, actions), the same for every action."""
        known, actions = self._known, self._actions
        place = len(self._state)
        rows: list[list[float]] = []
        for _ in range(len(self._state)):
            row: list[float] = []
            for _ in range(actions):
                # Through an imaginary step as in the generated equations, so that both give the same bits.
                nudge = self._period * (known[place] * _IMAGINARY / self._trained_period)
                row.append(nudge / _IMAGINARY)
                place += 1
            rows.append(row)
        return rows


@final
class Prediction:
    """x[t+1] = step(x, a), or f + g a if there is no ``step``; and (f, g) = affine(x) about an action.

    ``affine`` takes (state) or (state, latent), and optionally the keywords ``around`` (the action about which to
    linearise) and ``memory``; it returns f (states,) and g (states, actions). ``step`` takes (state, action) or (state,
    action, latent), and optionally ``memory``. Raises InputError for an object that is no function or has no readable
    signature, and at evaluation for a wrong shape.
    """

    def __repr__(self) -> str:
        return f"Prediction(system={'of functions' if self.system is None else self.system.name})"

    def __init__(self, affine: Callable[..., Any], step: Callable[..., Any] | None = None) -> None:
        self._affine, self._step = affine, step
        self._affine_counts, self._affine_keywords = _accepted_arguments("affine", affine, 2)
        self._step_counts, self._step_keywords = (
            ((0, 0), frozenset[str]()) if step is None else _accepted_arguments("step", step, 3)
        )
        self._model: AbstractDynamics | None = None
        self.system: System | None = None
        """The system of a model of this project; None for functions, which do not name their system."""
        self._physics: PhysicsModel | None = None
        self._fixed: tuple[float, ...] = ()
        self._scalar_step: Any = None
        self._scalar_tangent: Any = None
        self._learned: LearnedBase | None = None
        self._actuators: ActuatorModel | None = None
        self.affine = step is None and "around" not in self._affine_keywords
        """Whether the model is known to be affine in the action: g is then the same for every action."""

    @classmethod
    def of_model(cls, model: AbstractDynamics) -> Prediction:
        """The prediction of a model of this project, including its actuators."""
        # The constructor's checks of a user's function pass for the model's own.
        prediction = cls(model.affine)
        prediction._model, prediction.system, prediction.affine = model, model.system, False
        if isinstance(model, PhysicsModel):
            prediction._physics, prediction._fixed = model, tuple(model.latent.tolist())
            prediction._actuators = ActuatorModel(model)
            # Effects may saturate or depend on the action in any way; only a bare learned base is affine by
            # construction.
            if isinstance(model.base, LearnedBase) and not model.effects:
                prediction.affine = True
                prediction._learned = model.base if model.base.is_latent(model.latent_names) else None
        return prediction

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is constructed again: a compiled object cannot be created without its arguments."""
        if self._model is not None:
            return Prediction.of_model, (self._model,)
        return Prediction, (self._affine, self._step)

    @property
    def physics(self) -> PhysicsModel | None:
        """The model with its actuators; None for functions, and for a model without parameters."""
        return self._physics

    @property
    def timed(self) -> bool:
        """Whether the model depends on the time since the start of the run."""
        return self._physics is not None and self._physics.timed

    def report_time(self, seconds: float) -> None:
        """Sets the time [s] since the start of the run for the evaluations that follow."""
        if self._physics is not None:
            self._physics.clock.seconds = seconds

    @property
    def has_actuator_memory(self) -> bool:
        """Whether the next state depends on actuator memory."""
        return self._actuators is not None and self._actuators.has_memory

    def dead_time(self, latent: tuple[float, ...] | None) -> float:
        """Time [s] from applying an action until its slowest channel responds; 0: immediate, or not known."""
        return 0.0 if self._actuators is None else self._actuators.dead_time(latent)

    def has_nothing_in_flight(self, memory: Any) -> bool:
        """Whether an action takes effect at the measured state, whatever it is."""
        if self.has_actuator_memory or not isinstance(memory, InFlightCommands):
            return False
        return not memory.queue and not memory.alternatives

    def effect_start(
        self, state: tuple[float, ...], latent: tuple[float, ...] | None, memory: Any
    ) -> EffectStart | None:
        """Where an action chosen at ``state`` takes effect; None: immediately."""
        # Without memory nothing is in flight, and no object is created: the usual case.
        return None if self._actuators is None or not memory else self._actuators.effect_start(state, latent, memory)

    def rollout(self, effect: EffectStart, action: Sequence[float], latent: tuple[float, ...] | None) -> list[float]:
        """(rows * states,) the constrained states: of each case, after each period from ``state_at_effect`` on."""
        assert self._actuators is not None
        found: list[float] = []
        for case in effect.cases:
            if self._actuators.has_memory:
                found.extend(self._actuators.rollout(case, action, latent))
            else:
                found.extend(self.next_state_floats(case.state_at_effect, action, latent, case.memory))
        return found

    def control_matrix_at_effect(
        self, effect: EffectStart, around: Sequence[float], latent: tuple[float, ...] | None
    ) -> list[list[float]]:
        """d(rollout)/d(action) (rows * states, actions) about the action ``around``."""
        assert self._actuators is not None
        found: list[list[float]] = []
        for case in effect.cases:
            if self._actuators.has_memory:
                found.extend(self._actuators.control_matrix(case, around, latent))
            else:
                found.extend(self.control_matrix_floats(case.state_at_effect, around, latent, case.memory))
        return found

    @property
    def is_project_model(self) -> bool:
        """Whether it was made by ``of_model``."""
        return self._model is not None

    def sensitivity_floats(
        self, state: Sequence[float], around: Sequence[float], latent: tuple[float, ...] | None
    ) -> list[list[float]] | None:
        """Slopes of the next state in state and action (states, states + actions), by recorded equations, or None.

        Raises ValueError or ArithmeticError for values that Python's math functions refuse.
        """
        physics = self._physics
        if physics is None or (recorded := physics.scalar_sensitivity) is None:
            return None
        return recorded(state, around, self._fixed if latent is None else latent, physics.clock.seconds)[1]

    def affine_motion(self, state: tuple[float, ...], latent: tuple[float, ...] | None) -> AffineMotion | None:
        """``next_state_floats`` and ``control_matrix_floats`` at this state in one object; None: use those.

        Only for a model that is known to be affine, without effects. The networks are evaluated once.
        """
        base, model = self._learned, self._physics
        if base is None or model is None:
            return None
        free = self._fixed if latent is None else latent
        # Wrong sizes are left to the general path, which raises an error with names.
        if len(state) != len(model.system.state_names) or len(free) != len(model.latent_names):
            return None
        try:
            known = base.known_at(state, free)
        except (ValueError, ArithmeticError):  # values that Python's math functions refuse
            return None
        return AffineMotion(state, known, model.period, base.weights.description.period)

    def affine_networks(self) -> tuple[Any, float, float] | None:
        """The compiled networks of ``affine_motion``, the model's period and that of the training; None: use that."""
        base, model = self._learned, self._physics
        if base is None or model is None or (networks := base.networks.compiled) is None:
            return None
        return networks, model.period, base.weights.description.period

    @property
    def step_function(self) -> Any:
        """The user's ``step(x, a, operations)``, if the prediction is one; else None."""
        owner = getattr(self._step, "__self__", None)
        return owner if hasattr(owner, "compiled_step") else None

    def compiled_step(self, states: int, actions: int) -> Any:
        """The model's compiled step for so many states and actions; None: there is none, or it is not up to date."""
        physics, function = self._physics, self.step_function
        if function is not None:
            return function.compiled_step(states, actions) if states else None
        if physics is None or self.has_actuator_memory:
            return None
        if self._scalar_step is None:
            self._scalar_step = physics.scalar_step(physics.period)
        return compiled_step_of(self._scalar_step)

    def wait_for_compiler(self) -> None:
        """Waits until no compiler is busy with the model's step or networks."""
        if self._learned is not None:
            self._learned.networks.wait_for_compiler()
        elif self._physics is not None:
            wait_for_compiler(self._physics.scalar_step(self._physics.period))

    @property
    def seconds(self) -> float:
        """Time [s] since the start of the run, as reported."""
        return 0.0 if self._physics is None else self._physics.clock.seconds

    @property
    def nominal_latent(self) -> tuple[float, ...]:
        """(latents,) the values without a given latent."""
        return self._fixed

    def next_state_floats(
        self, state: tuple[float, ...], action: Sequence[float], latent: tuple[float, ...] | None, memory: Any
    ) -> list[float]:
        """``next_state`` in Python floats. Raises InputError if the model returns another shape."""
        physics, step = self._physics, self._scalar_step
        if step is None and physics is not None:  # looked up until there is one: the model may be recorded later
            step = self._scalar_step = physics.scalar_step(physics.period)
        if step is not None and physics is not None:
            try:
                after: list[float] = step(
                    state, action, self._fixed if latent is None else latent, physics.clock.seconds
                )
                return after
            except (ValueError, ArithmeticError):  # values that Python's math functions refuse: NumPy returns NaN
                pass
        # Arrays only from here on: the scalar path above serves nearly every call.
        given = None if latent is None else _read_only_array(latent)
        found = self.next_state(_read_only_array(state), _read_only_array(action), given, memory)
        reached: list[float] = _checked_list("predicted state", found, (len(state),))
        return reached

    def control_matrix_floats(
        self, state: tuple[float, ...], around: Sequence[float], latent: tuple[float, ...] | None, memory: Any
    ) -> list[list[float]]:
        """``control_matrix`` in Python floats. Raises InputError if the model returns another shape."""
        physics, tangent = self._physics, self._scalar_tangent
        if tangent is None and physics is not None:
            tangent = self._scalar_tangent = physics.scalar_tangent()
        if tangent is not None and physics is not None:
            try:
                free = self._fixed if latent is None else latent
                control_matrix: list[list[float]] = tangent(state, around, free, physics.clock.seconds)[1]
                return control_matrix
            except (ValueError, ArithmeticError):
                pass
        given = None if latent is None else _read_only_array(latent)
        found = self.control_matrix(_read_only_array(state), _read_only_array(around), given, memory)
        g: list[list[float]] = _checked_list("g of the model", found, (len(state), len(around)))
        return g

    def next_state(self, state: FloatArray, action: FloatArray, latent: FloatArray | None, memory: Any) -> FloatArray:
        """x[t+1] (states,) under ``action`` (actions,)."""
        model = self._model
        if model is not None:
            start_memory = model.initial_memory(action) if memory is None else memory
            return checked_output("predicted state", model.advance(state, action, start_memory, latent)[0])
        # Without a step the model is affine by definition, and f + g a is its prediction.
        if self._step is None:
            f, g = self._affine_at(state, action, latent, memory)
            states = len(state)
            if f.shape != (states,) and (f.ndim != 0 or states != 1):
                raise InputError(f"f of the model: got shape {f.shape}, wanted {(states,)}")
            if g.shape != (states, len(action)):  # NumPy would broadcast a scalar over every entry of the state
                raise InputError(f"g of the model: got shape {g.shape}, wanted {(states, len(action))}")
            return np.asarray(f + g @ action)
        keywords = {"memory": memory} if "memory" in self._step_keywords else {}
        found = self._step(*(state, action, latent)[: self._step_counts[latent is not None]], **keywords)
        return checked_output("predicted state", found)

    def control_matrix(
        self, state: FloatArray, around: FloatArray, latent: FloatArray | None, memory: Any
    ) -> FloatArray:
        """g (states, actions), exact at the action ``around`` (actions,) if ``affine`` accepts that keyword."""
        if self._model is not None:
            return checked_output("g of the model", self._model.control_matrix(state, latent, around, memory))
        return self._affine_at(state, around, latent, memory)[1]

    def _affine_at(
        self, state: FloatArray, around: FloatArray, latent: FloatArray | None, memory: Any
    ) -> tuple[FloatArray, FloatArray]:
        # Only the keywords that the function accepts: a plain affine(x) takes none.
        offered = {"around": around, "memory": memory}
        keywords = {name: offered[name] for name in self._affine_keywords}
        f, g = self._affine(*(state, latent)[: self._affine_counts[latent is not None]], **keywords)
        return checked_output("f of the model", f), checked_output("g of the model", g)


def _accepted_arguments(what: str, function: Callable[..., Any], most: int) -> tuple[tuple[int, int], frozenset[str]]:
    """Returns how many positional arguments (at most ``most``) and which of the filter's keywords a function takes.

    Two numbers: without a latent and with one, which comes last. A last argument with a default may be something else,
    such as a period: without a latent it is left out.
    """
    if not callable(function):
        raise InputError(f"{what}: got {type(function).__name__}, wanted a function: affine(x) -> (f, g), step(x, a)")
    # Some builtins and compiled functions have no readable signature; guessing would pass wrong arguments.
    try:
        parameters = inspect.signature(function).parameters.values()
    except ValueError as error:
        raise InputError(
            f"{what}: got {type(function).__name__}, which has no readable signature; "
            "wanted a Python function around it"
        ) from error
    keywords = frozenset(p.name for p in parameters if p.name in ("around", "memory"))
    positional = [
        p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.name not in keywords
    ]
    count = most if any(p.kind is p.VAR_POSITIONAL for p in parameters) else min(most, len(positional))
    own = len(positional) >= most and positional[most - 1].default is not inspect.Parameter.empty
    return (most - 1 if own else count, count), keywords


def _read_only_array(numbers: Sequence[float]) -> FloatArray:
    """A read-only array for user functions: one that wrote into it would change the next evaluation."""
    array = np.array(numbers)
    array.setflags(write=False)
    return array


def _checked_list(what: str, array: FloatArray, shape: tuple[int, ...]) -> Any:
    if array.shape != shape:
        raise InputError(f"{what}: got shape {array.shape}, wanted {shape}")
    return array.tolist()
