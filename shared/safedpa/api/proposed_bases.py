"""Bases that ``init`` proposes for the columns of a log, as Python source whose rates are linear in the parameters."""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractBase
from safedpa.effects.library import module_from
from safedpa.operations import NUMPY
from safedpa.records.column_map.recognise import PlanarMotion, changes
from safedpa.systems import System, Variable

__all__ = [
    "KINDS", "WHOLE", "ProposedBase", "RateTerm", "StateChain", "base_of", "bases_of_chain", "coupled_base",
    "fitted_start", "follows", "moving", "needed_terms", "planar_rates", "turning_base", "whole_robot",
]  # fmt: skip

WHOLE: Final = {
    "bicycle": "states x, y, yaw, speed; actions with 'steer' in the name and one more",
    "differential_drive": "states x, y, yaw, speed, turn_rate; actions with 'turn' in the name and one more",
    "multirotor": "states vx, vy, vz; actions thrust, pitch, roll",
    "planar": "positions on the floor, a heading, and velocities in the body's frame that change them",
}
"""Bases of whole robots, with the names that they need."""
KINDS: Final = ("integrator", "first_order", "double_integrator", "joint", "position_loop", "coupled", *WHOLE)
_SPANS = (2, 4, 8, 16, 32)
"""Rows over which changes are compared with the integrated equations; the best fit is taken."""
_MIDDLE = 8
"""The one of them over which terms are compared."""
_RANGE = 20.0
"""Bounds of a proposed parameter, as a multiple of its fitted value."""
_LINE = 100
"""Longest line of a rate in the proposed file; longer ones have a line for each summand."""
_SPARE = 0.01
"""Share of the lowest error on unseen rows by which terms that are left out may raise it."""
_FOLLOWS = (0.3, 1.6)
"""Slopes of a state over a command for which the state may follow the command in the same unit: 1 if it is quick."""

_FILE: Final = '''\
"""{robot}: system, base and effects, proposed from {origin}; check names, units and bounds."""

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

SYSTEM = System(
    name="{robot}",
    state=(
{states}
    ),
    action=(
{actions}
    ),
)


class Base(AbstractBase):
    """{equation}."""

    kind = "{kind}"
    equation = "{equation}"
    source = "fitted to {origin}"
    system = SYSTEM
    parameters = (
{parameters}
    )

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        return {{
{rates}
        }}


EFFECTS = general_effects(SYSTEM, moving={{{sizes}}})  # usual sizes
'''
"""The Python file of a proposal."""


@dataclass(frozen=True)
class RateTerm:
    """One summand of a rate: ``sign`` times a parameter (none if empty) times a Python expression."""

    parameter: str
    unit: str
    expression: str
    sign: int = 1
    positive: bool = False
    """Whether a fit with a negative parameter rules the base out."""

    @property
    def source(self) -> str:
        """The summand as Python, without its sign."""
        factor = [f'parameters["{self.parameter}"]'] if self.parameter else []
        return " * ".join([*factor, *([self.expression] if self.expression else [])])


@dataclass(frozen=True)
class ProposedBase:
    """A kind of base for some states: the summands of each rate, and the usual size of what forces change."""

    kind: str
    rates: Mapping[str, tuple[RateTerm, ...]]
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def equation(self) -> str:
        """The rates of the states that have parameters, for reports."""
        texts = []
        for state, terms in self.rates.items():
            if any(term.parameter for term in terms):
                text = _sum(terms).replace("operations.", "").replace(" * ", " ")
                texts.append(f"{state}' = " + re.sub(r'\w+\["(\w+)"\]', r"\1", text))
        return "; ".join(texts)

    def source(self, system: System, sizes: Mapping[str, float], origin: str) -> str:
        """The Python file with system, base and effects."""
        named = {term.parameter: term for terms in self.rates.values() for term in terms if term.parameter}
        rates = [line for name, terms in self.rates.items() for line in _rate_lines(name, terms)]
        return _FILE.format(
            robot=system.name,
            origin=origin,
            states="\n".join(map(_variable, system.state)),
            actions="\n".join(map(_variable, system.action)),
            equation=self.equation,
            kind=self.kind,
            parameters="\n".join(map(self._parameter, named.values())),
            rates="\n".join(rates),
            sizes=", ".join(f'"{name}": {size:.3g}' for name, size in sizes.items()),
        )

    def _parameter(self, term: RateTerm) -> str:
        value = self.values.get(term.parameter, 1.0)
        low, high = sorted((0.0, _RANGE * value)) if self.values else (-1e12, 1e12)
        return (
            f'        Parameter("{term.parameter}", "{term.unit}", {low:.4g}, {high:.4g}, {value:.4g}, neutral=None),'
        )


