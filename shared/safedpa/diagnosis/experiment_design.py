"""Chooses the next experiment: the manoeuvre for which the open models differ most, in units of the noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.report_schema import Experiment
from safedpa.dynamics import PhysicsModel
from safedpa.systems import System, Variable
from safedpa.systems.robots import robot_like

# Length of a manoeuvre: long enough to reach a steady state, short enough to be driven in a hall.
_SECONDS = 6.0
# Differences count from here on [s]: the models agree at the start by construction.
_SETTLED = 1.0
# Small and large levels, as shares of an action's range from its rest value: full range may be unsafe to drive.
_SMALL, _LARGE = 0.2, 0.5


def manoeuvres(model: PhysicsModel) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Returns the start (states,) and actions (rows, actions) of each manoeuvre, by its description for the user."""
    t = np.arange(0.0, _SECONDS, model.period)
    # By all states and actions: a user's robot may have one action of a shipped robot, and entirely other states.
    robot = robot_like(model.system)
    return (robot.manoeuvres(t) if robot is not None else {}) or general_manoeuvres(model.system, t)


def general_manoeuvres(system: System, t: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Returns manoeuvres of any other system: steps, holds and sweeps of each action while the others rest.

    Actions rest at 0, or at the nearer bound if 0 is outside their bounds. States start at 0, or inside their bounds.
    """
    start = np.array([_start(variable) for variable in system.state])
    found = {}
    for index, action in enumerate(system.action):
        for text, column in _action_manoeuvres(action, t):
            actions = np.tile([_rest(other) for other in system.action], (len(t), 1))
            actions[:, index] = column
            found[text] = (start.copy(), actions)
    return found


def _action_manoeuvres(action: Variable, t: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    rest, unit = _rest(action), "" if action.unit == "1" else f" {action.unit}"
    span = action.high - rest if np.isfinite(action.high) else 1.0
    small, large = rest + _SMALL * span, rest + _LARGE * span
    name = action.name.replace("_", " ")
    yield f"{name} in steps between {rest:.3g} and {large:.3g}{unit}", np.where(np.sin(4.0 * t) > 0.0, large, rest)
    yield f"hold {name} at {small:.3g}, then at {large:.3g}{unit}", np.where(t < 0.5 * t[-1], small, large)
    yield (
        f"{name} at {large:.3g}{unit} for 2 s, then set it to {rest:.3g} and wait",
        np.where(t < 2.0, large, rest),
    )
    if action.low < rest:
        low = rest - _LARGE * (rest - action.low if np.isfinite(action.low) else 1.0)
        yield f"sweep {name} slowly between {low:.3g} and {large:.3g}{unit}", rest + (large - rest) * np.sin(t)


def _rest(variable: Variable) -> float:
    if variable.low <= 0.0 <= variable.high:
        return 0.0
    return float(variable.low if variable.low > 0.0 else variable.high)


def _start(variable: Variable) -> float:
    rest = _rest(variable)
    if rest == 0.0:
        return 0.0
    # At a bound any motion could leave the range in which the model is valid. Twice an only bound is as far inside.
    span = variable.high - variable.low
    return float(variable.low + 0.5 * span) if np.isfinite(span) else 2.0 * rest


def choose_experiment(
    models: dict[str, PhysicsModel], noise: FloatArray, report_progress: Callable[[], None] = lambda: None
) -> Experiment | None:
    """Simulates every manoeuvre with every model and returns the one that separates them best.

    The difference of two models is sqrt(mean over time and states of ((x_i - x_j) / noise)^2), with ``noise``
    (states,). A manoeuvre counts by its smallest difference, so that it separates all models. Returns None for fewer
    than two models; if no manoeuvre separates them, the experiment is a measurement without driving.
    """
    names = list(models)
    if len(names) < 2:
        return None
    # A difference must exceed the noise (1.0) to be visible in one recording.
    best: tuple[float, str] = (0.0, "")
    for text, (start, actions) in manoeuvres(models[names[0]]).items():
        runs = [_simulate(model, start, actions) for model in models.values()]
        differences = [
            float(np.sqrt(np.mean(((runs[i] - runs[j]) / noise) ** 2))) for i in range(len(runs)) for j in range(i)
        ]
        report_progress()
        # A manoeuvre is worth its weakest pair: it has to separate all models.
        smallest = min(differences)
        if np.isfinite(smallest) and smallest > best[0]:
            best = (smallest, text)
    if best[0] < 1.0:
        return _bench_measurement(names)
    why = f"the predictions of {_joined(names)} differ there by {best[0]:.0f} times the noise"
    return Experiment(best[1], tuple(names), why)


def discriminating_manoeuvres(model: PhysicsModel, others: Sequence[PhysicsModel], noise: FloatArray) -> list[str]:
    """Returns for each other model the manoeuvre that separates it most from ``model``.

    Differences are in units of ``noise`` (states,).

    An entry is empty if no manoeuvre shows a difference as large as the noise.
    """
    every = manoeuvres(model) if others else {}
    reference = {text: _simulate(model, start, actions) for text, (start, actions) in every.items()}
    found = []
    for other in others:
        best = (0.0, "")
        for text, (start, actions) in every.items():
            with np.errstate(all="ignore"):
                difference = (reference[text] - _simulate(other, start, actions)) / noise
            size = float(np.sqrt(np.mean(difference**2)))
            if np.isfinite(size) and size > best[0]:
                best = (size, text)
        found.append(best[1] if best[0] >= 1.0 else "")
    return found


def _bench_measurement(names: Sequence[str]) -> Experiment:
    """Returns a measurement on a bench, for models that no drive separates."""
    # These effects are masses or act like an additional mass, so weighing the robot decides between them.
    weighed = {"payload", "towed_load", "torque_gain", "tip_mass"} & set(names)
    manoeuvre = "weigh the robot and its load" if weighed else "measure one of the parameters directly, on a bench"
    why = "no manoeuvre of the list makes their predictions differ by more than the noise"
    return Experiment(manoeuvre, tuple(names), why)


def _simulate(model: PhysicsModel, start: FloatArray, actions: FloatArray) -> FloatArray:
    # Actuators start settled at the first action, so no transient of theirs counts as a difference.
    memory, state, found = model.initial_memory(actions[0]), start, []
    for action in actions:
        state, memory = model.advance(state, action, memory)
        found.append(state)
    return np.array(found)[round(_SETTLED / model.period) :]


def _joined(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
