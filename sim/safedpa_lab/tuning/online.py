"""Online tuning on the robot's own drives with its load; an update is refused unless it lowers the held-out error.

The last layers of f and g, and C of the last m rows, are updated by ridge regression. With the features b of transition
t (hidden layers of f, those of g times each scaled action, 1, the rows) and the model's scaled error e, the update is

    W = argmin sum_t |e[t] - W b[t]|^2 + ridge s n |W|^2,   s the mean square of a feature, n the transitions

The ridge is selected by cross-validation: each drive is predicted by the fit to all others, or the last quarter of a
single drive by its first part. If no ridge lowers both the one-step and the twenty-step error, the model is unchanged.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import torch

from safedpa.errors import InputError
from safedpa_lab.tuning.paper import sequence_of
from safedpa_lab.tuning.predictors import AbstractPredictor, PredictorDrives, scaled_errors
from safedpa_sim.training.data.recorded_runs import HORIZON, TuningDrive

Tensor = torch.Tensor
_HELD_OUT: Final = 0.25
"""Share of a single drive, at its end, that is held out."""
_MOST: Final = 300
"""Largest number of starts over which the error on a drive is computed."""


@final
@dataclass(frozen=True)
class OnlineTuning:
    """Settings of online tuning, selected on development drives. Raises InputError for invalid values."""

    ridges: tuple[float, ...] = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
    recent: int = 8
    """Transitions that C uses; 0 for no C."""

    def __post_init__(self) -> None:
        if min(self.ridges, default=0.0) <= 0.0 or self.recent < 0:
            raise InputError(
                f"online tuning: got ridges {self.ridges} and {self.recent} recent transitions, wanted ridges above 0 "
                "and no fewer than 0"
            )


@final
@dataclass(frozen=True)
class TuningResult:
    """The result of a tuning: scaled RMS errors on held-out data after one step and after ``HORIZON`` steps."""

    transitions: int
    before: tuple[float, float]
    after: tuple[float, float] | None
    """None if refused, because no ridge lowered both errors."""
    ridge: float | None

    @property
    def refused(self) -> bool:
        """Whether the model is unchanged."""
        return self.after is None


def tuned_online(
    predictor: AbstractPredictor, drives: Sequence[TuningDrive], scale: Tensor, tuning: OnlineTuning | None = None
) -> tuple[AbstractPredictor, TuningResult]:
    """Returns a tuned copy of the predictor, or an unchanged one if refused, and the result; errors are over ``scale``.

    ``scale`` has shape (states,). Raises InputError when no drive is long enough to be held out.
    """
    tuning = OnlineTuning() if tuning is None else tuning
    parts = [predictor.seen(sequence_of(predictor.networks, [drive])) for drive in _parted(predictor, drives)]
    sums = [_RidgeSums.of(*head_features(predictor, part, tuning.recent)) for part in parts]
    whole = _RidgeSums.total(sums)
    judged = range(len(parts)) if len(drives) > 1 else range(1, 2)  # of a single drive only its end
    before = _mean([_errors(predictor, parts[index], scale) for index in judged])
    best, found = 2.0, None
    for ridge in tuning.ridges:
        after = _mean(
            [_errors(_with(predictor, whole.without(sums[index]), ridge), parts[index], scale) for index in judged]
        )
        shares = [new / old if old > 0.0 else math.inf for new, old in zip(after, before, strict=True)]
        if max(shares) < 1.0 and sum(shares) < best:
            best, found = sum(shares), (ridge, after)
    if found is None:
        return copy.deepcopy(predictor), TuningResult(whole.count, before, None, None)
    return _with(predictor, whole, found[0]), TuningResult(whole.count, before, found[1], found[0])


def head_features(predictor: AbstractPredictor, seen: PredictorDrives, recent: int = 0) -> tuple[Tensor, Tensor]:
    """Returns features b (n, p) of every transition, and the networks' scaled errors (n, states)."""
    sequence, networks = seen.sequence, predictor.networks
    with torch.no_grad():
        index = torch.arange(len(sequence.rows))
        rows = sequence.histories(index, predictor.history)
        latent = predictor.latent(rows)
        features = (networks.frame.features(sequence.states) - networks.feature_middle) / networks.feature_scale
        inputs = torch.cat((features, latent), -1)
        f, g = (_hidden(network, inputs) for network in (networks.f, networks.g))
        u = networks.scaled_action(sequence.actions)
        acting = torch.cat((g, torch.ones_like(g[:, :1])), -1)
        columns = [f, torch.ones_like(f[:, :1]), *(acting * u[:, [index]] for index in range(u.shape[1]))]
        columns.append(rows[:, predictor.history - recent :].flatten(1))
        own = networks.frame.own_increment(sequence.states, sequence.following) - seen.base
        left = (own - predictor.increment(sequence.states, sequence.actions, rows)) / networks.increment_scale
    return torch.cat(columns, -1), left


