"""General effects for a user's own system: on each command, each state that forces change, and each sensor.

``general_table`` says what their residuals look like, where they are described, and what a search combines them with.
``general_effects`` chooses by what the system declares: no spring without a position, no coupling with one axis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from math import isfinite
from typing import Final

from safedpa.effects.channel_effects import ChannelEffect
from safedpa.effects.effect import AbstractEffect
from safedpa.effects.general_parameters import channel_parameters, sensor_delay_parameters, state_parameters
from safedpa.effects.general_table import TABLE
from safedpa.effects.parameter import Parameter
from safedpa.effects.state_effects import Mixed, StateEffect, StateSensor, TorqueSpeed, VectorDrag
from safedpa.errors import InputError, did_you_mean
from safedpa.systems import System, Variable

_PERIOD: Final = 0.05
"""s; the period for which effects are declared until a model or a search asks for another."""


def general_effects(
    system: System,
    moving: Mapping[str, float] | None = None,
    *,
    positions: Mapping[str, str] | None = None,
    vectors: Mapping[str, Sequence[str]] | None = None,
    heading: str = "",
    supply: Mapping[str, float] | None = None,
) -> tuple[AbstractEffect, ...]:
    """Returns the effects that commands, states and sensors of any robot may have, by what the system declares.

    ``moving``: the states that forces change (speeds, rates), each with its usual size in its unit. ``positions``: by
    rate, the state that it is the rate of; by default found by names and units. ``vectors``: groups of speeds with
    common drag, by name; by default all speeds in m/s, if there are several. ``heading``: the angle of the body, if
    the first two speeds of each vector are in the world's frame. ``supply``: measured inputs among the actions, with
    their nominal values, such as {"battery": 12.0}. Actions without finite bounds are taken to reach 1 of their unit.

    Raises InputError for a name that the system lacks, or a size that is not above 0.

    Example:

        >>> cart = System("cart", (Variable("speed", "m/s", -9.0, 9.0),), (Variable("drive", "N", -1.0, 1.0),))
        >>> [item.name for item in general_effects(cart, moving={"speed": 1.0}) if item.family == "speed_limit"]
        ['speed_speed_limit']
    """
    sizes, measured = dict(moving or {}), dict(supply or {})
    _check(system, sizes, "moving")
    found_pairs = position_of_rate(system) if positions is None else dict(positions)
    pairs = {rate: position for rate, position in found_pairs.items() if positions is not None or rate in sizes}
    groups = _vectors(system, sizes) if vectors is None else {name: tuple(axes) for name, axes in vectors.items()}
    _check(system, [*pairs, *pairs.values()], "positions")
    _check(system, [*(axis for axes in groups.values() for axis in axes), *([heading] if heading else [])], "vectors")
    for name in measured:
        if name not in system.action_names:
            raise InputError(f"supply: got '{name}'; {did_you_mean(name, system.action_names)}")
    for name, size in (*sizes.items(), *measured.items()):
        if not (isfinite(size) and size > 0.0):
            raise InputError(f"moving: {name}: got {size!r}, wanted its usual size, above 0")
    commands = [action for action in system.action if action.name not in measured]
    found: list[AbstractEffect] = []
    for action in commands:
        found += _of_command(system, action, measured)
    found += _between(system.name, commands)
    for name, size in sizes.items():
        found += _of_state(system, _variable(system, name), size, pairs.get(name, ""))
    found += _of_several(system, sizes, groups, heading)
    if len(sizes) == 1 or len(commands) == 1:  # else it is unknown which command drives which state
        drives = [(commands[index], name) for index in range(len(commands)) for name in sizes][: len(commands)]
        found += [_torque_speed(system.name, action, name, sizes[name]) for action, name in drives]
    for rate, position in pairs.items():
        found += _of_sensors(system, rate, position, sizes.get(rate, 1.0))
    return tuple(found)


def position_of_rate(system: System) -> dict[str, str]:
    """Returns the position of each rate, as far as names and units show it.

    A rate of a state in unit U has the unit U/s. It is called ``{position}_rate``, ``v{position}``, or it is the only
    state of its unit, with one position only. Coordinates of a body with a heading have none: its
    speeds may be those of its own frame.
    """
    plane = _coordinates_of_plane(system)
    found = {}
    for rate in system.state:
        near = [item.name for item in system.state if rate.unit == f"{item.unit}/s" and item.name not in plane]
        called = [name for name in near if rate.name in (f"{name}_rate", f"{name}_dot", f"v{name}", f"d{name}")]
        alone = len(near) == 1 and sum(item.unit == rate.unit for item in system.state) == 1
        if called or alone:
            found[rate.name] = (called or near)[0]
    return found


def _coordinates_of_plane(system: System) -> set[str]:
    """Returns the coordinates of a body that moves in a plane or in space: several lengths, and an attitude."""
    lengths = {item.name for item in system.state if item.unit == "m"}
    turns = system.rotations or any(item.unit == "rad" for item in system.state)
    return lengths if len(lengths) > 1 and turns else set()


def _check(system: System, names: Sequence[str] | Mapping[str, float], what: str) -> None:
    for name in names:
        if name not in system.state_names:
            raise InputError(f"{what}: got '{name}'; {did_you_mean(name, system.state_names)}")


def _variable(system: System, name: str) -> Variable:
    return system.state[system.state_names.index(name)]


def _vectors(system: System, sizes: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
    axes = tuple(name for name in sizes if _variable(system, name).unit == "m/s")
    return {"velocity": axes} if len(axes) > 1 else {}


def _of_command(system: System, action: Variable, supply: Mapping[str, float]) -> Iterator[AbstractEffect]:
    largest = max(abs(action.low), abs(action.high))
    size = largest if isfinite(largest) else 1.0
    kinds = [name for name in _CHANNEL if name not in _SIGNED or action.low < 0.0]
    kinds += ["reservoir"] if action.low >= 0.0 else []
    for kind in kinds:  # an action that cannot be negative starts at its own dead zone: an offset says the same
        declare, about = partial(channel_parameters, kind, action.unit, size), TABLE[kind]
        yield ChannelEffect(
            system.name,
            f"{action.name}_{kind}",
            action.name,
            kind,
            declare(_PERIOD),
            signature=about.signature,
            source=about.source,
            needs=(action.name,),
            partners=tuple(f"{action.name}_{other}" for other in about.partners),
            rare=about.rare,
            by_period=declare if kind in _BY_PERIOD else None,
        )
    for other, nominal in supply.items():
        share = Parameter("share", "1", -2.0, 2.0, 1.0)
        mixed = Mixed(system.name, action.name, other, (share,), nominal)
        mixed.described(TABLE["supply"].signature, TABLE["supply"].source, (f"{action.name}_gain",))
        yield mixed


_CHANNEL: Final = (
    "gain", "offset", "lag", "delay", "limit", "dead_zone", "curve", "limit_up_down", "backlash", "slew_limit",
    "slew_limit_up_down", "second_order", "lag_up_down",
)  # fmt: skip
_SIGNED: Final = ("dead_zone", "limit_up_down")
_BY_PERIOD: Final = ("reservoir", "lag", "lag_up_down", "delay", "slew_limit", "slew_limit_up_down", "second_order")


def _between(robot: str, commands: Sequence[Variable]) -> Iterator[AbstractEffect]:
    for one in commands:
        for other in commands:
            if one is not other and one.unit == other.unit:
                mixed = Mixed(robot, one.name, other.name, (Parameter("share", "1", -2.0, 2.0, 0.1),))
                mixed.described(TABLE["coupling"].signature, TABLE["coupling"].source, rare=True)
                yield mixed


def _of_state(system: System, state: Variable, size: float, position: str) -> Iterator[AbstractEffect]:
    where = _variable(system, position) if position else None
    heading = bool(_coordinates_of_plane(system))  # an angle in the plane: neither gravity nor a spring acts on it
    for kind, parameters in state_parameters(state, size, where).items():
        if kind in ("spring", "gravity", "end_stop") and heading:
            continue
        item = StateEffect(system.name, state.name, kind, parameters, size, position if kind in _PLACED else "")
        about = TABLE[kind]
        partners = tuple(name for other in about.partners for name in _named(other, state.name, system))
        item.described(about.signature, about.source, partners, rare=about.rare)
        yield item


def _named(kind: str, state: str, system: System) -> list[str]:
    """Returns the names of the effects of one kind that a state's effect is combined with."""
    if kind.startswith("@"):
        return [f"{name}_{kind[1:]}" for name in system.action_names]
    return [f"{state}_{kind}"]