def _sum(terms: Sequence[RateTerm]) -> str:
    text = "".join(f" {'+' if term.sign > 0 else '-'} {term.source}" for term in terms)
    return text.removeprefix(" + ").removeprefix(" ")


def _rate_lines(name: str, terms: Sequence[RateTerm]) -> list[str]:
    line = f'            "{name}": {_sum(terms)},'
    if len(line) <= _LINE:
        return [line]
    rows = [f"                {'+' if term.sign > 0 else '-'} {term.source}" for term in terms]
    rows[0] = rows[0].replace("+ ", "", 1)
    return [f'            "{name}": (', *rows, "            ),"]


def _variable(item: Variable) -> str:
    angle = ", angle=True" if item.angle else ""
    return f'        Variable("{item.name}", "{item.unit}", {item.low!r}, {item.high!r}{angle}),'


def moving(base: ProposedBase) -> list[str]:
    """The states whose rates have parameters: those that forces change."""
    return [name for name, terms in base.rates.items() if any(term.parameter for term in terms)]


def base_of(source: str) -> AbstractBase:
    """The base of a proposed file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "proposed.py"
        path.write_text(source, encoding="utf-8")
        made: AbstractBase = module_from(path).Base()
    return made


Part: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Times (rows,) [s], states (rows, states) and actions (rows, actions) of a stretch of a run."""


def fitted_start(base: AbstractBase, parts: Sequence[Part]) -> dict[str, float]:
    """Least-squares parameters of rates that are linear in them, from changes over several rows; {} without a fit."""
    names = [item.name for item in base.parameters]
    best, found = np.inf, {}
    for span in _SPANS:
        equations = [_equations(base, names, part, span) for part in parts if len(part[0]) > 2 * span]
        if not equations:
            continue
        matrix = np.concatenate([left for left, _ in equations])
        target = np.concatenate([right for _, right in equations])
        size = np.linalg.norm(matrix, axis=0)
        if not np.all(size > 0.0):
            continue
        solution = np.linalg.lstsq(matrix / size, target, rcond=1e-6)[0]
        rest = float(np.mean((target - matrix / size @ solution) ** 2))
        if rest < best:
            best, found = rest, dict(zip(names, (solution / size).tolist(), strict=True))
    return found


def _equations(base: AbstractBase, names: Sequence[str], part: Part, span: int) -> tuple[FloatArray, FloatArray]:
    """Matrix and right side of matrix @ parameters = changes over ``span`` rows, each state in its usual change."""
    t, states, actions = part
    state = dict(zip(base.system.state_names, states.T, strict=True))
    action = dict(zip(base.system.action_names, actions.T, strict=True))

    def rates(on: str) -> dict[str, FloatArray]:
        found = base.rates(state, action, {name: float(name == on) for name in names}, NUMPY)
        return {name: np.broadcast_to(np.asarray(rate, dtype=np.float64), t.shape) for name, rate in found.items()}

    known, single = rates(""), [rates(name) for name in names]
    left, right = [np.empty((0, len(names)))], [np.empty(0)]
    for entry, values in state.items():
        change = changes(t, values, span)[0]
        columns = [changes(t, one[entry] - known[entry], span)[1] for one in single]
        scale = float(np.std(change))
        if scale > 0.0 and any(np.any(column) for column in columns):
            left.append(np.stack(columns, axis=1) / scale)
            right.append((change - changes(t, known[entry], span)[1]) / scale)
    return np.concatenate(left), np.concatenate(right)


def needed_terms(
    proposed: ProposedBase, base: AbstractBase, training: Sequence[Part], rest: Sequence[Part]
) -> ProposedBase:
    """The base without the parameters that changes in unseen rows do not need, least needed first."""
    names = [item.name for item in base.parameters]
    state_of = {term.parameter: state for state, terms in proposed.rates.items() for term in terms}
    grams = []
    for parts in (training, rest):
        rows = [_equations(base, names, part, _MIDDLE) for part in parts if len(part[0]) > 2 * _MIDDLE]
        if not rows:
            return proposed
        both = np.concatenate([np.column_stack(row) for row in rows])
        grams.append(both.T @ both / len(both))

    def unseen(used: list[int]) -> float:
        size = np.sqrt(np.maximum(np.diag(grams[0])[used], 1e-300))
        inverse = np.linalg.pinv(grams[0][np.ix_(used, used)] / np.outer(size, size), rcond=1e-9, hermitian=True)
        values = np.append(-inverse @ (grams[0][used, -1] / size) / size, 1.0)
        rows = [*used, len(names)]
        return float(values @ grams[1][np.ix_(rows, rows)] @ values)

    used = list(range(len(names)))
    lowest = unseen(used)
    while True:
        count = Counter(state_of[names[index]] for index in used)
        # a state without a rate could drive nothing
        errors = {
            index: unseen([other for other in used if other != index])
            for index in used
            if count[state_of[names[index]]] > 1
        }
        least = min(errors, key=lambda index: errors[index], default=None)
        if least is None or errors[least] > (1.0 + _SPARE) * lowest:
            break
        used.remove(least)
        lowest = min(lowest, errors[least])
    left = {names[index] for index in used} | {""}
    return replace(
        proposed,
        rates={state: tuple(one for one in terms if one.parameter in left) for state, terms in proposed.rates.items()},
    )


