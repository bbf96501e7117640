"""The values of a model's parameters, and the checks that parameters and effects fit together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from safedpa.dynamics.base import AbstractBase
from safedpa.effects.effect import AbstractEffect
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError, did_you_mean

LATENT_PREFIX = "latent_"
"""Prefix of the base's parameters that are entries of a learned latent: latent_0, latent_1, ..."""


@dataclass(frozen=True)
class Setting:
    """The value of one parameter; a ``free`` one is fitted by the diagnosis and estimated by the adaptation."""

    value: float
    free: bool = False

    def __post_init__(self) -> None:
        # a fit passes NumPy's scalars, which a model file would print as np.float64(...)
        object.__setattr__(self, "value", float(self.value))


def base_default(parameter: Parameter) -> Setting:
    """Returns the setting of a base's parameter that a file leaves out; a learned latent is free, to be estimated."""
    assert parameter.neutral is not None
    return Setting(parameter.neutral, free=parameter.name.startswith(LATENT_PREFIX))


def wanted(parameter: Parameter) -> str:
    """Returns the range of a parameter for messages: ``0 to 5 m/s2``."""
    unit = "(no unit)" if parameter.unit == "1" else parameter.unit
    return f"{parameter.low:g} to {parameter.high:g} {unit}"


def check_effects(base: AbstractBase, effects: Sequence[AbstractEffect]) -> None:
    """Raises ModelFileError when an effect is listed twice, or does not fit the robot or its actions."""
    seen: set[str] = set()
    for item in effects:
        if item.robot != base.system.name:
            raise ModelFileError(
                f"effect '{item.name}' belongs to robot '{item.robot}', the model to '{base.system.name}'; leave it out"
            )
        if item.name in seen:
            raise ModelFileError(f"effect '{item.name}' is listed twice; leave one out")
        missing = [name for name in item.needs if name not in base.system.action_names]
        if missing:
            raise ModelFileError(
                f"effect '{item.name}' needs the action '{missing[0]}', the model has "
                f"{', '.join(base.system.action_names)}; choose another effect or another drive"
            )
        seen.add(item.name)


def check_settings(parameters: Mapping[str, Parameter], settings: Mapping[str, Setting]) -> None:
    """Raises ModelFileError when a parameter is missing, unknown, out of bounds or not a number."""
    for path, parameter in parameters.items():
        if path not in settings:
            # a mistyped path is missing under its right name: report the typing error, which suggests that name
            check_values(parameters, settings)
            raise ModelFileError(f"{path}: missing; give a number, {wanted(parameter)}")
    check_values(parameters, settings)


def check_values(parameters: Mapping[str, Parameter], settings: Mapping[str, Setting]) -> None:
    """Raises ModelFileError when a parameter is unknown, out of bounds or not a number."""
    for path in settings:
        if path not in parameters:
            raise ModelFileError(f"{path}: unknown parameter; {did_you_mean(path, parameters)}")
    for path, setting in settings.items():
        parameter = parameters[path]
        if not parameter.low <= setting.value <= parameter.high:  # written so that NaN fails
            raise ModelFileError(f"{path}: got {setting.value:g}, wanted {wanted(parameter)}")
