"""A base model whose motion is predicted by learned networks; it is used like any other base."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from safedpa.dynamics.base import AbstractBase, Derivative, euler
from safedpa.dynamics.recorded_step import call_function, is_recorded
from safedpa.dynamics.settings import LATENT_PREFIX
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError
from safedpa.networks import LearnedNetworks, Weights
from safedpa.operations import COMPLEX, FLOATS, NUMPY, Operations, Scalar


@final
class LearnedBase(AbstractBase):
    """d(state)/dt = (f(x, z) + g(x, z) a) / period from networks; z are the parameters latent_0, latent_1, ...

    ``nominal`` is the physics that the file names next to the weights. It does not move the robot: named effects refer
    to its parameters, such as a wheelbase. Raises ModelFileError when the weights are for another robot.
    """

    kind = "learned"
    equation = "x' = f(x, z) + g(x, z) a"
    source = "Xiao, He, Dolan, Shi, Safe Deep Policy Adaptation, ICRA 2024"

    def __init__(self, nominal: AbstractBase, weights: Weights) -> None:
        described, system = weights.description, nominal.system
        got = (described.robot, described.states, described.actions)
        wanted = (system.name, system.state_names, system.action_names)
        if got != wanted:
            raise ModelFileError(
                f"networks.weights: trained for robot '{got[0]}' with state {', '.join(got[1])} and action "
                f"{', '.join(got[2])}; the model is a '{wanted[0]}' with {', '.join(wanted[1])} and "
                f"{', '.join(wanted[2])}; choose the weights of this robot"
            )
        self.nominal = nominal
        self.weights = weights
        self.system = system
        self.networks = LearnedNetworks(weights)
        self.parameters = (*nominal.parameters, *_latent_parameters(weights))
        self._latents = tuple(f"{LATENT_PREFIX}{index}" for index in range(described.latents))
        self._last: tuple[tuple[float, ...], tuple[float, ...], list[float]] | None = None
        self._torch: Any = None  # built on first use: services run without torch

    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:  # noqa: D102
        names = self.system.state_names
        entries = [state[name] for name in names]
        # z is read from the parameters, so that it can be a free latent like any other parameter
        latent = [parameters[name] for name in self._latents]
        nominal = [action[name] for name in self.system.action_names]
        if operations is FLOATS or operations is COMPLEX or is_recorded(entries[0]):
            change = self._single(entries, latent, nominal)
        elif operations is NUMPY:
            change = self._batch(entries, latent, nominal)
        else:
            change = self._tensors(entries, latent, nominal)
        # the networks predict the change over a period; as a rate, so that effects can be added to it
        return {name: value / self.weights.description.period for name, value in zip(names, change, strict=True)}

    def integrate(self, derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
        """Returns state + period rates."""
        # one Euler step: the networks predict the change over the whole period, so stages in between mean nothing
        return euler(derivative, state, time, period)

    def _single(self, entries: list[Scalar], latent: list[Scalar], nominal: list[Scalar]) -> list[Scalar]:
        """Returns the change of one robot's state over a period."""
        # one call for f and g: while equations are recorded, the networks become a single line of the recording
        states, actions = len(entries), len(nominal)
        known = call_function(self.known_of_one, (*entries, *latent), states * (1 + actions))
        rows = [known[start : start + actions] for start in range(states, len(known), actions)]
        return [
            start + sum(slope * felt for slope, felt in zip(row, nominal, strict=True))
            for start, row in zip(known[:states], rows, strict=True)
        ]

    def is_latent(self, paths: Sequence[str]) -> bool:
        """Returns whether a model's free parameters are exactly z, in its order."""
        return tuple(paths) == tuple(f"base.{name}" for name in self._latents)

    def known_of_one(self, *known: float) -> list[float]:
        """Returns ``known_at`` for the entries of state and latent in one sequence."""
        states = len(self.system.state)
        return self.known_at(known[:states], known[states:])

    def known_at(self, state: tuple[float, ...], latent: tuple[float, ...]) -> list[float]:
        """Returns f (states,) and g (states, actions) in one list, which callers must not change."""
        # the filter tries many actions at one state, and f and g do not depend on the action
        last = self._last
        if last is None or last[0] != state or last[1] != latent:
            last = self._last = (state, latent, self.networks.row_of_one(state, latent))
        return last[2]

    def _batch(self, entries: list[Scalar], latent: list[Scalar], nominal: list[Scalar]) -> list[Scalar]:
        arrays = np.broadcast_arrays(*entries, *latent, *nominal)
        states, latents = len(entries), len(latent)
        x, z, a = (
            np.stack(part, axis=-1) if part else np.zeros((*arrays[0].shape, 0))
            for part in (arrays[:states], arrays[states : states + latents], arrays[states + latents :])
        )
        f, g = self.networks.increment(x, z)
        change = f + np.einsum("...sa,...a->...s", g, a)
        return [change[..., index] for index in range(states)]

    def _tensors(self, entries: list[Scalar], latent: list[Scalar], nominal: list[Scalar]) -> list[Scalar]:
        from safedpa.networks.tensors import TensorNetworks

        if self._torch is None:
            self._torch = TensorNetworks(self.weights)
        change: list[Scalar] = self._torch.change(entries, latent, nominal)
        return change


def _latent_parameters(weights: Weights) -> tuple[Parameter, ...]:
    """Returns one parameter per entry of z, with the range of the training; neutral is the nominal environment."""
    if not weights.description.latents:
        return ()
    low, high, nominal = (weights[name].tolist() for name in ("latent_low", "latent_high", "latent_nominal"))
    return tuple(
        Parameter(
            f"{LATENT_PREFIX}{index}",
            "1",
            low[index],
            high[index],
            # typical: a quarter of the range, within the bounds that Parameter checks, and never 0
            min(max(0.25 * (high[index] - low[index]), 1e-6), high[index]) if high[index] > 0.0 else high[index],
            # rounding in the weights' file may put it just outside
            neutral=min(max(nominal[index], low[index]), high[index]),
            meaning="learned: what the environment does to the motion",
        )
        for index in range(len(low))
    )
