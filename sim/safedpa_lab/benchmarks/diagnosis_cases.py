"""Logs with an effect hidden in each, what a peer is given of them, and when its answer is right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.records import load_run
from safedpa.records.run import Run

__all__ = ["CASES", "NAMES", "Hidden", "expression_is_right", "reported", "terms_are_right", "written"]


NAMES: Final = ("speed", "target", "steer", "sign")
"""What a peer may use: the speed, both commands, and the sign of the speed."""


@final
@dataclass(frozen=True)
class Hidden:
    """What is hidden, and which terms of the speed's and the yaw's derivative say so; any of the sets will do."""

    name: str
    effects: Mapping[str, Mapping[str, float]]
    push: tuple[frozenset[str], ...] = (frozenset(),)
    turn: tuple[frozenset[str], ...] = (frozenset(),)
    turn_further: tuple[frozenset[str], ...] = ()
    """Variables that an expression for the yaw may name as well: tan(steer + offset) is no polynomial."""


def _any(*sets: str) -> tuple[frozenset[str], ...]:
    return tuple(frozenset(names.split(", ")) for names in sets)


_DRAG, _OFFSET = _any("speed sign", "speed^2", "speed^2, speed sign"), _any("speed")
_BOTH = _any("speed, steer")
_RESISTANCE = _any("sign", "1, sign")
CASES: Final = (
    Hidden("nothing", {}),
    Hidden("quadratic drag", {"quadratic_drag": {"coefficient": 0.12}}, push=_DRAG),
    Hidden("viscous drag", {"viscous_drag": {"coefficient": 0.3}}, push=_any("speed")),
    Hidden("rolling resistance", {"rolling_resistance": {"deceleration": 0.45}}, push=_RESISTANCE),
    Hidden("payload", {"payload": {"mass_ratio": 0.3}}, push=_any("speed, target")),
    Hidden("steering offset", {"steering_offset": {"angle": 0.04}}, turn=_OFFSET, turn_further=_BOTH),
    Hidden("steering gain", {"steering_gain": {"gain": 0.85}}, turn=_any("speed steer")),
    Hidden(
        "drag and offset",
        {"quadratic_drag": {"coefficient": 0.12}, "steering_offset": {"angle": 0.04}},
        push=_DRAG,
        turn=_OFFSET,
        turn_further=_BOTH,
    ),
    Hidden(
        "resistance and offset",
        {"rolling_resistance": {"deceleration": 0.45}, "steering_offset": {"angle": 0.04}},
        push=_RESISTANCE,
        turn=_OFFSET,
        turn_further=_BOTH,
    ),
)
"""Effects of ordinary strength that a polynomial of the variables can say; two of the cases hide a pair."""


def written(hidden: Hidden, folder: Path, runs: int, seconds: float) -> Any:
    """Simulates and writes one case; where it lies."""
    from safedpa_lab.hidden.case import Case
    from safedpa_lab.hidden.write import write_case

    case = Case("benchmark", 7, dict(hidden.effects), runs=runs, seconds=seconds)
    return write_case(case, folder)


def reported(log: Any) -> dict[str, Any]:
    """What a peer is given of a case: per run what the given model leaves of yaw and speed, and the variables."""
    model = load_model(log.model)
    described = [_left_over(model, load_run(path, model.system)) for path in log.runs]
    return {
        "period": model.period,
        "names": list(NAMES),
        "runs": [
            {"rests": rests.tolist(), "slopes": (steps / model.period).tolist(), "middle": middle.tolist()}
            for rests, steps, middle in described
        ],
    }


def _left_over(model: PhysicsModel, run: Run) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What one period's steps of yaw and speed have beyond the model's (n, 2), their sums, the variables (n, 4).

    The model's rates are averaged over both ends of a period, with the command that was held in between.
    """
    base = {path.split(".")[1]: setting.value for path, setting in model.settings.items()}
    limit, commands = base["acceleration_limit"], run.actions[:-1]
    target, steer = commands.T
    speed, yaw = run.states[:, 3], np.unwrap(run.states[:, 2])
    ends = (speed[:-1], speed[1:])
    push = sum(0.5 * np.clip(base["speed_gain"] * (target - end), -limit, limit) for end in ends)
    middle = 0.5 * (ends[0] + ends[1])
    turn = middle * np.tan(steer) / base["wheelbase"]
    steps = np.stack([np.diff(yaw) - model.period * turn, np.diff(speed) - model.period * push], axis=1)
    rests = np.cumsum(steps, axis=0) - 0.5 * steps
    return rests, steps, np.stack([middle, target, steer, np.tanh(middle / 0.02)], axis=1)


def terms_are_right(hidden: Hidden, equations: Sequence[Mapping[str, float]]) -> bool:
    """Whether the equations of yaw and speed hold exactly the terms that are hidden."""
    turn, push = (frozenset(equation) for equation in equations)
    return turn in hidden.turn and push in hidden.push


def expression_is_right(hidden: Hidden, variables: Sequence[Sequence[str]]) -> bool:
    """Milder: whether the expressions for yaw and speed name the right variables, whatever they do with them."""
    turn, push = (frozenset(names) for names in variables)
    return turn in (*_variables(hidden.turn), *hidden.turn_further) and push in _variables(hidden.push)


def _variables(wanted: Sequence[frozenset[str]]) -> list[frozenset[str]]:
    return [frozenset(" ".join(terms).replace("^2", "").split()) - {"1"} for terms in wanted]
