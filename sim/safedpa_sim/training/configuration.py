"""Training configurations: TOML files with the simulator, the randomised ranges and the settings of each phase.

``with_diagnosed`` adds the effects of a diagnosed model to the randomised environment e.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from hashlib import sha256
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, write_model
from safedpa.dynamics.settings import wanted
from safedpa.effects import Parameter, effect
from safedpa.errors import InputError
from safedpa.limits import finite_number, parse_toml, refuse_unknown, text_of_file

_Range = tuple[float, float]
"""Lowest and highest value."""

Section = TypeVar("Section")


def limited(default: float, low: float, high: float = math.inf) -> Any:
    """Declares a numeric setting with its default and its accepted range, both ends included."""
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class Phase1a:
    """Settings of phase 1a, which trains mu, f and g on newly simulated transitions."""

    pairs: int = limited(20_000_000, 1)
    """State-action pairs; each is used once."""
    batch: int = limited(1024, 1)
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    last_learning_rate: float = limited(1e-5, 0.0, 1.0)
    """Final value of the cosine schedule."""
    hidden: int = limited(256, 1, 4096)
    """Neurons in each of the two hidden layers of f and g."""
    encoder_hidden: int = limited(64, 1, 4096)
    """Neurons in mu's hidden layer."""
    checkpoint_seconds: float = limited(30.0, 0.0)


@dataclass(frozen=True)
class Phase1b:
    """Settings of phase 1b, which trains the policy by PPO on driving cars with mu frozen."""

    steps: int = limited(5_000_000, 1)
    """Maximum number of steps, summed over all cars."""
    enough: float = limited(0.985, 0.0)
    """Training ends when this share of the evaluation drives reaches the goal; above 1 it always uses all steps."""
    cars: int = limited(512, 1, 100_000)
    rollout: int = limited(32, 2)
    """Ticks of every car between two updates."""
    batch: int = limited(8192, 2)
    epochs: int = limited(5, 1, 100)
    """PPO epochs over each rollout."""
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    """Initial value; it decreases linearly to 5 % of it."""
    discount: float = limited(0.99, 0.0, 1.0)
    hidden: int = limited(128, 1, 4096)
    """Neurons in each of the two hidden layers."""
    noise: float = limited(0.6, 1e-3, 10.0)
    """Initial standard deviation of the actions, as a share of half their range."""
    evaluate_every: int = limited(12, 1)
    """Updates between two evaluations."""
    evaluation_cars: int = limited(512, 1, 100_000)
    """Drives per evaluation; the final evaluation has four times as many."""


@dataclass(frozen=True)
class Imitation:
    """Settings of imitation learning before phase 1b: the policy learns a teacher's actions in the states it visits."""

    rounds: int = limited(0, 0, 1000)
    """0: no teacher."""
    ticks: int = limited(100, 2)
    """Ticks that each robot drives per round."""
    updates: int = limited(300, 1)
    """Adam steps after each round."""
    batch: int = limited(4096, 1)
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    noise: float = limited(0.25, 0.0, 10.0)
    """Standard deviation of the noise that is added to half of the actions, as a share of half their range."""


@dataclass(frozen=True)
class Phase2:
    """Settings of phase 2, which trains phi on simulated drives in rounds."""

    rounds: int = limited(6, 1, 1000)
    cars: int = limited(1500, 1)
    """Cars per round."""
    steps: int = limited(200, 60)
    """Periods that each car drives; longer than the history, so that full histories occur."""
    updates: int = limited(400, 1)
    """Adam steps per round."""
    batch: int = limited(2048, 1)
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    last_learning_rate: float = limited(1e-5, 0.0, 1.0)
    driven: float = limited(0.5, 0.0, 1.0)
    """Share of the cars that the policy drives; the others drive at random."""
    retained: int = limited(1000, 1)
    """Number of the newest rounds that phi is trained on."""
    change: float = limited(0.005, 0.0, 1.0)
    """Share of the cars whose environment changes in a period: a load is hitched or dropped, the wind turns."""
    noise: float = limited(0.003, 0.0, 1.0)
    """Standard deviation of the noise on the scaled rows; without it phi fits simulator precision no sensor has."""


