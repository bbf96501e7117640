"""How far affine and free networks are off over one step of their training simulator: the point robot's, the car's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.networks import LearnedNetworks, frame_of, save_weights
from safedpa_lab.point.action_models import COMMANDS
from safedpa_lab.point.free_model import save_free
from safedpa_lab.point.free_training import train_free
from safedpa_lab.point.relinearised_drives import affine_weights, free_model
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.explained_motion import affine_floor
from safedpa_sim.training.phase_1a import train_affine
from safedpa_sim.training.progress import ReportProgress, silent
from safedpa_sim.training.simulator import BatchedCars
from safedpa_sim.training.transitions import draw_transitions

__all__ = ["CarWork", "car_errors", "point_errors", "thrust_configuration", "train_networks"]

_DRAWN: Final = 20_000
_HELD_OUT, _FLOOR = 2401, 2402
"""Seeds of what is counted; training and its own held-out pairs have seeds below 10."""
_CAR_HIDDEN: Final = 128


def thrust_configuration(thrust: str, pairs: int | None = None) -> Configuration:
    """The point's training configuration for commands of that thrust; of so many pairs, where given."""
    plain = load_configuration("point")
    largest = float(COMMANDS[thrust][0])
    phase = plain.phase_1a if pairs is None else replace(plain.phase_1a, pairs=pairs)
    return replace(plain, action={**plain.action, "thrust": (-largest, largest)}, phase_1a=phase)


def train_networks(out: Path, pairs: int | None = None, report_progress: ReportProgress = silent) -> None:
    """Trains ``safedpa_lab.point.relinearised_drives.NETWORKS`` into the folder, with the same pairs for both forms."""
    out.mkdir(parents=True, exist_ok=True)
    for thrust in COMMANDS:
        save_free(
            train_free(thrust_configuration(thrust, pairs), report_progress)[0], out / f"free_{thrust}.safetensors"
        )
    stock, _ = train_affine(thrust_configuration("stock", pairs), out, report_progress)
    save_weights(stock, out / "affine_stock.safetensors")


def point_errors(models: Path) -> list[dict[str, Any]]:
    """For each thrust and form: root mean square error of the velocity [m/s] and yaw [rad] over one step, share of the
    velocity's variance explained, and the share of it that nothing affine in the action explains."""
    rows = []
    for thrust in COMMANDS:
        cars = BatchedCars(thrust_configuration(thrust))
        floor = affine_floor(cars, cars.generator(_FLOOR))[3:].mean()
        drawn = draw_transitions(cars, _DRAWN, cars.generator(_HELD_OUT))
        environment, state, action, own = (part.double().numpy() for part in drawn)
        measured = frame_of("point").world_increment(state, own)
        affine, free = affine_weights(thrust, models), free_model(thrust, models)
        networks = LearnedNetworks(affine)
        f, g = networks.increment(state, networks.encode(environment))
        reported = {
            "affine": (f + np.einsum("nsa,na->ns", g, action), affine.digest[:16], affine.description),
            "free": (free.increment(state, free.encode(environment), action), free.digest, free.description),
        }
        for form, (predicted, digest, described) in reported.items():
            rows.append(
                {
                    "thrust": thrust,
                    "form": form,
                    "digest": digest,
                    "pairs": described.trained_on["pairs"],
                    "seed": described.trained_on["seed"],
                    "velocity": float(np.sqrt(np.square(predicted - measured)[:, 3:].mean())),
                    "yaw": float(np.sqrt(np.square(predicted - measured)[:, 2].mean())),
                    "explained": _explained(predicted[:, 3:], measured[:, 3:]),
                    "not_affine": float(floor),
                }
            )
    return rows


@final
@dataclass(frozen=True)
class CarWork:
    """A configuration of the car's training, and so many pairs of it."""

    pairs: int
    configuration: str = "car"


def car_errors(work: CarWork) -> dict[str, Any]:
    """Affine and free networks trained on the same pairs of the car's training simulator, by state: root mean square
    error (own frame, SI units), share of variance explained, and what nothing affine explains."""
    plain = load_configuration(work.configuration)
    phase = replace(plain.phase_1a, pairs=work.pairs, hidden=min(_CAR_HIDDEN, plain.phase_1a.hidden))
    asked = replace(plain, phase_1a=phase)
    with TemporaryDirectory() as folder:
        _, affine = train_affine(asked, Path(folder))
    _, free = train_free(asked)
    names = ("loss", "explained", "rms_error")
    return {
        "pairs": work.pairs,
        "configuration": work.configuration,
        "seed": asked.seed,
        "hidden": phase.hidden,
        "states": affine["states"],
        "not_affine": affine["not_affine"],
        "affine": {name: affine[name] for name in names},
        "free": {name: free[name] for name in names},
    }


def _explained(predicted: FloatArray, measured: FloatArray) -> float:
    return 1.0 - float(np.square(predicted - measured).mean() / measured.var(axis=0).mean())