@dataclass(frozen=True)
class StateChain:
    """A state that commands change: ``position`` and, where there is one, its ``rate``; the commands that drive it."""

    position: Variable
    rate: Variable | None
    commands: tuple[Variable, ...]
    follows: str = ""
    """The command that the position follows in the same unit, if any."""
    prefix: str = ""
    """Before the names of the parameters; empty for a robot with one chain."""


def bases_of_chain(chain: StateChain) -> list[ProposedBase]:
    """The bases that the columns of a chain allow, simplest first."""
    position, rate = chain.position, chain.rate
    pushed = tuple(_gain(chain, command, rate or position) for command in chain.commands)
    if rate is None:
        name = position.name
        following = _following(chain, name, "response", "1/s")
        damping = RateTerm(f"{chain.prefix}damping", "1/s", f'state["{name}"]', -1, True)
        offset = RateTerm(f"{chain.prefix}offset", f"{position.unit}/s", "")
        kinds = [("integrator", pushed), *([("first_order", (following,))] if following else [])]
        kinds.append(("first_order", (*pushed, damping, offset)))
        return [ProposedBase(kind, {name: terms}) for kind, terms in kinds]
    way = (RateTerm("", "", f'state["{rate.name}"]'),)
    damping = RateTerm(f"{chain.prefix}damping", "1/s", f'state["{rate.name}"]', -1, True)
    kinds = [("double_integrator", pushed)]
    if position.unit == "rad":
        gravity = RateTerm(f"{chain.prefix}gravity", "rad/s2", f'operations.sin(state["{position.name}"])', -1)
        kinds.append(("joint", (*pushed, gravity)))
    following = _following(chain, position.name, "stiffness", "1/s2")
    if following:
        kinds.append(("position_loop", (following, damping)))
    return [ProposedBase(kind, {position.name: way, rate.name: terms}) for kind, terms in kinds]


def _following(chain: StateChain, name: str, parameter: str, unit: str) -> RateTerm | None:
    if not chain.follows:
        return None
    return RateTerm(f"{chain.prefix}{parameter}", unit, f'(action["{chain.follows}"] - state["{name}"])', 1, True)


def _gain(chain: StateChain, command: Variable, state: Variable) -> RateTerm:
    own = f"{command.name}_" if len(chain.commands) > 1 else ""
    unit = _rate_unit(state.unit, command.unit)
    return RateTerm(f"{chain.prefix}{own}gain", unit, f'action["{command.name}"]')


def follows(state: FloatArray, command: FloatArray) -> bool:
    """Whether a state may follow a command in the same unit; a base of that kind still competes with others."""
    if np.std(command) <= 0.0 or np.std(state) <= 0.0:
        return False
    slope = float(np.cov(state, command)[0, 1] / np.var(command))
    near = abs(float(np.mean(state) - np.mean(command))) < float(np.std(command) + np.std(state))
    return near and _FOLLOWS[0] < slope < _FOLLOWS[1] and float(np.corrcoef(state, command)[0, 1]) > 0.3