@dataclass(frozen=True)
class Phase3:
    """Settings of phase 3, which tunes f, g and phi on little real data and on drives in the corrected simulator."""

    pairs: int = limited(20_000, 200)
    """Transitions recorded on circles without load: 0.1 % of the simulated ones."""
    run_pairs: int = limited(1000, 100)
    """Transitions per recorded run."""
    cars: int = limited(2000, 0)
    """Drives in the corrected simulator. With 0 only recorded data is used, and the networks forget loads."""
    steps: int = limited(240, 80)
    """Periods per simulated drive."""
    updates: int = limited(6000, 1)
    """Adam steps."""
    batch: int = limited(1024, 16)
    recorded: float = limited(0.25, 0.0, 1.0)
    """Share of each batch that is recorded data."""
    rollouts: int = limited(64, 0)
    """Short rollouts per batch, in addition to the single steps."""
    rollout_every: int = limited(5, 1)
    """Updates between two updates with rollouts."""
    horizon: int = limited(10, 2, 50)
    """Steps per rollout."""
    learning_rate: float = limited(2e-3, 1e-8, 1.0)
    last_learning_rate: float = limited(1e-5, 0.0, 1.0)
    anchor: float = limited(0.003, 0.0)
    """Weight of |phi - mu(e)|^2 in the corrected simulator; keeps the latent close to what the policy trained on."""


@dataclass(frozen=True)
class PracticeSettings:
    """Settings of the world in which a car's policy trains, and of what it observes; other robots use ``cost`` only."""

    shelter: bool = True
    """Whether the safety filter corrects each action during training, in phases 1b and 2."""
    loads: bool = True
    """Whether scenes are drawn for the footprint with each load; otherwise for the car alone."""
    footprint: bool = True
    """Whether the policy observes the free space around its current footprint, and the footprint's radius; otherwise
    always around the body of the car alone."""
    near: float = limited(0.05, 0.0)
    """Reward lost in a period at contact, decreasing to 0 at a clearance of 0.2 m."""
    contact: float = limited(0.05, 0.0)
    """Reward lost in each period of a contact."""
    cost: float = limited(0.0, 0.0)
    """Cost of a contact when the best policy of a training is selected by return - cost x contacts on development
    drives. With 0 the policy is selected by the share of drives that reach the goal."""
    penalties: tuple[float, ...] = ()
    """Penalty grid of RMA-P: one policy per penalty, the best is selected as above. Empty: ``ablations.penalty``."""

    def __post_init__(self) -> None:
        for value in self.penalties:
            if type(value) not in (int, float) or not 0.0 < value < math.inf:
                raise InputError(f"practice.penalties: got {value!r}, wanted positive numbers")


@dataclass(frozen=True)
class Ablations:
    """Settings of f and g without a latent: Fix, trained with neutral effects, and Mix, in all environments."""

    pairs: int = limited(5_000_000, 1)
    hidden: int = limited(128, 1, 4096)
    penalty: float = limited(10.0, 0.0)
    """Reward that RMA-P's policy loses in training by each contact."""


