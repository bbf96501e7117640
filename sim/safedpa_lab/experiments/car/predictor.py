"""What models predict along recorded drives: one step ahead and open loop, their errors, and the paths of the figure.

A learned model with a history encoder takes z = phi(the last k transitions); over many steps the encoder runs on what
the model itself has predicted, so that z follows the prediction. Of any other model the adaptation's estimate at the
start is held, and what the actuators remember is carried along.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import LATENT, LatentMessage
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.networks import HistoryEncoder, frame_of
from safedpa_lab.experiments.car.drives import Drive


def latents_along(model: PhysicsModel, drive: Drive) -> FloatArray:
    """z[k] (n + 1, latents) as the real adaptation node says it in every tick of a recorded drive."""
    if not model.latent_names:
        return np.zeros((len(drive.messages), 0))
    node = AdaptationNode(model)
    rows = []
    for message in drive.messages:
        latent = node.step("r1", message, {})[LATENT]
        assert isinstance(latent, LatentMessage)
        rows.append(latent.values)
        node.afterwards("r1")
    return np.array(rows)


def predictor_of(model: PhysicsModel, drive: Drive) -> _WithEstimate | _WithHistory:
    """Predictions of a model along a recorded drive of n transitions, in the way that fits the model.

    ``one_step()``: the next states (n, states), from each measured state. ``rollouts(starts, steps)``: open-loop states
    (starts, steps, states) under the actions driven, from the measured states ``starts``.
    """
    base = model.base
    if isinstance(base, LearnedBase) and base.weights.has("phi"):
        return _WithHistory(model, HistoryEncoder(base.weights), drive)
    return _WithEstimate(model, drive)


class _WithEstimate:
    """Latents of the adaptation node (none for a model without), actuators' memory carried along."""

    def __init__(self, model: PhysicsModel, drive: Drive) -> None:
        self._model = model
        self._states, self._actions = drive.states, drive.actions
        self._latents = latents_along(model, drive)
        self._memories: list[Any] = [model.initial_memory(self._actions[0])]
        self._next: list[FloatArray] = []
        for state, action, latent in zip(self._states, self._actions, self._latents, strict=False):
            following, memory = model.advance(state, action, self._memories[-1], latent)
            self._next.append(following)
            self._memories.append(memory)

    def one_step(self) -> FloatArray:
        return np.array(self._next)

    def rollouts(self, starts: Sequence[int], steps: int) -> FloatArray:
        return np.array([self._rollout(start, steps) for start in starts])

    def _rollout(self, start: int, steps: int) -> list[FloatArray]:
        state, memory, rows = self._states[start], self._memories[start], []
        for action in self._actions[start : start + steps]:
            state, memory = self._model.advance(state, action, memory, self._latents[start])
            rows.append(state)
        return rows


class _WithHistory:
    """z from phi at every step, on measured transitions and then on predicted ones; all starts at once."""

    def __init__(self, model: PhysicsModel, encoder: HistoryEncoder, drive: Drive) -> None:
        self._model, self._encoder = model, encoder
        self._states, self._actions = drive.states, drive.actions
        self._rows = encoder.padded(encoder.rows(self._states, self._actions)[:0])  # zeros: before the first transition
        self._rows = np.concatenate([self._rows, encoder.rows(self._states, self._actions)])

    def one_step(self) -> FloatArray:
        starts = range(len(self._actions))
        return self.rollouts(starts, 1)[:, 0]

    def rollouts(self, starts: Sequence[int], steps: int) -> FloatArray:
        encoder = self._encoder
        histories = np.stack([self._rows[start : start + encoder.length] for start in starts])
        states, found = self._states[list(starts)], []
        for step in range(steps):
            actions = self._actions[[start + step for start in starts]]
            memory, latents = self._model.initial_memory(actions), encoder.encode(histories)
            following = np.asarray(self._model.advance(states, actions, memory, latents)[0])
            rows = encoder.rows(np.stack([states, following], axis=1), actions[:, None])
            histories = np.concatenate([histories[:, 1:], rows], axis=1)
            states = following
            found.append(states)
        return np.stack(found, axis=1)


STEPS = 20
"""One second at 20 Hz."""
OWN_STATES = ("along", "across", "yaw", "speed")
"""Errors are in the car's own frame: m, m, rad, m/s."""
_FIRST = 60
"""Tick from which predictions count: the history encoder has seen as much as it ever will."""
_EVERY = 5
"""Ticks from one start of an open-loop prediction to the next."""


