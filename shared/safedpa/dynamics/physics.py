"""A base model plus a list of named effects: the model that people read, fit and extend."""

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
from safedpa.dynamics.settings import Setting, base_default, check_effects, check_settings, check_values
from safedpa.dynamics.straight import (
    Equations,
    Straight,
    StraightStep,
    StraightSteps,
    paced,
    straight_arrays,
    straight_sensitivity,
    straight_step,
)
from safedpa.dynamics.tangent import StraightTangent, batched_difference, forward_mode, intercept, single_tangent
from safedpa.effects.effect import AbstractEffect, CommandEffect, Context, FeltEffect, Named, RateEffect, SensorEffect
from safedpa.effects.effects_with_law import plain
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError
from safedpa.operations import FLOATS, NUMPY, Operations, Scalar

__all__ = ["PhysicsModel", "Setting"]

_Values = Mapping[str, Named]
"""Parameter values by owner ("base" or an effect's name) and name."""
_STRUCTURE = ("base", "holds", "effects", "system", "period", "_commands", "_apart", "_felts", "_rates", "_sensors")
"""What models of one structure have in common, whatever their numbers."""


@final
class PhysicsModel(AbstractDynamics):
    """x[t+1] = measure(RK4 over one period of (base + effects)(restore(x[t]), command(a[t])))).

    The latent z is the vector of all free parameters, in SI units, in the order base first, then effects as listed.
    ``settings`` maps "base.<parameter>" and "<effect>.<parameter>" to values; every parameter must be there; those
    of the base that have a neutral value get it when they are left out.
    Models are immutable but for their ``clock``. Where one ``holds``, dry friction holds what stands.

    Raises ModelFileError when an effect does not fit the robot or its actions, stands twice, or a parameter is missing,
    unknown or out of bounds.
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
        self.effects = tuple(effects)
        self.system = base.system
        self.period = period
        self.clock = RunClock()
        optional = {f"base.{item.name}": base_default(item) for item in base.parameters if item.neutral is not None}
        self.settings = {**optional, **(settings or {})}
        check_effects(base, self.effects)
        check_settings(self.parameters, self.settings)
        self.latent_names = tuple(path for path in self.parameters if self.settings[path].free)
        ordered = sorted(self.effects, key=lambda item: item.stage)
        self._commands = tuple(item for item in ordered if isinstance(item, CommandEffect))
        rest = dict.fromkeys(self.system.action_names, 0.0)
        self._apart = any(item.initial_memory(rest) is not None for item in self._commands)  # whether one remembers
        self._felts = tuple(item for item in ordered if isinstance(item, FeltEffect))
        self._rates = tuple(item for item in ordered if isinstance(item, RateEffect))
        self._sensors = tuple(item for item in ordered if isinstance(item, SensorEffect))

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter by path, base first, effects as listed."""
        paths = {f"base.{parameter.name}": parameter for parameter in self.base.parameters}
        for item in self.effects:
            paths.update({f"{item.name}.{parameter.name}": parameter for parameter in item.parameters})
        return paths

    @cached_property
    def latent(self) -> NDArray[np.float64]:
        """The latent that the settings stand for, shape (latents,)."""
        return np.array([self.settings[path].value for path in self.latent_names])

    def with_settings(self, settings: Mapping[str, Setting]) -> PhysicsModel:
        """The same model with some settings replaced: a twentieth of the time of a new one, for fits make thousands."""
        check_values(self.parameters, settings)
        again = object.__new__(PhysicsModel)
        again.__dict__.update({name: self.__dict__[name] for name in _STRUCTURE})
        again.parameters, again.clock = self.parameters, RunClock()
        again.settings = {**self.settings, **settings}
        again.latent_names = tuple(path for path in self.parameters if again.settings[path].free)
        return again

    def with_period(self, period: float) -> PhysicsModel:
        """The same equations over another period in s; itself where it is its own."""
        again = PhysicsModel(self.base, self.effects, self.settings, period, self.holds)
        return self if period == self.period else again

    def with_effect(self, item: AbstractEffect, settings: Mapping[str, Setting]) -> PhysicsModel:
        """The model with one more effect; ``settings`` by parameter name, where left out those that do nothing."""
        unknown = set(settings) - {parameter.name for parameter in item.parameters}
        if unknown:
            raise ModelFileError(f"{item.name}.{min(unknown)}: unknown parameter; leave it out")
        own = {f"{item.name}.{p.name}": settings.get(p.name, Setting(p.start)) for p in item.parameters}
        return PhysicsModel(self.base, (*self.effects, item), {**self.settings, **own}, self.period, self.holds)

    def with_latent(self, latent: Array) -> PhysicsModel:
        """The model with the free parameters set to ``latent`` (latents,)."""
        return self.with_settings(
            {path: Setting(float(value), free=True) for path, value in zip(self.latent_names, latent, strict=True)}
        )

    def initial_memory(self, action: Array, latent: Array | None = None) -> Any:  # noqa: D102
        if not self._apart:
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
        operations = common_operations(state, action, latent)
        true = self._restored(state, values := self._values(latent, state))
        named = dict(zip(self.system.action_names, columns(action, state), strict=True))
        entries, memory = self._advance(true, named, memory, values, used, time, operations)
        return joined(entries, operations), memory

    def felt(
        self, action: Sequence[float], memory: Any, latent: Sequence[float] | None = None, *, period: float
    ) -> tuple[list[float], Any]:
        """What one robot's mechanics feel of an action (actions,), the mean over a period, and the memory after it."""
        named = dict(zip(self.system.action_names, action, strict=True))
        values = self._fixed if latent is None else self._with_free(latent)
        after, cached = self._felt(named, memory, values, period, FLOATS)
        return list(after.values()), cached

    def straight(self, period: float) -> StraightStep | None:
        """One robot's step as a function of plain numbers, for who takes thousands; None: use ``advance``, as with
        actuators that remember, equations that cannot be recorded, and before it is asked so often that it pays.
        """
        return None if self._apart else self._straight.floats(period)

    def write_straight(self) -> None:
        """Records the step of one period now, in some milliseconds, before someone waits for it."""
        self._straight.write(self.period)

    def straight_tangent(self) -> StraightTangent | None:
        """One robot's next state and its slopes in the action over one period, of plain numbers; None as there."""
        return None if self._apart else self._straight.tangent(self.period)

    @cached_property
    def straight_sensitivity(self) -> StraightTangent | None:
        """Next state and its slopes in state and action (states, states + actions) over one period, of plain numbers.

        Recorded when it is first asked for. None as ``straight``, and where a network is asked on the way.
        """
        if self._apart or not (self._takes_complex and self.base.straight):
            return None
        names = self.system.state_names, self.system.action_names, self.latent_names
        return straight_sensitivity(self.equations(self.period), *names)

    def straight_arrays(self, period: float | None) -> StraightStep | None:
        """``straight`` for many robots: every entry of state, action and latent is a numpy array of one precision.

        Without a ``period`` it follows the latent as one more entry, and sines and cosines come from one tangent, as
        near as rounding. Recorded at once, in some milliseconds. None as there, and for equations that ask one robot.
        """
        if self._apart or not (self._takes_complex and self.base.straight):
            return None
        names = self.system.state_names, self.system.action_names, self.latent_names
        if period is not None:
            return straight_arrays(self.equations(period), *names)
        return straight_arrays(paced(self.equations), names[0], names[1], (*names[2], "period"))

    def held(  # noqa: D102
        self, state: Array, action: Array, memory: Any, latent: Array | None, steps: int, *, period: float
    ) -> tuple[list[list[float]], Any]:
        step = self.straight(period) if single_robot(state, action, latent) else None
        if step is not None:
            entries, felt, rows = state.tolist(), action.tolist(), []
            free = (self.latent if latent is None else latent).tolist()
            with contextlib.suppress(ValueError, ArithmeticError):  # answered below
                for index in range(steps):
                    rows.append(entries := step(entries, felt, free, self.clock.seconds + index * period))
                return rows, memory
        return super().held(state, action, memory, latent, steps, period=period)

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
        quick = None if self._apart else self._quick_tangent(state, around, latent, time)
        if quick is not None:
            return quick
        operations = common_operations(state, around, latent)
        values = self._values(latent, state)
        true, names = self._restored(state, values), self.system.action_names
        measured, free = columns(state, state), columns(self.latent if latent is None else latent, state)
        if memory is None:
            memory = self._settled(dict(zip(names, columns(around, state), strict=True)), values, operations)

        def entries(action: Sequence[Scalar], operations: Operations) -> list[Scalar]:
            named = dict(zip(names, action, strict=True))
            quick = self._straight.of(self.period, operations)
            if quick is not None:
                felt = action
                with contextlib.suppress(ValueError, ArithmeticError):  # answered below
                    if self._apart:
                        felt = list(self._felt(named, memory, values, self.period, operations)[0].values())
                    return quick(measured, felt, free, time)
            return self._advance(true, named, memory, values, self.period, time, operations)[0]

        if operations is FLOATS:
            return single_tangent(entries, around.tolist(), self._ranges, self._takes_complex)

        def step(action: Array) -> Array:
            return joined(entries(columns(action, state), operations), operations)

        if is_torch(state):
            around = like(state, around) if isinstance(around, np.ndarray) else around
            return forward_mode(
                step, around.expand(*state.shape[:-1], len(names)).clone() if around.ndim == 1 else around
            )
        return batched_difference(step, np.asarray(around, dtype=np.float64), self._ranges)

    def slopes(self, state: Array, latent: Array | None, around: Array, memory: Any) -> Array:  # noqa: D102
        if not self._apart and single_robot(state, around, latent):
            tangent = self._straight.tangent(self.period)
            free = (self.latent if latent is None else latent).tolist()
            with contextlib.suppress(ValueError, ArithmeticError):  # answered below
                if tangent is not None:
                    return np.array(tangent(state.tolist(), around.tolist(), free, self.clock.seconds)[1])
        return super().slopes(state, latent, around, memory)

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
        """The measured entries and the memory after one period, from the true state."""
        if self._commands:
            action, memory = self._felt(action, memory, values, period, operations)
        return self._integrated(state, action, values, period, time, operations), memory

    def _integrated(
        self, state: Named, action: Named, values: _Values, period: float, time: Scalar, operations: Operations
    ) -> list[Scalar]:
        """The measured entries after one period, from the true state and what the mechanics feel of the action."""
        base, known = values["base"], self.base.rates
        effects = [(item.modify, values[item.name]) for item in self._rates]
        feels = [(item.feel, values[item.name]) for item in self._felts]

        def derivative(now: Named, seconds: Scalar) -> Named:
            felt = action
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
            # Python's math refuses sin(inf) and exp(1000), where numpy and torch answer NaN and inf: so does this model
            if operations is not FLOATS:
                raise
            operations = NUMPY
            with np.errstate(all="ignore"):
                after = self.base.integrate(
                    derivative, {name: np.float64(value) for name, value in state.items()}, time, period
                )
        for sensor in reversed(self._sensors):
            after = sensor.measure(after, values[sensor.name])
        return [after[name] for name in self.system.state_names]

    def _quick(
        self, state: Array, action: Array, memory: Any, latent: Array | None, period: float, time: float
    ) -> tuple[Array, Any] | None:
        """The same step for one robot as a straight line of arithmetic; None where the reference has to answer."""
        if not single_robot(state, action, latent) or (step := self._straight.floats(period)) is None:
            return None
        try:
            felt = action.tolist()
            if self._apart:
                named = dict(zip(self.system.action_names, felt, strict=True))
                after, memory = self._felt(named, memory, self._values(latent, state), period, FLOATS)
                felt = after.values()
            free = (self.latent if latent is None else latent).tolist()
            return np.array(step(state.tolist(), felt, free, time)), memory
        except (ValueError, ArithmeticError):  # numbers that Python's math refuses, or of another length
            return None

    def _quick_tangent(
        self, state: Array, around: Array, latent: Array | None, time: float
    ) -> tuple[Array, Array] | None:
        """The tangent for one robot along the straight line, by complex steps; None where the reference answers."""
        if not single_robot(state, around, latent) or (tangent := self._straight.tangent(self.period)) is None:
            return None
        free, action = (self.latent if latent is None else latent).tolist(), around.tolist()
        with contextlib.suppress(ValueError, ArithmeticError):
            value, g = tangent(state.tolist(), action, free, time)
            return intercept(value, g, action), np.array(g)
        return None

    @cached_property
    def _straight(self) -> StraightSteps:
        """The project's own equations can be recorded; a user's may do what a recording does not see."""
        straight = self._takes_complex and self.base.straight
        return StraightSteps(self._recorded if straight else None)

    def _recorded(self, period: float) -> Straight | None:
        names = self.system.state_names, self.system.action_names, self.latent_names
        return straight_step(self.equations(period), *names)

    def equations(self, period: float) -> Equations:
        """One period as ``straight`` records it, from what is felt of the action where actuators remember."""

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
            if not self._apart:
                felt, _ = self._felt(felt, (), values, period, operations)
            return self._integrated(self._true(measured, values), felt, values, period, time, operations)

        return equations

    def _felt(
        self, action: Named, memory: Any, values: _Values, period: float, operations: Operations
    ) -> tuple[Named, tuple[Any, ...]]:
        """What the mechanics feel of an action, and the actuators' memory after it."""
        cached = []
        owns = memory if self._apart or memory else (None,) * len(self._commands)
        for command, own in zip(self._commands, owns, strict=True):
            action, retained = command.transform(action, own, values[command.name], period, operations)
            cached.append(retained)
        return action, tuple(cached) if self._apart else ()

    def _settled(self, action: Named, values: _Values, operations: Operations) -> tuple[Any, ...]:
        """Each actuator's memory once it has settled at what those before it make of the action."""
        memory = []
        for item in self._commands if self._apart else ():
            own = item.initial_memory(action)
            memory.append(own)
            action, _ = item.transform(action, own, values[item.name], self.period, operations)
        return tuple(memory)

    def _restored(self, state: Array, values: _Values) -> Named:
        return self._true(dict(zip(self.system.state_names, columns(state, state), strict=True)), values)

    def _true(self, named: Named, values: _Values) -> Named:
        """The true state behind a measured one."""
        for sensor in self._sensors:
            named = sensor.restore(named, values[sensor.name])
        return named

    def _values(self, latent: Array | None, state: Array) -> _Values:
        """Every parameter's value, the free ones from the latent (latents,) or (..., latents)."""
        if latent is None:
            return self._fixed
        if latent.shape[-1] != len(self.latent_names):
            raise ModelFileError(
                f"latent: got {latent.shape[-1]} entries, wanted {len(self.latent_names)}: "
                f"{', '.join(self.latent_names)}"
            )
        return self._with_free(columns(latent, state))

    def _with_free(self, entries: Sequence[Scalar]) -> _Values:
        """Every parameter's value, the free ones as given."""
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
        """The names of the free parameters and their places in the latent, by owner."""
        owners: dict[str, list[tuple[str, int]]] = {}
        for index, path in enumerate(self.latent_names):
            owner, name = path.split(".")
            owners.setdefault(owner, []).append((name, index))
        return owners

    @cached_property
    def _takes_complex(self) -> bool:
        """Whether all equations are the project's own: a user's may call abs(), which drops an imaginary part."""
        parts = (self.base, *(plain(item) for item in self.effects))
        return all(type(part).__module__.startswith("safedpa.") for part in parts)

    @cached_property
    def timed(self) -> bool:
        """Whether anything in it depends on the time since the start of the run."""
        return any(item.timed for item in self.effects)

    @cached_property
    def _middle(self) -> NDArray[np.float64]:
        return 0.5 * (self.system.action_low + self.system.action_high)

    @cached_property
    def _ranges(self) -> tuple[float, ...]:
        return tuple((self.system.action_high - self.system.action_low).tolist())
