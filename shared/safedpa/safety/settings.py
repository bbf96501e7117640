"""The settings of the filter and their TOML file. Errors name the key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.barrier_setting import BarrierSetting
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import finite_number, parse_toml, text_of_file
from safedpa.result import one_line
from safedpa.systems.robots import robot_named, robots
from safedpa.systems.system import System

__all__ = [
    "FilterSettings",
    "load_settings",
    "parse_settings",
    "save_settings",
    "write_settings",
]

FORMAT = 2
MARGINS = ("conformal", "drive", "theorem")
"""Names of the margins of a calibration."""
_BOUNDS = ("action_low", "action_high")


@final
@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """The settings of the filter, checked at construction; the bounds of the actions are required.

    ``action_low`` and ``action_high`` (actions,): hard actuator bounds, in the units of the actions.

    ``system``: the name of the system of these settings; a filter refuses every other one. Empty: the user's own
    system, of which only the action bounds are known.

    ``enabled``: whether the filter changes actions; else it only keeps them within the bounds.

    ``eta``: 1 per step, in (0, 1]: the share of h that one step may use up; h falls with a time constant of
    period / eta.

    ``epsilon``: margin by kind of barrier, in the unit of h, >= 0; ``default`` applies to other kinds, else 0. One
    number applies to all kinds.

    ``margin``: which margin of a calibration the filter uses: ``conformal`` (for a step), ``drive``, ``theorem``, or
    this number.

    ``weights`` (actions,) > 0: cost of changing an action over its whole range; empty: all 1.

    ``backup_action`` (actions,): action if no decision can be computed; empty: 0, clipped to the bounds.

    ``relinearisations``: how often the program is linearised again at its solution, if the model is not affine in the
    action.

    ``plausible_nominal``: a nominal action further outside the bounds than this multiple of the range is refused.

    ``barriers``: parameters of the robot's barriers by name (``AbstractRobot.barrier_settings``); others have their
    default. In a file they are keys next to the others.

    ``for_robot`` takes the bounds of a known robot. Raises InputError naming the key, what was got and what was wanted.

    Example:

        >>> safedpa.FilterSettings(action_low=(-1.0,), action_high=(1.0,), eta=0.3).resting_action
        array([0.])
    """

    system: str = ""
    enabled: bool = True
    eta: float = 0.2
    epsilon: Mapping[str, float] = field(default_factory=lambda: {"obstacle": 0.01, "field": 0.01, "speed": 0.01})
    margin: str | float = "conformal"
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    weights: tuple[float, ...] = ()
    backup_action: tuple[float, ...] = ()
    relinearisations: int = 3
    plausible_nominal: float = 10.0
    barriers: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def for_robot(cls, robot: str | System, **changes: Any) -> FilterSettings:
        """Settings with the actuator bounds of a robot, by its name or system; ``changes`` sets other fields.

        The remaining fields keep the general defaults; ``settings_named`` reads the settings that ship for a robot.
        Raises InputError for an unknown name.

        Example:

            >>> safedpa.FilterSettings.for_robot("pendulum", eta=0.3).system
            'pendulum'
        """
        system = robot_named(robot).system if isinstance(robot, str) else robot
        known = robots()[system.name].of_system(system) if system.name in robots() else None
        # The name is not enough: a system of the user with the same name may have other actuators.
        own = () if known is None or known.system != system else known.nominal_range
        low, high = zip(*(own or [(each.low, each.high) for each in system.action]), strict=True)
        return cls(**{"system": system.name, "action_low": low, "action_high": high, **changes})

    def __post_init__(self) -> None:
        if not isinstance(self.system, str):
            raise InputError(f"system: got {self.system!r}, wanted the name of a system, or '' for one of your own")
        # A frozen dataclass: the validated values replace those that were given, such as lists by tuples.
        for name in ("action_low", "action_high", "weights", "backup_action"):
            object.__setattr__(self, name, _numbers(name, getattr(self, name)))
        object.__setattr__(self, "epsilon", _margins(self.epsilon))
        _check_margin(self.margin)
        if not isinstance(self.enabled, bool):
            raise InputError(f"enabled: got {self.enabled!r}, wanted true or false")
        self._check_actions()
        # After the system is known: its barriers define which parameters exist.
        object.__setattr__(self, "barriers", _barriers(self.system, self.barriers))
        _number("plausible_nominal", self.plausible_nominal, 0.0, math.inf, open_low=True)
        _number("eta", self.eta, 0.0, 1.0, open_low=True)
        if isinstance(self.relinearisations, bool) or not isinstance(self.relinearisations, int):
            raise InputError(f"relinearisations: got {self.relinearisations!r}, wanted a whole number")
        _number("relinearisations", self.relinearisations, 0, 20)

    def _check_actions(self) -> None:
        count = len(self.action_low)
        if count == 0 or len(self.action_high) != count:
            raise InputError(
                f"action_high: got {len(self.action_high)} numbers, action_low has {count}; wanted as many, at least 1"
            )
        for low, high in zip(self.action_low, self.action_high, strict=True):
            if low >= high:
                raise InputError(f"action_low: got {low}, wanted less than action_high {high}")
        for name in ("weights", "backup_action"):
            if len(getattr(self, name)) not in (0, count):
                raise InputError(f"{name}: got {len(getattr(self, name))} numbers, wanted {count} or none")
        if any(weight <= 0.0 for weight in self.weights):
            raise InputError(f"weights: got {self.weights}, wanted positive numbers")
        # Not strict: an empty backup_action is valid, and its length was checked above.
        for low, value, high in zip(self.action_low, self.backup_action, self.action_high, strict=False):
            if not low <= value <= high:
                raise InputError(f"backup_action: got {value}, wanted {low} to {high}")

    def __repr__(self) -> str:
        # Only what differs from the defaults, and always the bounds: the whole would be longer than a line.
        usual = FilterSettings(system=self.system, action_low=self.action_low, action_high=self.action_high)
        shown = ("system", *_BOUNDS)
        changed = [item.name for item in fields(self) if getattr(self, item.name) != getattr(usual, item.name)]
        return one_line("FilterSettings", {name: getattr(self, name) for name in (*shown, *changed)})

    def barrier(self, name: str) -> float:
        """A parameter of the barriers. Raises InputError if the robot of these settings has none of that name."""
        if name in self.barriers:
            return self.barriers[name]
        known = {item.name: item for item in _declared(self.system)}
        if name not in known:
            raise InputError(f"settings of '{self.system}': no '{name}' among them; {did_you_mean(name, known)}")
        return known[name].default

    def with_barriers(self, **numbers: float) -> FilterSettings:
        """A copy with these parameters of the barriers."""
        return replace(self, barriers={**self.barriers, **numbers})

    @property
    def low(self) -> NDArray[np.float64]:
        """Lower actuator bounds (actions,)."""
        return np.array(self.action_low)

    @property
    def high(self) -> NDArray[np.float64]:
        """Upper actuator bounds (actions,)."""
        return np.array(self.action_high)

    @property
    def weight_vector(self) -> NDArray[np.float64]:
        """Weights (actions,), 1 if none are set."""
        return np.array(self.weights or (1.0,) * len(self.action_low))

    @property
    def resting_action(self) -> NDArray[np.float64]:
        """The backup action (actions,), which needs no state."""
        wanted = np.array(self.backup_action or (0.0,) * len(self.action_low))
        # 0 may lie outside the bounds, for example for a thrust that is always positive.
        return np.asarray(np.minimum(np.maximum(wanted, self.low), self.high))


_ONCE_IN_EVERY_FILE = (
    "braking_deceleration",
    "braking_gain",
    "clearance",
    "corridor_seconds",
    "speed_high",
    "speed_low",
)
"""Keys that older programs wrote for every robot; for a robot without such a barrier they are ignored."""


def load_settings(path: str | Path) -> FilterSettings:
    """Reads settings from a TOML file. Raises InputError naming the file and the key."""
    try:
        text = text_of_file(Path(path), "toml_bytes")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); wanted a settings file of the filter") from error
    try:
        return parse_settings(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def parse_settings(text: str) -> FilterSettings:
    """Reads settings from a TOML text; missing keys keep their defaults.

    Bounds that are missing are those of the robot that ``system`` names. Raises InputError naming the key.
    """
    table = parse_toml(text)
    system = str(table.get("system", ""))
    known = [item.name for item in fields(FilterSettings) if item.name != "barriers"]
    if table.pop("format", FORMAT) != FORMAT:
        raise InputError(f"format: wanted {FORMAT}; convert an earlier file with 'safedpa migrate'")
    # Barrier parameters are plain keys of the file, so they are separated from the filter's own by the robot's
    # declaration.
    own = {item.name for item in _declared(system)}
    barriers = {key: table.pop(key) for key in list(table) if key in own and key not in known}
    for key in list(table):
        if key in known:
            continue
        if key not in _ONCE_IN_EVERY_FILE:
            raise InputError(f"{key}: unknown key; {did_you_mean(key, [*known, *own])}")
        del table[key]
    missing = [name for name in _BOUNDS if name not in table]
    if not missing:
        return FilterSettings(**table, barriers=barriers)
    # Bounds of another robot would be limits that these actuators do not have.
    if system not in robots():
        raise InputError(f"{missing[0]}: missing; wanted the bounds of the actions, or the name of a robot as system")
    return FilterSettings.for_robot(system, **table, barriers=barriers)


def _declared(system: str) -> tuple[BarrierSetting, ...]:
    """The parameters of a robot's barriers; for an unknown robot those of all robots."""
    known = robots()
    if system in known:
        return known[system].barrier_settings
    # Reversed, so that of equal names the robot that was declared first counts.
    return tuple({item.name: item for robot in reversed(known.values()) for item in robot.barrier_settings}.values())