def increment_scale(models: Sequence[PhysicsModel], drives: Sequence[Drive]) -> FloatArray:
    """(states,) what errors are divided by: the scale in which the first learned model was trained, else the root mean
    square of the change of state in one step of the drives, in the car's own frame."""
    for model in models:
        if isinstance(model.base, LearnedBase):
            return model.base.weights["increment_scale"].astype(np.float64)
    frame = frame_of("car")
    changes = np.concatenate([frame.own_increment(drive.states[:-1], drive.states[1:]) for drive in drives])
    return np.asarray(np.sqrt(np.mean(changes**2, axis=0)))


def errors_of_model(model: PhysicsModel, drives: Sequence[Drive], scale: FloatArray) -> dict[str, Any]:
    """By load and mixed: errors over one step and one second.

    ``number`` = mean over the states of sqrt(mean over the steps (error / scale)^2), errors in the car's own frame.
    """
    loads = [drive.loads[0] for drive in drives]
    parts = [_errors(model, drive) for drive in drives]
    rows = {}
    for load in (*dict.fromkeys(loads), "mixed"):
        chosen = [part for part, own in zip(parts, loads, strict=True) if load in (own, "mixed")]
        rows[load] = {
            "one_step": _summary(np.concatenate([one for one, _ in chosen]), scale),
            "one_second": _summary(np.concatenate([second for _, second in chosen]), scale),
        }
    return rows


def error_ratios(errors: Mapping[str, Any], worse: str, better: str) -> dict[str, dict[str, float]]:
    """By load and mixed: the number of ``worse`` over that of ``better``, for one step and for one second."""
    return {
        load: {
            horizon: errors[worse][load][horizon]["number"] / errors[better][load][horizon]["number"]
            for horizon in ("one_step", "one_second")
        }
        for load in errors[better]
    }


def _errors(model: PhysicsModel, drive: Drive) -> tuple[FloatArray, FloatArray]:
    """Own-frame errors (steps, states) over one step, and at the end of one second (starts, states)."""
    frame, predictor, states = frame_of("car"), predictor_of(model, drive), drive.states
    one_step = frame.own_increment(states[1:], predictor.one_step())[_FIRST:]
    starts = range(_FIRST, len(states) - STEPS, _EVERY)
    ends = predictor.rollouts(starts, STEPS)[:, -1]
    return one_step, frame.own_increment(states[[start + STEPS for start in starts]], ends)


def _summary(errors: FloatArray, scale: FloatArray) -> dict[str, Any]:
    per_state = np.sqrt(np.mean((errors / scale) ** 2, axis=0))
    physical = np.sqrt(np.mean(errors**2, axis=0))
    return {
        "number": float(per_state.mean()),
        "per_state": dict(zip(OWN_STATES, per_state.tolist(), strict=True)),
        "root_mean_square": dict(zip(OWN_STATES, physical.tolist(), strict=True)),
        "position": float(np.hypot(physical[0], physical[1])),
        "count": len(errors),
    }


FIRST_STEPS = 10
"""Steps of a drive that are known when the prediction starts."""
PREDICTED_STEPS = 50
"""Steps that are predicted: 2.5 s."""


def predicted_paths(models: Mapping[str, PhysicsModel], drives: Sequence[Drive]) -> list[dict[str, Any]]:
    """For each drive: the driven path, and each model's from step 10 on, under the actions that were driven."""
    return [_paths(models, drive) for drive in drives]


def _paths(models: Mapping[str, PhysicsModel], drive: Drive) -> dict[str, Any]:
    steps = min(PREDICTED_STEPS, len(drive.actions) - FIRST_STEPS)
    driven = drive.states[: FIRST_STEPS + steps + 1]
    predicted = {}
    for name, model in models.items():
        path = predictor_of(model, drive).rollouts([FIRST_STEPS], steps)[0]
        miss = np.hypot(*(path[:, :2] - driven[FIRST_STEPS + 1 :, :2]).T)
        predicted[name] = {"path": np.round(path[:, :2], 4).tolist(), "miss_at_end": float(miss[-1])}
    return {"load": drive.loads[0], "driven": np.round(driven[:, :2], 4).tolist(), "predicted": predicted}