def whole_robot(system: System) -> list[ProposedBase]:
    """Bases of whole robots that the names of states and actions allow: bicycle, differential drive, multirotor."""
    names, actions = set(system.state_names), system.action_names
    found = []
    steer = next((name for name in actions if "steer" in name), "")
    turn = next((name for name in actions if re.search(r"turn|yaw|omega|angular|\bw", name)), "")
    if {"x", "y", "yaw", "speed"} <= names and len(actions) == 2 and (steer or turn):
        drive = next(name for name in actions if name != (steer or turn))
        pose = {axis: (RateTerm("", "", f'state["speed"] * operations.{f}(state["yaw"])'),) for axis, f in _AXES}
        speed = (
            RateTerm("drive_gain", "m/s2", f'action["{drive}"]'),
            RateTerm("speed_damping", "1/s", 'state["speed"]', -1, True),
        )
        if steer:
            tangent = f'operations.sin(action["{steer}"]) / operations.cos(action["{steer}"])'
            yaw = (RateTerm("turn_gain", "1/m", f'state["speed"] * {tangent}'),)
            found.append(ProposedBase("bicycle", {**pose, "yaw": yaw, "speed": speed}))
        elif "turn_rate" in names:
            answer = RateTerm("turn_response", "1/s", f'(action["{turn}"] - state["turn_rate"])', 1, True)
            rest = {"yaw": (RateTerm("", "", 'state["turn_rate"]'),), "speed": speed, "turn_rate": (answer,)}
            found.append(ProposedBase("differential_drive", {**pose, **rest}))
    if {"vx", "vy", "vz"} <= names and {"thrust", "pitch", "roll"} <= set(actions):
        thrust, pitch, roll = 'action["thrust"]', 'action["pitch"]', 'action["roll"]'
        gain = "thrust_gain"
        rates = {
            "vx": (RateTerm(gain, "1", f"{thrust} * operations.sin({pitch}) * operations.cos({roll})"),),
            "vy": (RateTerm(gain, "1", f"{thrust} * operations.sin({roll})", -1),),
            "vz": (
                RateTerm(gain, "1", f"{thrust} * operations.cos({pitch}) * operations.cos({roll})"),
                RateTerm("gravity", "m/s2", "", -1),
            ),
        }
        found.append(ProposedBase("multirotor", rates))
    return found


def coupled_base(system: System, rate_of: Mapping[str, str]) -> ProposedBase:
    """Rates that are linear in all states and actions: states that drive each other, as a current drives a motor.

    A state in ``rate_of`` changes by its rate, which is linear instead. Angles that wrap drive nothing.
    """
    rates: dict[str, tuple[RateTerm, ...]] = {}
    sources = [("state", item) for item in system.state if not item.angle] + [("action", one) for one in system.action]
    for state in system.state:
        if state.name in rate_of:
            rates[state.name] = (RateTerm("", "", f'state["{rate_of[state.name]}"]'),)
            continue
        terms = [
            RateTerm(f"{state.name}_by_{item.name}", _rate_unit(state.unit, item.unit), f'{kind}["{item.name}"]')
            for kind, item in sources
        ]
        rates[state.name] = (*terms, RateTerm(f"{state.name}_offset", _rate_unit(state.unit, "1"), ""))
    return ProposedBase("coupled", rates)


def _rate_unit(unit: str, per: str) -> str:
    """The unit of a coefficient: that of the rate of a state over that of what it multiplies."""
    if per == unit:
        return "1/s"
    rate = f"{unit}2" if unit.endswith("/s") else f"{unit}/s"
    factor = f"({per})" if {" ", "/"} & set(per) else per
    return rate if factor == "1" else f"{rate}/{factor}"


def planar_rates(motion: PlanarMotion, turn: str) -> dict[str, tuple[RateTerm, ...]]:
    """Rates of position and heading: the velocities of the body's frame, turned by the heading, and the turn rate."""
    forward, yaw = f'state["{motion.forward}"]', f'state["{motion.yaw}"]'
    side = f'state["{motion.lateral}"]'
    lateral = {
        "x": (RateTerm("", "", f"{side} * operations.sin({yaw})", -1),),
        "y": (RateTerm("", "", f"{side} * operations.cos({yaw})"),),
    }
    found = {
        getattr(motion, axis): (
            RateTerm("", "", f"{forward} * operations.{function}({yaw})"),
            *(lateral[axis] if motion.lateral else ()),
        )
        for axis, function in _AXES
    }
    return {**found, motion.yaw: (RateTerm("", "", f'state["{turn}"]'),)}


def turning_base(chain: StateChain, forward: str) -> list[ProposedBase]:
    """A turn rate that commands change in proportion to the forward velocity, as of a rudder or a steered wheel."""
    name = chain.position.name
    pushed = tuple(
        replace(term, unit="1/s/m", expression=f'{term.expression} * state["{forward}"]')
        for term in (_gain(chain, command, chain.position) for command in chain.commands)
    )
    damping = RateTerm(f"{chain.prefix}damping", "1/s", f'state["{name}"]', -1, True)
    return [ProposedBase("turning", {name: (*pushed, damping)})] if pushed else []


_AXES = (("x", "cos"), ("y", "sin"))
