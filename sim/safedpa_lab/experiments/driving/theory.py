"""The theory's bound with measured constants next to what measuring the error itself gives, both on fresh drives.

Robots drive in the training simulator in constant environments e, under actions held for a while; the history encoder
watches. At the end, where the truth is known, each state branches into several actions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase, load_model
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, LearnedNetworks, Weights
from safedpa.safety.margins.conformal import split_conformal_margin
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.theory.measure import Branches, error_constants, lipschitz_constants, measured_errors
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

_ACTIONS = 8
"""From each state: three would tell F* and G*, the others tell what is not affine."""


def theory_experiment(
    weights: Weights, configuration: Configuration, count: int, coverage: float, seed: int
) -> dict[str, Any]:
    """Constants on ``count`` states of the training simulator, and coverage on as many fresh ones.

    ``bound`` is the error of a step at |u|_1 = its number of actions that the constants allow (scaled, sup norm), by
    quantiles at the coverage and by the largest values seen; ``conformal`` the quantile of the error itself.
    ``covered`` are shares of fresh steps, at their own |u|_1. Without a history encoder eps_z is 0. Raises InputError
    for weights without mu, and for too few states.
    """
    networks = LearnedNetworks(weights)
    branches, fresh = (simulated_branches(networks, configuration, count, _ACTIONS, seed + each) for each in (0, 1))
    errors, later = measured_errors(networks, branches), measured_errors(networks, fresh)
    lipschitz = lipschitz_constants(networks, branches)
    at_coverage, largest = (error_constants(errors, lipschitz, share) for share in (coverage, None))
    direct = split_conformal_margin(errors["step"][:, 0], coverage)
    effort = float(len(weights["action_scale"]))
    allowed = at_coverage.of_step(later["effort"])
    return {
        "experiment": "theory",
        "states": count,
        "coverage": coverage,
        "seed": seed,
        "history_encoder": weights.has("phi"),
        "constants": {
            name: {"at_coverage": getattr(at_coverage, name), "largest": getattr(largest, name)}
            for name in ("f", "g", "remainder", "latent")
        },
        "lipschitz": {name: {"bound": pair[0], "largest_slope": pair[1]} for name, pair in lipschitz.items()},
        "bound": {"at_coverage": at_coverage.of_step(effort), "largest": largest.of_step(effort)},
        "conformal": direct,
        "covered": {
            "bound": float((later["step"] <= allowed).mean()),
            "conformal": float((later["step"][:, 0] <= direct).mean()),
        },
        "times_the_conformal": float(at_coverage.of_step(effort) / direct),
        "median_use_of_the_bound": float(np.median(later["step"] / allowed)),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment theory``. Raises InputError for a model without networks."""
    del report_progress
    base = load_model(options["model"]).base
    if not isinstance(base, LearnedBase):
        raise InputError(f"model '{options['model']}': it has no networks, wanted a learned one, such as car_simulated")
    configuration = load_configuration(options["simulator"])
    return theory_experiment(base.weights, configuration, options["states"], options["coverage"], options["seed"])


def report(result: Result) -> str:
    """The constants, the bound that follows, and the conformal margin."""
    lines = [f"{result['states']} states and as many unseen ones, coverage {result['coverage']:g}, scaled:", ""]
    for name, pair in result["constants"].items():
        lines.append(f"- epsilon_{name} {pair['at_coverage']:.4f}, largest seen {pair['largest']:.4f}")
    for name, pair in result["lipschitz"].items():
        lines.append(f"- lipschitz_{name} {pair['bound']:.4f}, largest slope seen {pair['largest_slope']:.4f}")
    for name, value in (("bound", result["bound"]["at_coverage"]), ("conformal", result["conformal"])):
        lines.append(f"- {name} {value:.4f} covers {100 * result['covered'][name]:.2f} % of unseen steps")
    return "\n".join(lines)


_LONGER = 30
"""Transitions beyond a full history, at most: drives end at different times of their held actions."""
_CHANGE = 1.0 / 30.0
"""Probability with which an action changes in a period: every 1.5 s at 20 Hz."""


def simulated_branches(
    networks: LearnedNetworks, configuration: Configuration, count: int, actions: int, seed: int
) -> Branches:
    """``count`` states at the end of drives, each left with ``actions`` drawn ones.

    Weights without a history encoder are given z itself: eps_z is then 0. Raises InputError when the networks know
    another environment than the configuration draws, or have no mu.
    """
    cars = BatchedSimulator(configuration)
    paths = tuple(entry.path for entry in cars.entries)
    known = tuple(entry.path for entry in networks.description.environment)
    if paths != known or not networks.weights.has("mu"):
        raise InputError(f"weights: trained on {known}, the configuration draws {paths}; give the one of the training")
    draw = np.random.default_rng(seed)
    generator = cars.generator(seed)
    environment = cars.draw_environments(count, generator).double().numpy()
    start = cars.draw_states(count, generator).double().numpy()
    ranges = cars.action_ranges.double().numpy()
    history = networks.description.history or configuration.history
    states, acted = _driven(cars.model, start, environment, ranges, history + _LONGER, draw)
    ends = draw.integers(history, states.shape[1], count)
    state, latent = states[np.arange(count), ends], networks.encode(environment)
    action = draw.uniform(ranges[:, 0], ranges[:, 1], (count, actions, len(ranges)))
    following = cars.model.step(
        np.repeat(state, actions, axis=0), action.reshape(-1, len(ranges)), np.repeat(environment, actions, axis=0)
    )
    return Branches(
        state=state,
        latent=latent,
        deployed=_watched(networks, states, acted, ends) if networks.weights.has("phi") else latent,
        action=action,
        following=following.reshape(count, actions, -1),
    )


def _watched(networks: LearnedNetworks, states: FloatArray, actions: FloatArray, ends: NDArray[np.int64]) -> FloatArray:
    """z^ (n, latents) from the full history before each drive's end."""
    encoder = HistoryEncoder(networks.weights)
    rows = encoder.rows(states, actions)
    return encoder.encode(np.stack([row[end - encoder.length : end] for row, end in zip(rows, ends, strict=True)]))


def _driven(
    model: Any, state: FloatArray, environment: FloatArray, ranges: FloatArray, steps: int, draw: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """States (n, steps + 1, states) and actions (n, steps, actions) under actions that are held and then redrawn."""
    low, high = ranges[:, 0], ranges[:, 1]
    action = draw.uniform(low, high, (len(state), len(low)))
    states, actions = [state], []
    memory = model.initial_memory(action, environment)
    for _ in range(steps):
        again = draw.random((len(state), 1)) < _CHANGE
        action = np.where(again, draw.uniform(low, high, action.shape), action)
        state, memory = model.advance(state, action, memory, environment)
        states.append(state)
        actions.append(action)
    return np.stack(states, axis=1), np.stack(actions, axis=1)