def add_to_heads(predictor: AbstractPredictor, added: Tensor) -> None:
    """Adds W (p, states), in the order of ``head_features``, to the last layers of f and g and to C."""
    networks = predictor.networks
    f, g = networks.f[-1], networks.g[-1]
    assert isinstance(f, torch.nn.Linear)
    assert isinstance(g, torch.nn.Linear)
    states, actions = networks.sizes.states, networks.sizes.actions
    widths = [f.in_features + 1, *([g.in_features + 1] * actions)]
    own, *acting, recent = torch.split(added, [*widths, len(added) - sum(widths)])
    with torch.no_grad():
        f.weight.add_(own[:-1].T)
        f.bias.add_(own[-1])
        weight, bias = g.weight.view(states, actions, -1), g.bias.view(states, actions)
        for index, part in enumerate(acting):
            weight[:, index] += part[:-1].T
            bias[:, index] += part[-1]
    if len(recent):
        predictor.recent = recent.clone() if predictor.recent is None else predictor.recent + recent


_TABLES: Final = ("products", "wanted")


@final
@dataclass(frozen=True)
class _RidgeSums:
    """Sufficient statistics of a ridge regression; they are additive over sets of transitions."""

    products: Tensor
    """(p, p)"""
    wanted: Tensor
    """(p, states)"""
    count: int

    @staticmethod
    def of(b: Tensor, left: Tensor) -> _RidgeSums:
        b, left = b.double(), left.double()
        return _RidgeSums(b.T @ b, b.T @ left, len(b))

    @staticmethod
    def total(parts: Sequence[_RidgeSums]) -> _RidgeSums:
        products, wanted = (torch.stack([getattr(part, name) for part in parts]).sum(0) for name in _TABLES)
        return _RidgeSums(products, wanted, sum(part.count for part in parts))

    def without(self, part: _RidgeSums) -> _RidgeSums:
        return _RidgeSums(self.products - part.products, self.wanted - part.wanted, self.count - part.count)

    def solved(self, ridge: float) -> Tensor:
        """Returns W (p, states)."""
        size = ridge * self.products.diagonal().mean() * torch.eye(len(self.products), dtype=self.products.dtype)
        solved: Tensor = torch.linalg.solve(self.products + size, self.wanted)
        return solved.float()


def _with(predictor: AbstractPredictor, sums: _RidgeSums, ridge: float) -> AbstractPredictor:
    found = copy.deepcopy(predictor)
    add_to_heads(found, sums.solved(ridge))
    return found


def _errors(predictor: AbstractPredictor, part: PredictorDrives, scale: Tensor) -> tuple[float, float]:
    one, many = scaled_errors(predictor, part, scale, _MOST)
    return float(one), float(many)


def _mean(pairs: Sequence[tuple[float, float]]) -> tuple[float, float]:
    one, many = (sum(column) / len(pairs) for column in zip(*pairs, strict=True))
    return one, many


def _parted(predictor: AbstractPredictor, drives: Sequence[TuningDrive]) -> list[TuningDrive]:
    """Returns the drives that are long enough; a single drive is split into beginning and end."""
    needed = predictor.history + HORIZON
    alone = math.ceil(needed / _HELD_OUT)
    if len(drives) == 1:
        states, actions = drives[0]
        cut = round((1.0 - _HELD_OUT) * len(actions))
        parts = [TuningDrive(states[: cut + 1], actions[:cut]), TuningDrive(states[cut:], actions[cut:])]
    else:
        parts = list(drives)
    retained = [part for part in parts if len(part.actions) > needed]
    if len(retained) < 2:
        longest = max((len(actions) for _, actions in drives), default=0)
        raise InputError(
            f"online tuning: of {len(drives)} drives the longest has {longest} transitions, wanted two of more than "
            f"{needed}, or one of more than {alone}; record longer drives"
        )
    return retained


def _hidden(network: Any, inputs: Tensor) -> Tensor:
    """Returns the output of the hidden layers of a network."""
    for layer in list(network)[:-1]:
        inputs = torch.relu(layer(inputs))
    return inputs
