"""mu, f, g and phi for the point robot's 15 sensor readings (17 inputs with z) instead of its five states.

As in phases 1a and 2: mu, f and g learn from single steps of the simulated body with the goal anywhere in the field,
then phi learns mu(e) from drives. phi does not see the goal entries, because they jump when the goal moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from safedpa.networks import Weights
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.layout import FIELD, GOAL_RADIUS
from safedpa_sim.point.observation import ENTRIES, GROUPS, SENSED_FRAME, sensed, without_goal
from safedpa_sim.point.simulation import LARGEST_TURN, PointSimulation, controls_of, put_state
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.transitions import (
    Transitions,
    TransitionSequence,
    concatenate,
    range_scales,
    transition_sequence,
)
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.export.weights import export_weights, normalise_latent
from safedpa_sim.training.networks.modules import AffineNetworks, AffineSizes, HistoryNetwork, tensors_of, unit_latent
from safedpa_sim.training.networks.prediction_errors import evaluate, explained
from safedpa_sim.training.optimisation import cosine_rate, descend, training_device
from safedpa_sim.training.progress import ReportProgress, silent

Tensor = torch.Tensor

_SAMPLES: Final = 20_000
_STREAMS: Final = {"scales": 71, "training": 72, "held_out": 73, "latents": 74, "drives": 75, "histories": 76}
"""Random stream of each purpose: its seed is seed * 100 + this number."""
_CHUNK: Final = 32
"""Batches simulated per call of the body; amortises the overhead of a call."""
_HELD: Final = 0.04
"""Probability per period that a random driver changes its nominal action."""
_BRAKING: Final = 8.0
"""Gain [1/s] of the speed controller of half of the drivers, from speed error to acceleration; they also stop."""
_SMALLER: Final = 2
"""Divisor of phase 1a's batch size: this task needs more updates."""
_FASTER: Final = 5.0
"""Factor on phase 1a's learning rate: at that one the wind along the heading (z times magnetometer) is learned late."""
_FELT: Final = 0.03
"""Loss weight of the accelerometer: half of its lateral reading is not affine in the action and would dominate."""
_REPORTED: Final = 50


def train_sensed(
    configuration: Configuration,
    given: Weights | None,
    out: Path,
    report_progress: ReportProgress = silent,
    device: str = "cpu",
) -> tuple[Weights, dict[str, Any]]:
    """Trains mu, f, g and phi with the settings ``phase_1a`` and ``phase_2`` of a configuration.

    Minimises the weighted mean of ((change - predicted) / standard deviation of the change)^2 over the 15 entries, then
    the mean of ((phi - mu) / spread)^2 over the latents. Returns the weights and a summary with the explained variance
    of each entry (None for an entry that never changes) and of each latent on new drives.
    """
    del given, out
    training_device(device)
    cars = BatchedSimulator(configuration)
    networks = _networks(cars, configuration)
    _learn_steps(networks, cars, configuration, report_progress)
    normalise_latent(networks, cars, _seed(configuration, "latents"))
    networks.requires_grad_(False)
    encoder, reported = _learn_histories(networks, cars, configuration, report_progress)
    held_out = draw_sensed(cars, _SAMPLES, cars.generator(_seed(configuration, "held_out")))
    summary: dict[str, Any] = {"entries": list(ENTRIES), **evaluate(networks, held_out), **reported}
    moved = held_out.increment.var(0) > 0.0
    summary["explained"] = [
        share if moves else None for share, moves in zip(summary["explained"], moved.tolist(), strict=True)
    ]
    trained_on = {"phase": "17", "pairs": configuration.phase_1a.pairs, "seed": configuration.seed}
    made = export_weights(networks, cars, configuration, {**trained_on, "loss": summary["loss"]}, ENTRIES)
    return made.with_tensors(tensors_of(encoder)), summary


