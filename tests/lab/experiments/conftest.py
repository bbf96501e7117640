"""Tiny learned models of the car, written by hand: exact in what they say, crude in what they know."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, save_model, shipped_models
from safedpa.networks import Description, Weights
from safedpa.robots.car.observation import observation_length

PERIOD, GAIN, WHEELBASE = 0.05, 5.0, 0.32
MIDDLE, SCALE = np.array([0.7, 0.0]), np.array([1.3, 0.34])
INCREMENTS = np.array([0.05, 0.02, 0.05, 0.2])


def crude_weights(latents: int, gain: float = GAIN, straight_on: bool = True) -> Weights:
    """along = v dt, yaw = v steer dt / wheelbase, speed = gain (target - v) dt - z_0 dt; phi says 0, whatever it sees.

    The policy wants full speed straight on, wherever the goal is.
    """
    inputs = 3 + latents
    pick = np.zeros((4, inputs))
    pick[0, 2], pick[1, 2] = 1.0, -1.0  # relu(v), relu(-v)
    if latents:
        pick[2, 3], pick[3, 3] = 1.0, -1.0  # relu(z_0), relu(-z_0)
    v, z = np.array([1.0, -1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, -1.0])
    f = np.stack([PERIOD * v, 0 * v, 0 * v, -gain * PERIOD * v - PERIOD * z]) / INCREMENTS[:, None]
    g = np.zeros((4, 2, 4))
    g[2, 1] = v * PERIOD * SCALE[1] / WHEELBASE / INCREMENTS[2]
    g_bias = np.zeros((4, 2))
    g_bias[3, 0] = gain * PERIOD * SCALE[0] / INCREMENTS[3]
    f_bias = np.array([0.0, 0.0, 0.0, gain * PERIOD * MIDDLE[0] / INCREMENTS[3]])
    tensors: dict[str, Any] = {}
    for name, last, bias in (("f", f, f_bias), ("g", g.reshape(8, 4), g_bias.ravel())):
        for index, (weight, own) in enumerate(((pick, np.zeros(4)), (np.eye(4), np.zeros(4)), (last, bias))):
            tensors[f"{name}.{index}.weight"], tensors[f"{name}.{index}.bias"] = weight, own
    tensors |= {"feature_middle": np.zeros(3), "feature_scale": np.ones(3)}
    tensors |= {"action_middle": MIDDLE, "action_scale": SCALE, "increment_scale": INCREMENTS}
    if latents:
        tensors |= _encoder(latents) | {"latent_nominal": np.zeros(latents)}
        tensors |= {"latent_low": np.full(latents, -1.0), "latent_high": np.full(latents, 1.0)}
    if latents and straight_on:
        tensors |= _policy(latents)
    description = Description(
        "car", PERIOD, ("x", "y", "yaw", "speed"), ("target_speed", "steer"), latents, 50 if latents else 0
    )
    return Weights({name: np.asarray(value, dtype=np.float32) for name, value in tensors.items()}, description)


def _encoder(latents: int) -> dict[str, Any]:
    shapes = {"phi.dense.0": (2, 9), "phi.dense.1": (2, 2), "phi.conv.0": (2, 2, 8), "phi.conv.1": (2, 2, 8)}
    shapes["phi.out"] = (latents, 2)
    tensors = {f"{name}.weight": np.zeros(shape) for name, shape in shapes.items()}
    return tensors | {f"{name}.bias": np.zeros(shape[0]) for name, shape in shapes.items()}


def _policy(latents: int) -> dict[str, Any]:
    length = observation_length(latents)
    tensors = {"policy.0.weight": np.zeros((2, length)), "policy.0.bias": np.zeros(2)}
    tensors |= {"policy.1.weight": np.zeros((2, 2)), "policy.1.bias": np.array([1.0, 0.0])}
    return tensors | {"observation_middle": np.zeros(length), "observation_scale": np.ones(length)}


def save_crude(folder: Path, name: str, weights: Weights) -> None:
    """The model file ``name``.toml with its weights next to it."""
    nominal = load_model("car")
    settings = {path: setting for path, setting in nominal.settings.items() if path.startswith("base.")}
    save_model(PhysicsModel(LearnedBase(nominal.base, weights), (), settings), folder / f"{name}.toml")


@pytest.fixture(scope="session", autouse=True)
def _no_learned_model_ships():
    """What ships changes with each training: these tests see the physics model alone, and what they make themselves."""
    with pytest.MonkeyPatch.context() as patch:
        physics = {"car": shipped_models()["car"]}
        patch.setattr("safedpa_lab.experiments.car.methods.shipped_models", lambda: physics)
        yield


@pytest.fixture(scope="session")
def learned_folder(tmp_path_factory) -> Path:
    """All learned models that the experiment asks for: ``car_simulated`` takes the servo for a third as quick."""
    folder = tmp_path_factory.mktemp("learned")
    for name in ("car_learned", "car_rma_p"):
        save_crude(folder, name, crude_weights(2))
    save_crude(folder, "car_simulated", crude_weights(2, GAIN / 3))
    for name in ("car_fix", "car_mix"):
        save_crude(folder, name, crude_weights(0))
    return folder
