"""A base model plus a list of named effects: the model that users read, fit and extend.

Every query has a reference implementation over dictionaries of named scalars, and for one robot a recorded function of
plain floats (``recorded_step``), which gives the same bits. The reference answers wherever a recording cannot.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.columns import columns, common_operations, is_torch, joined, like, single_robot
from safedpa.dynamics.dynamics import AbstractDynamics, Array, RunClock
from safedpa.dynamics.recorded_step import (
    Equations,
    Names,
    RecordedStep,
    RecordedSteps,
    ScalarStep,
    record_batch_step,
    record_own_step,
    record_sensitivity,
    record_step,
    with_period_argument,
)
from safedpa.dynamics.settings import Setting, base_default, check_effects, check_settings, check_values
from safedpa.dynamics.tangent import ScalarTangent, batched_difference, forward_mode, intercept, single_tangent
from safedpa.effects.effect import AbstractEffect, CommandEffect, Context, FeltEffect, Named, RateEffect, SensorEffect
from safedpa.effects.law import plain
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError
from safedpa.native.captured import Captured
from safedpa.operations import FLOATS, NUMPY, Operations, Scalar
from safedpa.result import one_line

_Values = Mapping[str, Named]
"""Parameter values by owner ("base" or an effect's name) and name."""
_STRUCTURE = (
    "base", "holds", "effects", "system", "period", "_commands", "_has_memory", "_felts", "_rates", "_sensors",
)  # fmt: skip
"""Attributes that models of one structure share, whatever their parameter values."""


@final
class PhysicsModel(AbstractDynamics):
    """x[t+1] = measure(RK4 over one period of (base + effects)(restore(x[t]), command(a[t])))).

    The latent z is the vector of all free parameters, in SI units, in the order base first, then effects as listed.
    ``settings`` maps "base.<parameter>" and "<effect>.<parameter>" to values. Every parameter must be listed, except
    that parameters of the base default to their neutral value. Models are immutable except for their ``clock``. If
    ``holds``, dry friction keeps a stationary robot exactly at rest; otherwise it is smoothed near rest.

    Raises ModelFileError when an effect does not fit the robot or its actions or is listed twice, or when a parameter
    is missing, unknown or out of bounds.

    Example:

        >>> model = safedpa.load_model("friction.toml")
        >>> model
        PhysicsModel(robot=pendulum, base=rigid_pendulum, period=0.05 s, effects=viscous_friction, free=nothing)
        >>> model.step(np.array([0.1, 0.0]), np.array([0.5])).round(3).tolist()
        [0.102, 0.074]
    """

    def __init__(
        self,
        base: AbstractBase,
        effects: Sequence[AbstractEffect] = (),
        settings: Mapping[str, Setting] | None = None,
        period: float = 0.05,
        holds: bool = False,
    ) -> None:
        self.base, self.holds = base, holds
        self.effects = tuple(item.at_period(period) for item in effects)
        self.system = base.system
        self.period = period
        self.clock = RunClock()  # the one part that callers change
        optional = {f"base.{item.name}": base_default(item) for item in base.parameters if item.neutral is not None}
        self.settings = {**optional, **(settings or {})}
        check_effects(base, self.effects)
        check_settings(self.parameters, self.settings)
        self.latent_names = tuple(path for path in self.parameters if self.settings[path].free)
        # the physical order from command to motion, whatever the order in the file; sorted() keeps ties as listed
        ordered = sorted(self.effects, key=lambda item: item.stage)
        self._commands = tuple(item for item in ordered if isinstance(item, CommandEffect))
        rest = dict.fromkeys(self.system.action_names, 0.0)
        # a recorded step has no memory among its inputs, so command effects with memory are applied before it
        self._has_memory = any(item.initial_memory(rest) is not None for item in self._commands)
        self._felts = tuple(item for item in ordered if isinstance(item, FeltEffect))
        self._rates = tuple(item for item in ordered if isinstance(item, RateEffect))
        self._sensors = tuple(item for item in ordered if isinstance(item, SensorEffect))

    def __repr__(self) -> str:
        facts = {"robot": self.system.name, "base": self.base.kind, "period": f"{self.period:g} s"}
        effects = ", ".join(item.name for item in self.effects) or "none"
        return one_line(
            "PhysicsModel", {**facts, "effects": effects, "free": ", ".join(self.latent_names) or "nothing"}
        )

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """All parameters by path: those of the base first, then of the effects as listed."""
        paths = {f"base.{parameter.name}": parameter for parameter in self.base.parameters}
        for item in self.effects:
            paths.update({f"{item.name}.{parameter.name}": parameter for parameter in item.parameters})
        return paths

    @cached_property
    def latent(self) -> NDArray[np.float64]:
        """The latent that corresponds to the settings, shape (latents,)."""
        return np.array([self.settings[path].value for path in self.latent_names])

    def with_settings(self, settings: Mapping[str, Setting]) -> PhysicsModel:
        """Returns the same model with some settings replaced."""
        check_values(self.parameters, settings)
        # without __init__: a twentieth of its time, and a fit makes thousands of models of one structure
        again = object.__new__(PhysicsModel)
        again.__dict__.update({name: self.__dict__[name] for name in _STRUCTURE})
        again.parameters, again.clock = self.parameters, RunClock()  # the cached table of parameters is shared
        again.settings = {**self.settings, **settings}
        again.latent_names = tuple(path for path in self.parameters if again.settings[path].free)
        return again

    def with_period(self, period: float) -> PhysicsModel:
        """Returns the model with another period [s]; itself if the period is the same."""
        again = PhysicsModel(self.base, self.effects, self.settings, period, self.holds)
        return self if period == self.period else again

    def with_effect(self, item: AbstractEffect, settings: Mapping[str, Setting]) -> PhysicsModel:
        """Returns the model with one more effect; parameters missing in ``settings`` start at ``Parameter.start``."""
        item = item.at_period(self.period)
        unknown = set(settings) - {parameter.name for parameter in item.parameters}
        if unknown:
            raise ModelFileError(f"{item.name}.{min(unknown)}: unknown parameter; leave it out")
        own = {f"{item.name}.{p.name}": settings.get(p.name, Setting(p.start)) for p in item.parameters}
        return PhysicsModel(self.base, (*self.effects, item), {**self.settings, **own}, self.period, self.holds)

    def with_latent(self, latent: Array) -> PhysicsModel:
        """Returns the model with the free parameters set to ``latent`` (latents,)."""
        return self.with_settings(
            {path: Setting(float(value), free=True) for path, value in zip(self.latent_names, latent, strict=True)}
        )

    def initial_memory(self, action: Array, latent: Array | None = None) -> Any:  # noqa: D102
        if not self._has_memory:
            return ()
        named = dict(zip(self.system.action_names, columns(action, action), strict=True))
        return self._settled(named, self._values(latent, action), common_operations(action, latent))

    def advance(  # noqa: D102
        self,
        state: Array,
        action: Array,
        memory: Any,
        latent: Array | None = None,
        *,
        period: float | None = None,
        time: float = 0.0,
    ) -> tuple[Array, Any]:
        used, time = self.period if period is None else period, self.clock.seconds + time
        quick = self._quick(state, action, memory, latent, used, time)
        if quick is not None:
            return quick
        # the order of the physics: undo the sensor, let the actuators answer, integrate, measure
        operations = common_operations(state, action, latent)
        true = self._restored(state, values := self._values(latent, state))
        named = dict(zip(self.system.action_names, columns(action, state), strict=True))
        entries, memory = self._advance(true, named, memory, values, used, time, operations)
        return joined(entries, operations), memory

    def felt(
        self, action: Sequence[float], memory: Any, latent: Sequence[float] | None = None, *, period: float
    ) -> tuple[list[float], Any]:
        """Returns the mean action (actions,) that one robot's mechanics feel over a period, and the memory after it."""
        named = dict(zip(self.system.action_names, action, strict=True))
        values = self._fixed if latent is None else self._with_free(latent)
        after, cached = self._felt(named, memory, values, period, FLOATS)
        return list(after.values()), cached

    def scalar_step(self, period: float) -> ScalarStep | None:
        """Returns one robot's step as a function of floats, for callers that take thousands of steps.

        None where the caller must use ``advance``: if the actuators have memory, if the equations cannot be recorded,
        and for the first calls, before recording pays off.
        """
        return None if self._has_memory else self._recorded_steps.floats(period)

    def record_scalar_step(self) -> None:
        """Records the step over the model's own period now (a few milliseconds), before a decision waits for it."""
        self._recorded_steps.record(self.period)

    def scalar_tangent(self) -> ScalarTangent | None:
        """Returns one robot's step and its slopes in the action as a function of floats; None as ``scalar_step``."""
        return None if self._has_memory else self._recorded_steps.tangent(self.period)

    @cached_property
    def scalar_sensitivity(self) -> ScalarTangent | None:
        """One robot's step and its slopes in state and action (states, states + actions), as a function of floats.

        Recorded on the first access. None as ``scalar_step``, and for a base with networks.
        """
        if self._has_memory or not (self._takes_complex and self.base.recordable):
            return None
        return record_sensitivity(self.equations(self.period), self._names)

    def batch_step(self, period: float | None) -> ScalarStep | None:
        """Returns ``scalar_step`` for many robots: each entry of state, action and latent is one NumPy array.

        If ``period`` is None, the period is one more entry after the latent, and sine and cosine are computed from one
        tangent, which differs by rounding. Recorded at once, in a few milliseconds. None as ``scalar_step``, and for a
        base with networks.
        """
        if self._has_memory or not (self._takes_complex and self.base.recordable):
            return None
        if period is not None:
            return record_batch_step(self.equations(period), self._names)
        states, actions, latents = self._names
        return record_batch_step(with_period_argument(self.equations), (states, actions, (*latents, "period")))

    def rollout_held(  # noqa: D102
        self, state: Array, action: Array, memory: Any, latent: Array | None, steps: int, *, period: float
    ) -> tuple[list[list[float]], Any]:
        step = self.scalar_step(period) if single_robot(state, action, latent) else None
        if step is not None:
            entries, felt, rows = state.tolist(), action.tolist(), []
            free = (self.latent if latent is None else latent).tolist()
            # Python's math raises where NumPy gives NaN or inf: the reference below then answers
            with contextlib.suppress(ValueError, ArithmeticError):
                for index in range(steps):
                    rows.append(entries := step(entries, felt, free, self.clock.seconds + index * period))
                return rows, memory
        return super().rollout_held(state, action, memory, latent, steps, period=period)

    def affine(  # noqa: D102
        self,
        state: Array,
        latent: Array | None = None,
        *,
        around: Array | None = None,
        memory: Any = None,
        time: float = 0.0,
    ) -> tuple[Array, Array]:
        around, time = self._middle if around is None else around, self.clock.seconds + time
        quick = None if self._has_memory else self._quick_tangent(state, around, latent, time)
        if quick is not None:
            return quick
        operations = common_operations(state, around, latent)
        values = self._values(latent, state)
        true, names = self._restored(state, values), self.system.action_names
        measured, free = columns(state, state), columns(self.latent if latent is None else latent, state)
        if memory is None:
            # settled at the action of the tangent: a lag then adds no transient to f
            memory = self._settled(dict(zip(names, columns(around, state), strict=True)), values, operations)

        def entries(action: Sequence[Scalar], operations: Operations) -> list[Scalar]:
            named = dict(zip(names, action, strict=True))
            quick = self._recorded_steps.of(self.period, operations)
            if quick is not None:
                felt = action
                with contextlib.suppress(ValueError, ArithmeticError):  # the reference below answers
                    if self._has_memory:
                        felt = list(self._felt(named, memory, values, self.period, operations)[0].values())
                    return quick(measured, felt, free, time)
            return self._advance(true, named, memory, values, self.period, time, operations)[0]

        if operations is FLOATS:
            # complex steps give exact slopes; central differences serve where a user's equations reject complex numbers
            return single_tangent(entries, around.tolist(), self._ranges, self._takes_complex)

        def step(action: Array) -> Array:
            return joined(entries(columns(action, state), operations), operations)

        if is_torch(state):
            around = like(state, around) if isinstance(around, np.ndarray) else around
            # one action for the whole batch is expanded: forward mode needs a tangent for every row
            return forward_mode(
                step, around.expand(*state.shape[:-1], len(names)).clone() if around.ndim == 1 else around
            )
        return batched_difference(step, np.asarray(around, dtype=np.float64), self._ranges)

    def control_matrix(self, state: Array, latent: Array | None, around: Array, memory: Any) -> Array:  # noqa: D102
        if not self._has_memory and single_robot(state, around, latent):
            tangent = self._recorded_steps.tangent(self.period)
            free = (self.latent if latent is None else latent).tolist()
            with contextlib.suppress(ValueError, ArithmeticError):  # the base class answers
                if tangent is not None:
                    return np.array(tangent(state.tolist(), around.tolist(), free, self.clock.seconds)[1])
        return super().control_matrix(state, latent, around, memory)

    def _advance(
        self,
        state: Named,
        action: Named,
        memory: Any,
        values: _Values,
        period: float,
        time: float,
        operations: Operations,
    ) -> tuple[list[Scalar], Any]:
        """Returns the measured entries and the memory after one period, from the true state."""
        if self._commands:
            # once per period, before the integrator: delays and lags are exact for a held command, see effects.memory
            action, memory = self._felt(action, memory, values, period, operations)
        return self._integrated(state, action, values, period, time, operations), memory

    def _integrated(
        self, state: Named, action: Named, values: _Values, period: float, time: Scalar, operations: Operations
    ) -> list[Scalar]:
        """Returns the measured entries after one period, from the true state and the felt action."""
        base, known = values["base"], self.base.rates
        effects = [(item.modify, values[item.name]) for item in self._rates]
        feels = [(item.feel, values[item.name]) for item in self._felts]

        def derivative(now: Named, seconds: Scalar) -> Named:
            felt = action
            # again in each stage of the integrator: a felt effect may depend on state and time
            for feel, own in feels:
                felt = feel(own, Context(now, felt, base, seconds, period, operations))
            rates = known(now, felt, base, operations)
            if effects:
                context = Context(now, felt, base, seconds, period, operations, self.holds)
                for modify, own in effects:
                    rates = modify(rates, own, context)
            return rates

        try:
            after = self.base.integrate(derivative, state, time, period)
        except (ValueError, ArithmeticError):
            # Python's math raises for sin(inf) and exp(1000); NumPy gives NaN and inf, as for batches and tensors
            if operations is not FLOATS:
                raise
            operations = NUMPY
            with np.errstate(all="ignore"):
                after = self.base.integrate(
                    derivative, {name: np.float64(value) for name, value in state.items()}, time, period
                )
        for entries in self.system.rotations:
            # the integrator leaves the sphere of unit quaternions by its local error
            w, x, y, z = (after[name] for name in entries)
            length = operations.sqrt(w * w + x * x + y * y + z * z)
            after = {**after, **{name: after[name] / length for name in entries}}
        # measure in the reverse order of restore, so that one undoes the other
        for sensor in reversed(self._sensors):
            after = sensor.measure(after, values[sensor.name])
        return [after[name] for name in self.system.state_names]

    def _quick(
        self, state: Array, action: Array, memory: Any, latent: Array | None, period: float, time: float
    ) -> tuple[Array, Any] | None:
        """Returns one robot's step by the recorded function; None where the reference has to answer."""
        if not single_robot(state, action, latent) or (step := self._recorded_steps.floats(period)) is None:
            return None
        try:
            felt = action.tolist()
            if self._has_memory:
                named = dict(zip(self.system.action_names, felt, strict=True))
                after, memory = self._felt(named, memory, self._values(latent, state), period, FLOATS)
                felt = after.values()
            free = (self.latent if latent is None else latent).tolist()
            return np.array(step(state.tolist(), felt, free, time)), memory
        except (ValueError, ArithmeticError):  # numbers that Python's math rejects, or arrays of another length
            return None

    def _quick_tangent(
        self, state: Array, around: Array, latent: Array | None, time: float
    ) -> tuple[Array, Array] | None:
        """Returns one robot's tangent by the recorded function; None where the reference has to answer."""
        if not single_robot(state, around, latent) or (tangent := self._recorded_steps.tangent(self.period)) is None:
            return None
        free, action = (self.latent if latent is None else latent).tolist(), around.tolist()
        with contextlib.suppress(ValueError, ArithmeticError):
            value, g = tangent(state.tolist(), action, free, time)
            return intercept(value, g, action), np.array(g)
        return None

    @property
    def _names(self) -> Names:
        return self.system.state_names, self.system.action_names, self.latent_names

    @cached_property
    def _recorded_steps(self) -> RecordedSteps:
        # a user's equations may read files, keep state or draw random numbers: a recording would freeze the first run
        recordable = self.base.recordable and (self._takes_complex or self._watched is not None)
        return RecordedSteps(self._record if recordable else None)

    def _record(self, period: float, native: bool) -> RecordedStep | None:
        if self._takes_complex:
            return record_step(self.equations(period), self._names, native)
        return record_own_step(self.equations(period), self._names, self._watched or (), native)

    @cached_property
    def _watched(self) -> tuple[Captured, ...] | None:
        """What a user's base reads besides its arguments; None if it does more, or if an effect is the user's."""
        if not all(type(plain(item)).__module__.startswith("safedpa.") for item in self.effects):
            return None
        watched = Captured(self.base.rates), Captured(self.base.integrate)
        return None if any(each.impure for each in watched) else watched

    def equations(self, period: float) -> Equations:
        """Returns the equations of one period, to be recorded; with actuator memory their action is the felt one."""

        def equations(
            state: Sequence[Scalar],
            action: Sequence[Scalar],
            latent: Sequence[Scalar],
            time: Scalar,
            operations: Operations,
        ) -> Sequence[Scalar]:
            values = self._with_free(latent) if latent else self._fixed
            measured = dict(zip(self.system.state_names, state, strict=True))
            felt: Named = dict(zip(self.system.action_names, action, strict=True))
            if not self._has_memory:
                felt, _ = self._felt(felt, (), values, period, operations)
            return self._integrated(self._true(measured, values), felt, values, period, time, operations)

        return equations

    def _felt(
        self, action: Named, memory: Any, values: _Values, period: float, operations: Operations
    ) -> tuple[Named, tuple[Any, ...]]:
        """Returns the action that the mechanics feel, and the actuators' memory after it."""
        cached = []
        # a model without memory passes () to every effect, which then gets None
        owns = memory if self._has_memory or memory else (None,) * len(self._commands)
        for command, own in zip(self._commands, owns, strict=True):
            action, retained = command.transform(action, own, values[command.name], period, operations)
            cached.append(retained)
        return action, tuple(cached) if self._has_memory else ()

    def _settled(self, action: Named, values: _Values, operations: Operations) -> tuple[Any, ...]:
        """Returns each command effect's memory, settled at what the effects before it make of the action."""
        memory = []
        for item in self._commands if self._has_memory else ():
            own = item.initial_memory(action)
            memory.append(own)
            action, _ = item.transform(action, own, values[item.name], self.period, operations)
        return tuple(memory)

    def _restored(self, state: Array, values: _Values) -> Named:
        return self._true(dict(zip(self.system.state_names, columns(state, state), strict=True)), values)

    def _true(self, named: Named, values: _Values) -> Named:
        """Returns the true state for a measured one."""
        for sensor in self._sensors:
            named = sensor.restore(named, values[sensor.name])
        return named

    def _values(self, latent: Array | None, state: Array) -> _Values:
        """Returns all parameter values, the free ones from the latent (latents,) or (..., latents)."""
        if latent is None:
            return self._fixed
        if latent.shape[-1] != len(self.latent_names):
            raise ModelFileError(
                f"latent: got {latent.shape[-1]} entries, wanted {len(self.latent_names)}: "
                f"{', '.join(self.latent_names)}"
            )
        return self._with_free(columns(latent, state))

    def _with_free(self, entries: Sequence[Scalar]) -> _Values:
        """Returns all parameter values, the free ones as given."""
        # copies only the tables that change: this runs in every step of the reference
        owners: dict[str, Named] = dict(self._fixed)
        for owner, free in self._free.items():
            owners[owner] = {**owners[owner], **{name: entries[index] for name, index in free}}
        return owners

    @cached_property
    def _fixed(self) -> dict[str, dict[str, float]]:
        owners: dict[str, dict[str, float]] = {"base": {}, **{item.name: {} for item in self.effects}}
        for path, setting in self.settings.items():
            owner, name = path.split(".")
            owners[owner][name] = setting.value
        return owners

    @cached_property
    def _free(self) -> dict[str, list[tuple[str, int]]]:
        """The names of the free parameters and their indices in the latent, by owner."""
        owners: dict[str, list[tuple[str, int]]] = {}
        for index, path in enumerate(self.latent_names):
            owner, name = path.split(".")
            owners.setdefault(owner, []).append((name, index))
        return owners

    @cached_property
    def _takes_complex(self) -> bool:
        """Whether all equations take complex numbers: a user's may call abs(), which drops the imaginary part."""
        parts = (self.base, *(plain(item) for item in self.effects))
        return all(type(part).__module__.startswith("safedpa.") for part in parts)

    @cached_property
    def timed(self) -> bool:
        """Whether anything depends on the time since the start of the run."""
        return any(item.timed for item in self.effects)

    @cached_property
    def _middle(self) -> NDArray[np.float64]:
        # the middle of the bounds: no clip of the actuators is active there, so the tangent is not flat
        return 0.5 * (self.system.action_low + self.system.action_high)

    @cached_property
    def _ranges(self) -> tuple[float, ...]:
        return tuple((self.system.action_high - self.system.action_low).tolist())
