"""A base model plus a list of named effects: the model that people read, fit and extend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.dynamics import AbstractDynamics, Array
from safedpa.effects.effect import (
    AbstractEffect,
    CommandEffect,
    Context,
    Named,
    RateEffect,
    SensorEffect,
)
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError
from safedpa.operations import FLOATS, NUMPY, Operations, Scalar, operations_for

__all__ = ["PhysicsModel", "Setting"]

_ACTION_NUDGE = 1e-4
"""Share of an actuator's range by which the action is moved for a central difference: error 1e-8 of the range."""


@dataclass(frozen=True)
class Setting:
    """The value of one parameter; ``free`` ones are refitted by diagnosis and estimated by adaptation."""

    value: float
    free: bool = False


@final
class PhysicsModel(AbstractDynamics):
    """x[t+1] = measure(RK4 over one period of (base + effects)(restore(x[t]), command(a[t])))).

    The latent z is the vector of all free parameters, in SI units, in the order base first, then effects as listed.
    ``settings`` maps "base.<parameter>" and "<effect>.<parameter>" to values; every parameter must be there.

    Raises ModelFileError when an effect does not fit the robot or its actions, stands twice, or a parameter is missing,
    unknown or out of bounds.
    """

    def __init__(
        self,
        base: AbstractBase,
        effects: Sequence[AbstractEffect] = (),
        settings: Mapping[str, Setting] | None = None,
        period: float = 0.05,
    ) -> None:
        self.base = base
        self.effects = tuple(effects)
        self.system = base.system
        self.period = period
        self.settings = dict(settings or {})
        _check_effects(base, self.effects)
        _check_settings(self.parameters, self.settings)
        self.latent_names = tuple(path for path in self.parameters if self.settings[path].free)

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

    @cached_property
    def _commands(self) -> tuple[CommandEffect, ...]:
        return tuple(sorted((e for e in self.effects if isinstance(e, CommandEffect)), key=_stage))

    @cached_property
    def _rates(self) -> tuple[RateEffect, ...]:
        return tuple(sorted((e for e in self.effects if isinstance(e, RateEffect)), key=_stage))

    @cached_property
    def _sensors(self) -> tuple[SensorEffect, ...]:
        return tuple(sorted((e for e in self.effects if isinstance(e, SensorEffect)), key=_stage))

    @cached_property
    def _fixed(self) -> dict[str, dict[str, float]]:
        owners: dict[str, dict[str, float]] = {"base": {}, **{item.name: {} for item in self.effects}}
        for path, setting in self.settings.items():
            owner, name = path.split(".")
            owners[owner][name] = setting.value
        return owners

    def _values(self, latent: Array | None) -> Mapping[str, Named]:
        if latent is None:
            return self._fixed
        if latent.shape[-1] != len(self.latent_names):
            raise ModelFileError(
                f"latent: got {latent.shape[-1]} entries, wanted {len(self.latent_names)}: "
                f"{', '.join(self.latent_names)}"
            )
        owners: dict[str, dict[str, Scalar]] = {owner: dict(named) for owner, named in self._fixed.items()}
        for path, value in zip(self.latent_names, _columns(latent), strict=True):
            owner, name = path.split(".")
            owners[owner][name] = value
        return owners

    def with_settings(self, settings: Mapping[str, Setting]) -> PhysicsModel:
        """The same model with some settings replaced."""
        return PhysicsModel(self.base, self.effects, {**self.settings, **settings}, self.period)

    def with_effect(self, item: AbstractEffect, settings: Mapping[str, Setting]) -> PhysicsModel:
        """The model with one more effect; ``settings`` by parameter name, neutral values where left out."""
        own = {
            f"{item.name}.{p.name}": settings.get(p.name, Setting(p.neutral if p.neutral is not None else p.typical))
            for p in item.parameters
        }
        return PhysicsModel(self.base, (*self.effects, item), {**self.settings, **own}, self.period)

    def with_latent(self, latent: Array) -> PhysicsModel:
        """The model with the free parameters set to ``latent`` (latents,)."""
        return self.with_settings(
            {path: Setting(float(value), free=True) for path, value in zip(self.latent_names, latent, strict=True)}
        )

    def initial_memory(self, action: Array) -> Any:  # noqa: D102
        named = dict(zip(self.system.action_names, _columns(action), strict=True))
        return tuple(item.initial_memory(named) for item in self._commands)

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
        operations = FLOATS if _is_single(state) else operations_for(state)
        columns, memory = self._advance(
            dict(zip(self.system.state_names, _columns(state), strict=True)),
            dict(zip(self.system.action_names, _columns(action), strict=True)),
            memory,
            self._values(latent),
            self.period if period is None else period,
            time,
            operations,
        )
        return _joined([columns[name] for name in self.system.state_names], operations), memory

    def _advance(
        self,
        state: Named,
        action: Named,
        memory: Any,
        values: Mapping[str, Named],
        period: float,
        time: float,
        operations: Operations,
    ) -> tuple[Named, Any]:
        for sensor in self._sensors:
            state = sensor.restore(state, values[sensor.name])
        remembered = []
        for command, own in zip(self._commands, memory, strict=True):
            action, own_next = command.transform(action, own, values[command.name], period, operations)
            remembered.append(own_next)
        state = self._runge_kutta(state, action, values, period, time, operations)
        for sensor in reversed(self._sensors):
            state = sensor.measure(state, values[sensor.name])
        return state, tuple(remembered)

    def _derivative(
        self, state: Named, action: Named, values: Mapping[str, Named], time: float, operations: Operations
    ) -> Named:
        base = values["base"]
        rates = self.base.rates(state, action, base, operations)
        context = Context(state, action, base, time, operations)
        for item in self._rates:
            rates = item.modify(rates, values[item.name], context)
        return rates

    def _runge_kutta(
        self,
        state: Named,
        action: Named,
        values: Mapping[str, Named],
        period: float,
        time: float,
        operations: Operations,
    ) -> Named:
        half = 0.5 * period

        def moved(rates: Named, seconds: float) -> Named:
            return {name: state[name] + seconds * rates[name] for name in state}

        first = self._derivative(state, action, values, time, operations)
        second = self._derivative(moved(first, half), action, values, time + half, operations)
        third = self._derivative(moved(second, half), action, values, time + half, operations)
        fourth = self._derivative(moved(third, period), action, values, time + period, operations)
        sixth = period / 6.0
        return {
            name: state[name] + sixth * (first[name] + 2.0 * (second[name] + third[name]) + fourth[name])
            for name in state
        }

    def affine(  # noqa: D102
        self, state: Array, latent: Array | None = None, *, around: Array | None = None, memory: Any = None
    ) -> tuple[Array, Array]:
        if around is None:
            around = _like(state, 0.5 * (self.system.action_low + self.system.action_high))
        if memory is None:
            memory = self.initial_memory(around)

        def next_state(action: Array) -> Array:
            return self.advance(state, action, memory, latent)[0]

        if isinstance(state, np.ndarray):
            return self._central_difference(next_state, around)
        return _forward_mode(next_state, around)

    def _central_difference(self, next_state: Any, around: Array) -> tuple[Array, Array]:
        columns = []
        for index, variable in enumerate(self.system.action):
            nudge = _ACTION_NUDGE * (variable.high - variable.low)
            up, down = np.array(around, dtype=np.float64), np.array(around, dtype=np.float64)
            up[..., index] += nudge
            down[..., index] -= nudge
            columns.append((next_state(up) - next_state(down)) / (2.0 * nudge))
        g = np.stack(columns, axis=-1)
        return next_state(around) - np.einsum("...sa,...a->...s", g, around), g