def draw_sensed(cars: BatchedSimulator, count: int, generator: torch.Generator) -> Transitions:
    """Draws single steps in sensor space: environments, readings (n, 15), actions, changes of the readings (n, 15).

    Each step is preceded by one period under another random action, so that accelerometer and gyro have valid readings.
    """
    environment, state = cars.draw_environments(count, generator), cars.draw_states(count, generator)
    before, action, earlier = (cars.draw_actions(count, generator) for _ in range(3))
    positions = (2.0 * FIELD * (torch.rand(2, count, 2, generator=generator) - 0.5)).double().numpy()
    simulation = PointSimulation(count)
    put_state(simulation, state.double().numpy(), earlier[:, 1].double().numpy())
    simulation.force[:] = POINT_BODY.mass * environment.double().numpy().T
    control = controls_of(before.double().numpy())
    simulation.advance(control)
    apart = positions[0] - positions[1]
    apart *= np.maximum(1.0, GOAL_RADIUS / np.linalg.norm(apart, axis=1, keepdims=True))
    goal = simulation.pose[:2].T + apart
    now = sensed(simulation, control, goal)
    control = controls_of(action.double().numpy())
    simulation.advance(control)
    change = sensed(simulation, control, goal) - now
    return Transitions(environment, torch.from_numpy(now).float(), action, torch.from_numpy(change).float())


def _seed(configuration: Configuration, purpose: str) -> int:
    return configuration.seed * 100 + _STREAMS[purpose]


def _networks(cars: BatchedSimulator, configuration: Configuration) -> AffineNetworks:
    """Returns the initial networks; an entry that never changes has scale 1."""
    drawn = draw_sensed(cars, _SAMPLES, cars.generator(_seed(configuration, "scales")))
    low, high = drawn.state.amin(0), drawn.state.amax(0)
    vectors = {
        "feature_middle": 0.5 * (low + high),
        "feature_scale": _or_one(0.5 * (high - low)),
        "increment_scale": _or_one(drawn.increment.std(0)),
        **range_scales(cars),
        **unit_latent(configuration.latents),
    }
    phase, hidden, many = configuration.phase_1a, configuration.phase_1a.hidden, len(ENTRIES)
    sizes = AffineSizes(many, many, 2, len(cars.entries), configuration.latents, hidden, phase.encoder_hidden)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(configuration.seed)
        return AffineNetworks(configuration.robot, sizes, vectors, SENSED_FRAME)


def _or_one(scale: Tensor) -> Tensor:
    return torch.where(scale > 0.0, scale, torch.ones_like(scale))