@dataclass(frozen=True)
class Configuration:
    """Settings of one training: simulator, ranges, networks and a section for each phase.

    Raises InputError naming the key when a setting is unknown, missing or out of its bounds.
    """

    simulator: PhysicsModel
    """The physics model as loaded from its file; ``environment`` lists the randomised parameters."""
    state: Mapping[str, _Range]
    """Ranges of the state entries. Angles cover the full circle; entries that are not listed stay 0."""
    action: Mapping[str, _Range]
    environment: Mapping[str, _Range]
    """Ranges of the randomised parameters, by ``effect.parameter`` or ``base.parameter``."""
    seed: int = limited(0, 0)
    latents: int = limited(4, 1, 64)
    """Entries of z."""
    history: int = limited(52, 36, 1000)
    """Transitions that phi sees. Its two convolutions (kernel 8, stride 4) cover all of them for 36, 52, 68 and so on.
    With 50 they would ignore the newest 14, which show the actuator lag and a load that was just hitched."""
    absent: float = limited(0.2, 0.0, 1.0)
    """Share of the environments in which a given effect is neutral."""
    phase_1a: Phase1a = Phase1a()
    imitation: Imitation = Imitation()
    practice: PracticeSettings = PracticeSettings()
    phase_1b: Phase1b = Phase1b()
    phase_2: Phase2 = Phase2()
    phase_3: Phase3 = Phase3()
    ablations: Ablations = Ablations()

    @property
    def robot(self) -> str:
        """The name of the simulated robot's system."""
        return self.simulator.system.name

    def digest(self, *sections: str) -> str:
        """Returns twelve hexadecimal digits over the settings common to all phases and the named sections.

        The history length counts only if phase 2 is among the sections, imitation only if it has rounds.
        """
        plain = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in _SECTIONS}
        plain["simulator"] = write_model(self.simulator)
        if "phase_2" not in sections:
            del plain["history"]
        chosen = {name: asdict(getattr(self, name)) for name in sections if name in _SECTIONS}
        if not self.imitation.rounds:
            chosen.pop("imitation", None)  # without rounds it has no influence on the result
        if self.practice == PracticeSettings():
            chosen.pop("practice", None)  # results from before this section existed keep their digest
        text = json.dumps({**plain, **chosen}, sort_keys=True)
        return sha256(text.encode()).hexdigest()[:12]

    def as_table(self) -> dict[str, Any]:
        """Returns the configuration as a table with defaults filled in, to be stored with the trained weights."""
        table = {item.name: getattr(self, item.name) for item in fields(self)}
        sections = {name: asdict(table[name]) for name in _SECTIONS}
        ranges = {name: {key: list(pair) for key, pair in table[name].items()} for name in _RANGES}
        return {**table, **ranges, **sections, "simulator": write_model(self.simulator)}


_SECTIONS = {
    name: kind for name, kind in get_type_hints(Configuration).items() if hasattr(kind, "__dataclass_fields__")
}
_RANGES = ("state", "action", "environment")


def configurations() -> dict[str, Path]:
    """Returns the paths of the shipped configurations by name."""
    with as_file(files("safedpa_sim.training") / "configurations") as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml")) if not path.stem.startswith("published")}


def load_configuration(source: str | Path = "car") -> Configuration:
    """Loads a configuration from a file, or a shipped one by name. Raises InputError naming the file and the key."""
    path = Path(source)
    if not path.is_file() and path.parent == Path():
        path = configurations().get(path.stem, path)
    try:
        text = text_of_file(path, "toml_bytes")
        return parse_configuration(text, path.parent)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{source}: cannot be read ({error}); wanted a configuration, or one of {', '.join(configurations())}"
        ) from error
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def parse_configuration(text: str, folder: Path) -> Configuration:
    """Parses a configuration from TOML; the path of the simulator file is relative to ``folder``."""
    table = parse_toml(text)
    refuse_unknown(table, [item.name for item in fields(Configuration)], "")
    if not isinstance(table.get("simulator"), str):
        raise InputError(f"simulator: got {table.get('simulator')!r}, wanted the path of a model file")
    simulator = load_model(folder / table["simulator"])
    system = simulator.system
    ranges = {
        "state": _ranges(table, "state", system.state_names),
        "action": _ranges(table, "action", system.action_names),
        "environment": _environment(simulator, _subtable(table, "environment")),
    }
    for name in system.action_names:
        if name not in ranges["action"]:
            raise InputError(f"action.{name}: missing; give its range as [low, high]")
    sections = {name: _section(kind, name, _subtable(table, name)) for name, kind in _SECTIONS.items()}
    skipped = {"simulator", *ranges, *sections}
    plain = {
        item.name: _value(item.name, table[item.name], item)
        for item in fields(Configuration)
        if item.name in table and item.name not in skipped
    }
    known: dict[str, Any] = {**ranges, **sections, **plain}
    found = Configuration(simulator=simulator, **known)
    if found.robot != "car" and replace(found.practice, cost=0.0) != PracticeSettings():
        raise InputError(f"practice: got settings of a car for robot '{found.robot}', wanted cost alone")
    return found


def _environment(simulator: PhysicsModel, table: Mapping[str, Any]) -> dict[str, _Range]:
    """Returns the ranges by path. Each must be a parameter of the base or of an effect of the robot, in its bounds."""
    found: dict[str, _Range] = {}
    for owner, entries in table.items():
        if not isinstance(entries, dict):
            raise InputError(f"environment.{owner}: got {entries!r}, wanted a table of ranges")
        parameters = {parameter.name: parameter for parameter in _parameters(simulator, owner)}
        refuse_unknown(entries, parameters, f"environment.{owner}.")
        for name, entry in entries.items():
            path, parameter = f"{owner}.{name}", parameters[name]
            low, high = found[path] = _range(f"environment.{path}", entry)
            if not parameter.low <= low <= high <= parameter.high:
                raise InputError(f"environment.{path}: got {low:g} to {high:g}, wanted within {wanted(parameter)}")
    return found