_PLACED: Final = ("spring", "gravity", "end_stop")


def _of_several(
    system: System, sizes: Mapping[str, float], groups: Mapping[str, tuple[str, ...]], heading: str
) -> Iterator[AbstractEffect]:
    for one in sizes:
        for other in sizes:
            if one != other and _variable(system, one).unit == _variable(system, other).unit:
                shared = (Parameter("coefficient", "1/s", -50.0, 50.0, 0.3),)
                item = StateEffect(system.name, one, "coupling", shared, sizes[one], other)
                item.described(TABLE["coupling"].signature, TABLE["coupling"].source, rare=True)
                yield item
    for name, axes in groups.items():
        size = max(sizes.get(axis, 1.0) for axis in axes)
        linear = (Parameter("coefficient", "1/s", 0.0, 50.0, 0.3),)
        drags = [
            VectorDrag(system.name, name, axes, linear),
            VectorDrag(
                system.name,
                name,
                axes,
                (Parameter("coefficient", "1/m", 0.0, 50.0 / size, 0.3 / size),),
                quadratic=True,
            ),
        ]
        if heading:
            own = tuple(Parameter(side, "1/s", 0.0, 50.0, 0.3) for side in ("along", "across"))
            drags.append(VectorDrag(system.name, name, axes, own, heading=heading))
        for drag in drags:
            about = TABLE[drag.family]
            drag.described(about.signature, about.source, rare=about.rare)
            yield drag


def _torque_speed(robot: str, action: Variable, state: str, size: float) -> AbstractEffect:
    item = TorqueSpeed(robot, action.name, state, (Parameter("slope", "1", 0.0, 5.0 / size, 0.3 / size),))
    about = TABLE["torque_speed"]
    item.described(about.signature, about.source, (f"{action.name}_gain",), rare=about.rare)
    return item


def _of_sensors(system: System, rate: str, position: str, size: float) -> Iterator[AbstractEffect]:
    unit, place = _variable(system, rate).unit, _variable(system, position)
    bias = Parameter("bias", unit, -5.0 * size, 5.0 * size, 0.05 * size)
    declared = [
        (rate, "bias", (bias,), None),
        (rate, "scale", (Parameter("scale", "1", 0.1, 10.0, 1.1, neutral=1.0),), None),
        (position, "bias", (Parameter("bias", place.unit, -10.0, 10.0, 0.03),), None),
        (position, "sensor_delay", sensor_delay_parameters(_PERIOD), sensor_delay_parameters),
    ]
    for state, kind, parameters, by_period in declared:
        item = StateSensor(system.name, state, kind, parameters, rate)
        about = TABLE[kind]
        item.described(about.signature, about.source, rare=about.rare, by_period=by_period)
        yield item