def _learn_steps(
    networks: AffineNetworks, cars: BatchedSimulator, configuration: Configuration, report_progress: ReportProgress
) -> None:
    phase, pairs = configuration.phase_1a, configuration.phase_1a.pairs
    batch = max(1, phase.batch // _SMALLER)
    weights = torch.ones(len(ENTRIES))
    weights[GROUPS["accelerometer"]] = _FELT
    rate = _FASTER * phase.learning_rate
    steps, generator = math.ceil(pairs / batch), cars.generator(_seed(configuration, "training"))
    optimiser = torch.optim.Adam(networks.parameters(), rate, fused=True)
    for step, (environment, seen, action, change) in enumerate(_batches(cars, batch, steps, generator)):
        predicted = networks(seen, action, networks.encode(environment))
        loss = ((predicted - change / networks.increment_scale).square() * weights).mean()
        loss = descend(optimiser, loss, cosine_rate(rate, phase.last_learning_rate, step / steps))
        if step % _REPORTED == 0:
            report_progress("17", step * batch, pairs, f"loss {float(loss):.2e}")


def _batches(cars: BatchedSimulator, batch: int, steps: int, generator: torch.Generator) -> Iterator[Transitions]:
    for start in range(0, steps, _CHUNK):
        wanted = min(_CHUNK, steps - start)
        drawn = draw_sensed(cars, wanted * batch, generator)
        for index in range(wanted):
            yield Transitions(*(part[index * batch : (index + 1) * batch] for part in drawn))


def _learn_histories(
    networks: AffineNetworks, cars: BatchedSimulator, configuration: Configuration, report_progress: ReportProgress
) -> tuple[HistoryNetwork, dict[str, Any]]:
    """Trains phi and returns it with the share of mu's variance that it explains on new drives with full histories."""
    phase, history = configuration.phase_2, configuration.history
    random = np.random.default_rng(_seed(configuration, "drives"))
    generator = cars.generator(_seed(configuration, "histories"))
    known = concatenate(
        [_drives(networks, cars, configuration, random) for _ in range(min(phase.rounds, phase.retained))]
    )
    spread = known.latents.std(0).clamp_min(1e-3)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(configuration.seed)
        encoder = HistoryNetwork(known.rows.shape[1], history, configuration.latents)
    optimiser = torch.optim.Adam(encoder.parameters(), phase.learning_rate)
    updates = max(1, phase.rounds * phase.updates // 2)
    for update in range(updates):
        rate = cosine_rate(phase.learning_rate, phase.last_learning_rate, update / updates)
        index = known.draw(max(1, phase.batch // 2), generator)
        rows = known.histories(index, history)
        rows = rows + phase.noise * torch.randn(rows.shape, generator=generator) * rows.abs().amax(-1, True).gt(0.0)
        loss = ((encoder(rows) - known.latents[index]) / spread).square().mean()
        loss = descend(optimiser, loss, rate)
        if update % _REPORTED == 0:
            report_progress("17 phi", update, updates, f"loss {float(loss):.3f}")
    fresh = _drives(networks, cars, configuration, random)
    index = fresh.draw(min(_SAMPLES, len(fresh.rows)), generator, before=history)
    with torch.inference_mode():
        seen = encoder(fresh.histories(index, history))
    return encoder, {"explained_latents": explained(seen, fresh.latents[index]).tolist()}


def _drives(
    networks: AffineNetworks, cars: BatchedSimulator, configuration: Configuration, random: np.random.Generator
) -> TransitionSequence:
    """Simulates drives without goals: half under random actions, half under a controller that tracks random speeds."""
    phase = configuration.phase_2
    count, limits = phase.cars, np.array([POINT_BODY.largest_thrust, LARGEST_TURN])
    along, across = ((float(low), float(high)) for low, high in cars.environment_ranges)
    simulation, nowhere = PointSimulation(count), np.ones((count, 2))
    simulation.pose[2] = random.uniform(0.0, 2.0 * np.pi, count)
    nominal, wind = random.uniform(-1.0, 1.0, (count, 2)), np.empty((2, count))
    wind[0], wind[1] = random.uniform(*along, count), random.uniform(*across, count)
    steered, control = np.arange(count) < count // 2, np.zeros((2, count))
    seen, done, winds = [without_goal(sensed(simulation, control, nowhere))], [], []
    for _ in range(phase.steps):
        again = random.random(count) < _HELD
        nominal[again] = random.uniform(-1.0, 1.0, (int(again.sum()), 2)) * random.choice((0.0, 0.3, 1.0), (1, 2))
        turned = random.random(count) < phase.change
        wind[:, turned] = random.uniform(*along, int(turned.sum())), random.uniform(*across, int(turned.sum()))
        simulation.force[:] = POINT_BODY.mass * wind
        action = nominal * limits
        slow = POINT_BODY.mass * _BRAKING * (nominal[:, 0] - seen[-1][:, 3])
        action[steered, 0] = np.clip(slow, -limits[0], limits[0])[steered]
        control = controls_of(action)
        simulation.advance(control)
        seen.append(without_goal(sensed(simulation, control, nowhere)))
        done.append(action)
        winds.append(wind.T.copy())
    states, actions, environments = (torch.from_numpy(np.stack(part, axis=1)).float() for part in (seen, done, winds))
    with torch.inference_mode():
        return TransitionSequence(
            *(part.clone() for part in transition_sequence(networks, states, actions, environments))
        )
