"""The next experiment: the manoeuvre for which the surviving models differ most, in units of the noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.report_schema import Experiment
from safedpa.dynamics import PhysicsModel
from safedpa.systems import System, Variable

__all__ = ["choose_experiment", "discriminating_manoeuvres", "general_manoeuvres", "manoeuvres"]

_SECONDS = 6.0
_AFTER = 1.0
"""s; from then on outcomes count."""
_SMALL, _LARGE = 0.2, 0.5
"""Of an action's range, from where it rests."""


def manoeuvres(model: PhysicsModel) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Start (states,) and actions (rows, actions) of each manoeuvre, by what one would say."""
    t = np.arange(0.0, _SECONDS, model.period)
    names = model.system.action_names
    if names == ("torque",):
        return _pendulum(t)
    return _car(t, names[0] == "throttle") if "steer" in names else general_manoeuvres(model.system, t)


def _car(t: FloatArray, throttle: bool) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Drive levels are shares of full throttle, or target speeds [m/s]."""
    slow, fast = (0.2, 0.5) if throttle else (0.8, 2.0)
    still = np.zeros_like(t)
    found = {
        "coast down: drive straight at speed, then release the drive": (2.0, still, still),
        "drive straight at a slow steady speed, then at a fast one": (0.0, np.where(t < 3, slow, fast), still),
        "drive straight, in steps up and down": (0.5, np.where(np.sin(4 * t) > 0, fast, slow), still),
        "hold a steady curve, slow and then fast": (0.5, np.where(t < 3, slow, fast), 0.25 + still),
        "hold a curve to the left, then the same to the right": (1.0, fast + still, np.where(t < 3, 0.2, -0.2)),
        "steer in steps, left and right, at speed": (1.5, fast + still, 0.2 * np.sign(np.sin(5 * t))),
        "steer fully to the stops, slowly": (0.5, slow + still, 0.34 * np.clip(t / 3, -1, 1)),
    }
    made = {}
    for text, (speed, drive, steer) in found.items():
        made[text] = (np.array([0.0, 0.0, 0.0, speed]), np.stack([drive, steer], axis=1))
    turned = np.array([0.0, 0.0, np.pi, 1.0])
    made["drive the same straight line in the opposite heading"] = (turned, np.stack([fast + still, still], axis=1))
    return made


def _pendulum(t: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    still = np.zeros_like(t)
    found = {
        "release it from 90 degrees and let it swing out": (np.pi / 2, still),
        "release it from 20 degrees next to hanging and let it swing out": (np.pi - 0.35, still),
        "steps of torque, both ways": (np.pi, 1.0 * np.sign(np.sin(4 * t))),
        "hold a steady torque": (np.pi, 1.0 + still),
        "sweep the torque slowly up and down": (np.pi, 1.5 * np.sin(t)),
    }
    return {text: (np.array([angle, 0.0]), torque[:, None]) for text, (angle, torque) in found.items()}


def general_manoeuvres(system: System, t: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Those of a system of one's own, in the words of its actions: steps, holds and sweeps of each, the others rest.

    An action rests at 0, or at its nearer bound where 0 is none of its values. A state begins in the middle of its
    bounds, at 0 where that lies within them.
    """
    start = np.array([_rest(variable) for variable in system.state])
    found = {}
    for index, action in enumerate(system.action):
        for text, column in _of(action, t):
            actions = np.tile([_rest(other) for other in system.action], (len(t), 1))
            actions[:, index] = column
            found[text] = (start.copy(), actions)
    return found


def _of(action: Variable, t: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    rest, unit = _rest(action), "" if action.unit == "1" else f" {action.unit}"
    reach = action.high - rest if np.isfinite(action.high) else 1.0
    small, large = rest + _SMALL * reach, rest + _LARGE * reach
    name = action.name.replace("_", " ")
    yield f"{name} in steps between {rest:.3g} and {large:.3g}{unit}", np.where(np.sin(4.0 * t) > 0.0, large, rest)
    yield f"hold {name} at {small:.3g}, then at {large:.3g}{unit}", np.where(t < 0.5 * t[-1], small, large)
    yield (
        f"{name} at {large:.3g}{unit} for 2 s, then let it go to {rest:.3g} and wait",
        np.where(t < 2.0, large, rest),
    )
    if action.low < rest:
        low = rest - _LARGE * (rest - action.low if np.isfinite(action.low) else 1.0)
        yield f"sweep {name} slowly between {low:.3g} and {large:.3g}{unit}", rest + (large - rest) * np.sin(t)


def _rest(variable: Variable) -> float:
    if variable.low <= 0.0 <= variable.high:
        return 0.0
    return float(variable.low if variable.low > 0.0 else variable.high)


def choose_experiment(
    models: dict[str, PhysicsModel], noise: FloatArray, report_progress: Callable[[], None] = lambda: None
) -> Experiment | None:
    """Simulates every manoeuvre with every surviving model; None where fewer than two survive or nothing separates.

    Difference of two models: sqrt(mean over time and states of ((x_i - x_j) / noise)^2); ``noise`` (states,).
    """
    names = list(models)
    if len(names) < 2:
        return None
    best: tuple[float, str] = (0.0, "")
    for text, (start, actions) in manoeuvres(models[names[0]]).items():
        runs = [_driven(model, start, actions) for model in models.values()]
        differences = [
            float(np.sqrt(np.mean(((runs[i] - runs[j]) / noise) ** 2))) for i in range(len(runs)) for j in range(i)
        ]
        report_progress()
        smallest = min(differences)
        if np.isfinite(smallest) and smallest > best[0]:
            best = (smallest, text)
    if best[0] < 1.0:
        return _by_hand(names)
    why = f"the predictions of {_joined(names)} differ there by {best[0]:.0f} times the noise"
    return Experiment(best[1], tuple(names), why)


def discriminating_manoeuvres(model: PhysicsModel, others: Sequence[PhysicsModel], noise: FloatArray) -> list[str]:
    """For each other model the manoeuvre in which it differs most from ``model``, in units of the ``noise`` (states,).

    Empty where no manoeuvre shows a difference of the noise.
    """
    every = manoeuvres(model) if others else {}
    own = {text: _driven(model, start, actions) for text, (start, actions) in every.items()}
    found = []
    for other in others:
        best = (0.0, "")
        for text, (start, actions) in every.items():
            with np.errstate(all="ignore"):
                apart = (own[text] - _driven(other, start, actions)) / noise
            size = float(np.sqrt(np.mean(apart**2)))
            if np.isfinite(size) and size > best[0]:
                best = (size, text)
        found.append(best[1] if best[0] >= 1.0 else "")
    return found


def _by_hand(names: Sequence[str]) -> Experiment:
    """No drive separates them: only another kind of measurement can."""
    weighed = {"payload", "towed_load", "torque_gain", "tip_mass"} & set(names)
    manoeuvre = "weigh the robot and its load" if weighed else "measure one of the parameters directly, on a bench"
    return Experiment(manoeuvre, tuple(names), "no manoeuvre of the list makes their predictions differ by the noise")


def _driven(model: PhysicsModel, start: FloatArray, actions: FloatArray) -> FloatArray:
    memory, state, found = model.initial_memory(actions[0]), start, []
    for action in actions:
        state, memory = model.advance(state, action, memory)
        found.append(state)
    return np.array(found)[round(_AFTER / model.period) :]


def _joined(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