def _forward_mode(next_state: Any, around: Any) -> tuple[Any, Any]:
    import torch

    value, columns = next_state(around), []
    for index in range(around.shape[-1]):
        direction = torch.zeros_like(around)
        direction[..., index] = 1.0
        slope = torch.func.jvp(next_state, (around,), (direction,))[1]
        columns.append(slope)
    g = torch.stack(columns, dim=-1)
    return value - torch.einsum("...sa,...a->...s", g, around), g


def _stage(item: AbstractEffect) -> int:
    return int(item.stage)


def _is_single(array: Array) -> bool:
    return isinstance(array, np.ndarray) and array.ndim == 1


def _columns(array: Array) -> list[Scalar]:
    if _is_single(array):
        return [float(value) for value in array]
    return [array[..., index] for index in range(array.shape[-1])]


def _joined(columns: list[Scalar], operations: Operations) -> Array:
    if operations is FLOATS:
        return np.array(columns)
    if operations is NUMPY:
        return np.stack(np.broadcast_arrays(*columns), axis=-1)
    import torch

    return torch.stack(torch.broadcast_tensors(*columns), dim=-1)  # type: ignore[no-untyped-call]


def _like(state: Array, action: NDArray[np.float64]) -> Array:
    shape = (*state.shape[:-1], len(action))
    if isinstance(state, np.ndarray):
        return np.broadcast_to(action, shape)
    import torch

    return torch.as_tensor(action, dtype=state.dtype, device=state.device).expand(shape).clone()


def _check_effects(base: AbstractBase, effects: Sequence[AbstractEffect]) -> None:
    seen: set[str] = set()
    for item in effects:
        if item.robot != base.system.name:
            raise ModelFileError(
                f"effect '{item.name}' belongs to robot '{item.robot}', the model to '{base.system.name}'"
            )
        if item.name in seen:
            raise ModelFileError(f"effect '{item.name}' stands twice; leave one out")
        missing = [name for name in item.needs if name not in base.system.action_names]
        if missing:
            raise ModelFileError(
                f"effect '{item.name}' needs the action '{missing[0]}', the model has "
                f"{', '.join(base.system.action_names)}; choose another effect or another drive"
            )
        seen.add(item.name)


def _check_settings(parameters: Mapping[str, Parameter], settings: Mapping[str, Setting]) -> None:
    for path, parameter in parameters.items():
        if path not in settings:
            raise ModelFileError(f"{path}: missing; give a value in {parameter.unit}")
        value = settings[path].value
        if not parameter.low <= value <= parameter.high:  # refuses NaN as well
            raise ModelFileError(f"{path}: got {value}, wanted {parameter.low} to {parameter.high} {parameter.unit}")
    unknown = [path for path in settings if path not in parameters]
    if unknown:
        raise ModelFileError(f"{unknown[0]}: unknown parameter; known: {', '.join(parameters)}")
