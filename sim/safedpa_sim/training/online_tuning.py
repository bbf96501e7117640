"""Tuning on what a robot measures while it drives with its load: no label, no other data, and never a worse model.

1. The last layers of f and g, and C of the last m rows, by ridge regression: with the features b of transition t (the
   hidden layers of f, those of g times each scaled action, 1, the rows), and the scaled error e that the model leaves,

       W = argmin sum_t |e[t] - W b[t]|^2 + ridge n |W|^2

   is added to them. The ridge is the one whose error on the part held out is least.
2. Some steps of Adam on f, g and phi, by one-step errors and by short predictions in open loop.

The last quarter of each drive is held out. A step that does not lower the error there is not taken.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import torch
from torch import nn

from safedpa.errors import InputError
from safedpa_sim.training.paper_tuning import lived_of
from safedpa_sim.training.predictors import AbstractPredictor, Seen, open_loop_errors
from safedpa_sim.training.residual_networks import judged_error
from safedpa_sim.training.tuning_data import HORIZON, Drive

__all__ = ["OnlineTuning", "Taken", "add_to_heads", "head_features", "tuned_online"]

Tensor = torch.Tensor
_HELD_OUT: Final = 0.25
"""Share of each drive, its end, that nothing is fitted to."""
_MOST: Final = 1024
"""Starts over which the held-out error is taken."""


@final
@dataclass(frozen=True)
class OnlineTuning:
    """How it is done; chosen on development drives. Raises InputError for numbers that cannot be."""

    ridges: tuple[float, ...] = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
    """Beside features of size one."""
    recent: int = 8
    """Transitions that C looks back; 0: there is none."""
    updates: int = 0
    """Of Adam; 0: the heads alone."""
    batch: int = 128
    horizon: int = 10
    learning_rate: float = 3e-4
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.ridges, default=0.0) <= 0.0 or self.updates < 0 or self.batch < 1 or self.horizon < 1:
            raise InputError(
                f"online tuning: got ridges {self.ridges}, {self.updates} updates of {self.batch} over {self.horizon} "
                "steps, wanted ridges above 0, no fewer than 0 updates, batch and horizon of 1 at least"
            )


@final
@dataclass(frozen=True)
class Taken:
    """What became of it: held-out errors (``judged_error``) before, with the heads, and after all."""

    transitions: int
    before: float
    heads: float | None
    """None: the heads were not taken."""
    after: float | None
    """None: the steps of Adam were not taken."""

    @property
    def refused(self) -> bool:
        """Whether the model stayed as it was."""
        return self.heads is None and self.after is None


def tuned_online(
    predictor: AbstractPredictor, drives: Sequence[Drive], scale: Tensor, tuning: OnlineTuning | None = None
) -> tuple[AbstractPredictor, Taken]:
    """A tuned copy of the predictor, or one that is as it was, and what was taken; ``scale`` (states,) weighs errors.

    Raises InputError when no drive is long enough for a history and a second in the part that is held out.
    """
    tuning = OnlineTuning() if tuning is None else tuning
    found = copy.deepcopy(predictor)
    fitting, judging = _parted(found, drives)
    before = judged_error(found, [judging], scale, _MOST)
    ridge = _best_heads(found, fitting, judging, scale, tuning, before)
    reached = before if ridge is None else ridge
    steps = _best_steps(found, fitting, judging, scale, tuning, reached) if tuning.updates else None
    return found, Taken(len(fitting.lived.rows), before, ridge, steps)


def head_features(predictor: AbstractPredictor, seen: Seen, recent: int = 0) -> tuple[Tensor, Tensor]:
    """Features b (n, p) of every transition, and the scaled errors (n, states) that the networks leave."""
    lived, networks = seen.lived, predictor.networks
    with torch.no_grad():
        index = torch.arange(len(lived.rows))
        rows = lived.histories(index, predictor.history)
        latent = predictor.latent(rows)
        features = (networks.frame.features(lived.states) - networks.feature_middle) / networks.feature_scale
        inputs = torch.cat((features, latent), -1)
        f, g = (_hidden(network, inputs) for network in (networks.f, networks.g))
        u = networks.scaled_action(lived.actions)
        acting = torch.cat((g, torch.ones_like(g[:, :1])), -1)
        columns = [f, torch.ones_like(f[:, :1]), *(acting * u[:, [index]] for index in range(u.shape[1]))]
        columns.append(rows[:, predictor.history - recent :].flatten(1))
        own = networks.frame.own_increment(lived.states, lived.following) - seen.base
        left = (own - predictor.increment(lived.states, lived.actions, rows)) / networks.increment_scale
    return torch.cat(columns, -1), left


def add_to_heads(predictor: AbstractPredictor, added: Tensor) -> None:
    """Adds W (p, states), in the order of ``head_features``, to the last layers of f and g and to C."""
    networks = predictor.networks
    f, g = networks.f[-1], networks.g[-1]
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


def _best_heads(
    predictor: AbstractPredictor, fitting: Seen, judging: Seen, scale: Tensor, tuning: OnlineTuning, before: float
) -> float | None:
    """The held-out error with the best heads, which the predictor has then; None: it has its own."""
    b, left = (part.double() for part in head_features(predictor, fitting, tuning.recent))
    products, wanted = b.T @ b / len(b), b.T @ left / len(b)
    size = float(products.diagonal().mean())
    own, best, kept = _state(predictor), before, _state(predictor)
    for ridge in tuning.ridges:
        solved = torch.linalg.solve(products + ridge * size * torch.eye(len(products), dtype=torch.float64), wanted)
        add_to_heads(predictor, solved.float())
        judged = judged_error(predictor, [judging], scale, _MOST)
        if judged < best:
            best, kept = judged, _state(predictor)
        _restore(predictor, own)
    _restore(predictor, kept)
    return best if best < before else None


def _best_steps(
    predictor: AbstractPredictor, fitting: Seen, judging: Seen, scale: Tensor, tuning: OnlineTuning, before: float
) -> float | None:
    """The held-out error after the best number of Adam's steps; None: they were not taken."""
    generator = torch.Generator().manual_seed(tuning.seed)
    networks, encoder = predictor.networks, predictor.encoder
    fitted = [*networks.f.parameters(), *networks.g.parameters(), *encoder.parameters()]
    optimiser = torch.optim.Adam(fitted, tuning.learning_rate)
    counts = torch.arange(1, tuning.horizon + 1).reshape(-1, 1, 1)
    best, kept = before, _state(predictor)
    for done in range(tuning.updates):
        for group in optimiser.param_groups:
            group["lr"] = tuning.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / tuning.updates))
        starts = fitting.lived.draw(tuning.batch, generator, before=predictor.history, ahead=tuning.horizon)
        found = open_loop_errors(predictor, fitting, starts, tuning.horizon) / scale
        loss = (found / counts).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(fitted, 1.0)
        optimiser.step()
        if (done + 1) % max(1, tuning.updates // 5) == 0:
            judged = judged_error(predictor, [judging], scale, _MOST)
            if judged < best:
                best, kept = judged, _state(predictor)
    _restore(predictor, kept)
    return best if best < before else None


def _parted(predictor: AbstractPredictor, drives: Sequence[Drive]) -> tuple[Seen, Seen]:
    """The beginnings to fit to, and the ends to judge by."""
    beginnings, ends = [], []
    needed = predictor.history + HORIZON
    for states, actions in drives:
        kept = round((1.0 - _HELD_OUT) * len(actions))
        if len(actions) - kept > needed:
            beginnings.append(Drive(states[: kept + 1], actions[:kept]))
            ends.append(Drive(states[kept:], actions[kept:]))
    if not beginnings:
        longest = max((len(actions) for _, actions in drives), default=0)
        wanted = math.ceil(needed / _HELD_OUT)
        raise InputError(
            f"online tuning: the longest drive has {longest} transitions, wanted more than {wanted}: its last "
            "quarter is held out; drive longer before it is asked for"
        )
    fitting, judging = (predictor.seen(lived_of(predictor.networks, part)) for part in (beginnings, ends))
    return fitting, judging


def _hidden(network: Any, inputs: Tensor) -> Tensor:
    """What the layers of a network before its last one make of the inputs."""
    for layer in list(network)[:-1]:
        inputs = torch.relu(layer(inputs))
    return inputs


def _state(predictor: AbstractPredictor) -> Any:
    return copy.deepcopy((predictor.networks.state_dict(), predictor.encoder.state_dict(), predictor.recent))


def _restore(predictor: AbstractPredictor, state: Any) -> None:
    predictor.networks.load_state_dict(state[0])
    predictor.encoder.load_state_dict(state[1])
    predictor.recent = state[2]