def _parameters(simulator: PhysicsModel, owner: str) -> tuple[Parameter, ...]:
    if owner == "base":
        return simulator.base.parameters
    try:
        return effect(simulator.system.name, owner).parameters
    except InputError as error:
        raise InputError(f"environment.{owner}: {error}") from error


def _ranges(table: Mapping[str, Any], name: str, known: tuple[str, ...]) -> dict[str, _Range]:
    entries = _subtable(table, name)
    refuse_unknown(entries, known, f"{name}.")
    return {key: _range(f"{name}.{key}", entry) for key, entry in entries.items()}


def _range(path: str, entry: Any) -> _Range:
    if isinstance(entry, list) and len(entry) == 2:
        low, high = (finite_number(path, value) for value in entry)
        if low < high:
            return low, high
    raise InputError(f"{path}: got {entry!r}, wanted [low, high] with low < high")


def _section(kind: type[Section], name: str, table: Mapping[str, Any]) -> Section:
    known = {item.name: item for item in fields(kind)}  # type: ignore[arg-type]
    refuse_unknown(table, known, f"{name}.")
    return kind(**{key: _value(f"{name}.{key}", value, known[key]) for key, value in table.items()})


def _value(path: str, value: Any, item: Any) -> Any:
    """A setting as the kind of its default, within its limits."""
    kind = type(item.default)
    if kind is tuple and isinstance(value, list):
        return tuple(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not kind:
        raise InputError(f"{path}: got {value!r}, wanted a value of type {kind.__name__}")
    low, high = item.metadata.get("low", -math.inf), item.metadata.get("high", math.inf)
    if kind in (int, float) and not low <= value <= high:
        raise InputError(f"{path}: got {value:g}, wanted {low:g} to {high:g}")
    return value


def _subtable(table: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    entry = table.get(name, {})
    if not isinstance(entry, dict):
        raise InputError(f"{name}: got {entry!r}, wanted a table [{name}]")
    return entry


_HALF = 0.5
"""Half width of a range over the distance of the value from neutral. Assumed: the day-to-day change of loads, floors
and batteries. The configuration may set another range."""


def with_diagnosed(configuration: Configuration, model: PhysicsModel) -> Configuration:
    """Returns the configuration with ``model`` as its simulator and the effects of the model in the environment.

    The range of a parameter is its value +- half its distance from neutral, clipped to its bounds. Ranges and period of
    the configuration take precedence. A parameter without a neutral value, which only shapes its effect, is fixed at
    its value. Raises InputError for a learned model, or a model of another robot or with other actions.
    """
    simulator, system = configuration.simulator, model.system
    if isinstance(model.base, LearnedBase):
        raise InputError("model: got a learned one, wanted physics: networks are trained on the physics that was found")
    mine, theirs = simulator.system, system
    if (mine.name, mine.state_names, mine.action_names) != (theirs.name, theirs.state_names, theirs.action_names):
        raise InputError(
            f"model: got robot '{theirs.name}' with actions {', '.join(theirs.action_names)}, "
            f"wanted '{mine.name}' with {', '.join(mine.action_names)}, as the configuration has"
        )
    environment = dict(configuration.environment)
    for item in model.effects:
        own = {f"{item.name}.{parameter.name}": parameter for parameter in item.parameters}
        if environment.keys().isdisjoint(own):
            environment |= {
                path: found for path, p in own.items() if (found := _range_about(model, path, p)) is not None
            }
    same_period = PhysicsModel(model.base, model.effects, model.settings, simulator.period)
    return replace(configuration, simulator=same_period, environment=environment)


def _range_about(model: PhysicsModel, path: str, parameter: Parameter) -> _Range | None:
    value, neutral = model.settings[path].value, parameter.neutral
    if neutral is None or value == neutral:
        return None
    half = _HALF * abs(value - neutral)
    low, high = max(value - half, parameter.low), min(value + half, parameter.high)
    return (low, high) if low < high else None
