"""The models of the tuning table: as trained, corrected to the right reference point, tuned in each way."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.dynamics.model_file import parse_model, write_model
from safedpa.errors import InputError
from safedpa.networks import Weights, load_weights, save_weights
from safedpa.records import Run
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.experiments.car.methods import named_model
from safedpa_lab.provenance.code import digests
from safedpa_lab.tuning.paper import PaperTuning, tune_as_written
from safedpa_lab.tuning.predictors import AbstractPredictor, NetworkPredictor
from safedpa_lab.tuning.reference_point import ReferencePoint, weights_reported_of_axle
from safedpa_lab.tuning.residual_networks import (
    ResidualTuning,
    learn_residual,
    residual_predictor,
    residual_weights,
    untrained_residual,
)
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.data.recorded_runs import TuningDrive, drives_of, record_circles, split
from safedpa_sim.training.phases.phase_3 import ground_simulator, tune


def key_of(module: str, *settings: Any) -> str:
    """Sixteen digits that change with the settings, and with the training code behind a module."""
    code = {room: digest for room, digest in digests(module).items() if room.startswith(("safedpa_sim", "safedpa."))}
    return hashlib.sha256(json.dumps([code, [str(item) for item in settings]]).encode()).hexdigest()[:16]


@final
class Retained:
    """Results by name below ``folder``; without one nothing is kept. Raises InputError where it cannot be made."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error

    def weights(self, name: str, key: str, make: Callable[[], Weights]) -> Weights:
        """The weights of that name and key, made where there are none."""
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{key}.safetensors"
        if not path.is_file():
            save_weights(make(), path)
        return load_weights(path)

    def text(self, name: str, key: str, make: Callable[[], str]) -> str:
        """Likewise a text."""
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{key}.txt"
        if not path.is_file():
            with atomic_path(path) as unfinished:
                unfinished.write_text(make(), encoding="utf-8")
        return path.read_text(encoding="utf-8")

    def table(self, name: str, key: str, make: Callable[[], Any]) -> Any:
        """Likewise what JSON can say."""
        return json.loads(self.text(name, key, lambda: json.dumps(make())))

    def arrays(self, name: str, key: str, make: Callable[[], tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...]:
        """Likewise arrays."""
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{key}.npz"
        if not path.is_file():
            with atomic_path(path) as unfinished, unfinished.open("wb") as file:
                np.savez(file, *make())
        with np.load(path) as found:
            return tuple(found[part] for part in found.files)


AHEAD: Final = 0.15
"""m from the rear axle to the point that the training simulator tracks."""
ROWS: Final = {
    "untuned": "untuned, as trained",
    "untuned_point": "untuned, right reference point",
    "paper": "L_TUNE as written",
    "paper_point": "L_TUNE, from the right point",
    "shipped": "ours, as shipped",
    "tuned_point": "ours, from the right point",
    "physics": "corrected physics alone, knowing of no load",
    "residual": "residual networks on corrected physics",
    "online_untuned": "untuned at the right point, tuned online",
    "online_shipped": "ours as shipped, tuned online",
    "online_tuned": "ours from the right point, tuned online",
    "online_residual": "residual networks, tuned online",
}
"""Every row of the table by name. The last four are another model for each load."""
REFUSED: Final = "refused"
"""In what weights were trained on: why they stayed as they were."""
_SMALL: Final = {"pairs": 2000, "run_pairs": 500, "cars": 0, "updates": 30, "batch": 64, "rollouts": 4}
_STREAM: Final = 7
ReportProgress = Callable[[str], None]


@final
@dataclass(frozen=True)
class TunedModels:
    """Trains each model on request, or reads it if it was kept."""

    models: Path
    """Folder of ``car_simulated`` and ``car_learned``; those that ship where it has none."""
    retained: Retained
    seed: int = 0
    small: bool = False
    """Trainings of seconds, to see that all runs."""
    report_progress: ReportProgress = lambda _what: None

    def predictor(self, row: str) -> AbstractPredictor:
        """The model of a row that is not tuned online."""
        make: dict[str, Callable[[], AbstractPredictor]] = {
            "untuned": lambda: NetworkPredictor(self.untuned),
            "untuned_point": lambda: NetworkPredictor(self.untuned, ReferencePoint(AHEAD)),
            "at_axle": lambda: NetworkPredictor(self.at_axle),
            "shipped": lambda: NetworkPredictor(_weights("car_learned", self.models)),
            "paper": lambda: NetworkPredictor(self._paper(row, self.untuned)),
            "paper_point": lambda: NetworkPredictor(self._paper(row, self.at_axle)),
            "tuned_point": lambda: NetworkPredictor(self._tuned()),
            "physics": lambda: untrained_residual(self.configuration, self.corrected, self.untuned),
            "residual": lambda: residual_predictor(self.configuration, self.corrected, self._residual()),
        }
        return make[row]()

    def refusal(self, row: str) -> str:
        """Why a tuning was not taken; empty where it was."""
        reported = self._tuned().description.trained_on if row in ("tuned_point", "online_tuned") else {}
        return str(reported.get(REFUSED, ""))

    @cached_property
    def untuned(self) -> Weights:
        """As trained: of the point ``AHEAD`` metres before the axle."""
        return _weights("car_simulated", self.models)

    @cached_property
    def at_axle(self) -> Weights:
        """The same with the rear axle as reference point, where tuning begins."""
        return weights_reported_of_axle(self.untuned, AHEAD)

    @cached_property
    def configuration(self) -> Configuration:
        """Of the training, with the seed."""
        found = replace(load_configuration("car"), seed=self.seed)
        return replace(found, phase_3=replace(found.phase_3, **_SMALL)) if self.small else found

    @cached_property
    def corrected(self) -> PhysicsModel:
        """The training simulator, corrected by a diagnosis of the circles."""

        def make() -> str:
            self.report_progress("diagnosis of the simulator")
            fitted = max(1, round(0.8 * len(self._circles)))
            return write_model(ground_simulator(self.configuration, self._circles[:fitted]).model)

        return parse_model(self.retained.text("corrected", self._key("safedpa_sim.training.phases.phase_3"), make))

    @cached_property
    def _circles(self) -> tuple[Run, ...]:
        phase = self.configuration.phase_3
        return record_circles(phase.pairs, self.seed * 10 + _STREAM, phase.run_pairs)

    def _drives(self) -> list[TuningDrive]:
        return drives_of(self._circles, self.untuned)

    def _paper(self, row: str, begun: Weights) -> Weights:
        tuning = PaperTuning(updates=30, batch=64) if self.small else PaperTuning(seed=self.seed)

        def make() -> Weights:
            self.report_progress(ROWS[row])
            return tune_as_written(begun, split(self._drives(), begun.description.history)[0], tuning)

        return self.retained.weights(row, self._key("safedpa_lab.tuning.paper", begun.digest, tuning), make)

    def _tuned(self) -> Weights:
        def make() -> Weights:
            self.report_progress(ROWS["tuned_point"])
            begun = self.at_axle
            try:
                return tune(self.configuration, begun, self.models)[0]
            except InputError as error:  # no better on what was held out: the row is the model that it began with
                reported = {**begun.description.trained_on, REFUSED: str(error)}
                return begun.with_tensors({}, replace(begun.description, trained_on=reported))

        return self.retained.weights(
            "tuned_point", self._key("safedpa_sim.training.phases.phase_3", self.at_axle.digest), make
        )

    def _residual(self) -> Weights:
        small = ResidualTuning(
            latents=4, hidden=32, cars=20, steps=120, updates=20, batch=64, rollouts=4, seed=self.seed
        )
        tuning = small if self.small else ResidualTuning(seed=self.seed)

        def make() -> Weights:
            self.report_progress(ROWS["residual"])
            found = learn_residual(self.configuration, self.corrected, self.untuned, self._drives(), tuning)
            return residual_weights(found, self.untuned)

        return self.retained.weights(
            "residual", self._key("safedpa_lab.tuning.residual_networks", write_model(self.corrected), tuning), make
        )

    def _key(self, module: str, *settings: object) -> str:
        phase = self.configuration.phase_3
        return key_of(module, self.seed, phase, self.untuned.digest, *settings)


def _weights(name: str, folder: Path) -> Weights:
    """Raises InputError for a model that is not learned."""
    base = named_model(name, folder).base
    if not isinstance(base, LearnedBase) or not base.weights.has("phi"):
        raise InputError(
            f"{name}: got a model without networks or history encoder, wanted what 'safedpa train car' makes"
        )
    return base.weights