def _barriers(system: str, given: Any) -> dict[str, float]:
    """The parameters of the barriers, all of them if the robot is known."""
    if not isinstance(given, Mapping):
        raise InputError(f"barriers: got {given!r}, wanted numbers by name")
    declared = {item.name: item for item in _declared(system)}
    for name in given:
        if name not in declared:
            raise InputError(f"{name}: no setting of the barriers of '{system}'; {did_you_mean(str(name), declared)}")
    # For an unknown robot no defaults are added: they would be those of some other robot.
    complete = {item.name: item.default for item in declared.values()} if system in robots() else {}
    found = {**complete, **{name: declared[name].checked(value) for name, value in given.items()}}
    for item in declared.values():
        # Pairs such as speed_low and speed_high must stay in order, also if only one of them is set.
        if item.above and item.name in found:
            least = found.get(item.above, declared[item.above].default)
            if found[item.name] <= least:
                raise InputError(f"{item.name}: got {found[item.name]}, wanted more than {item.above} {least}")
    return found


def save_settings(settings: FilterSettings, path: str | Path) -> None:
    """Writes ``write_settings`` to a file."""
    Path(path).write_text(write_settings(settings), encoding="utf-8")


def write_settings(settings: FilterSettings) -> str:
    """The TOML text that ``parse_settings`` reads back to the same settings."""
    lines = [f"format = {FORMAT}"]
    for item in fields(FilterSettings):
        value = getattr(settings, item.name)
        if isinstance(value, tuple):
            lines.append(f"{item.name} = {list(value)!r}")
        elif item.name == "barriers":
            lines += [f"{name} = {number!r}" for name, number in value.items()]
        elif isinstance(value, Mapping):
            entries = ", ".join(f'"{kind}" = {number!r}' for kind, number in value.items())
            lines.append(f"{item.name} = {{ {entries} }}")
        else:
            lines.append(f"{item.name} = {str(value).lower() if isinstance(value, bool) else repr(value)}")
    return "\n".join(lines) + "\n"


def _check_margin(value: Any) -> None:
    if isinstance(value, str):
        if value not in MARGINS:
            raise InputError(f"margin: got '{value}', wanted a number >= 0, or {did_you_mean(value, MARGINS)}")
    else:
        _number("margin", value, 0.0, math.inf)


def _margins(value: Any) -> dict[str, float]:
    # A single number is a margin for every kind.
    table = value if isinstance(value, Mapping) else {"default": value}
    return {str(kind): _number(f"epsilon.{kind}", number, 0.0, math.inf) for kind, number in table.items()}


def _numbers(name: str, value: Any) -> tuple[float, ...]:
    # Lists compare and print by value; an array in a frozen dataclass would do neither.
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (list, tuple)):
        raise InputError(f"{name}: got {value!r}, wanted a list of numbers")
    return tuple(_number(name, entry, -math.inf, math.inf) for entry in value)


def _number(name: str, value: Any, low: float, high: float, *, open_low: bool = False) -> float:
    finite_number(name, value)
    if not low <= value <= high or (open_low and value == low):
        above = "more than" if open_low else "at least"
        raise InputError(
            f"{name}: got {value}, wanted {above} {low}" + ("" if high == math.inf else f", at most {high}")
        )
    return float(value)
