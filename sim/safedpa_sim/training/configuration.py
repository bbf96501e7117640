"""What a learned model is trained on, and how: a TOML file that a person can read and change.

Training on a diagnosed model: what was found joins the environment e, about the value that was found.
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

__all__ = [
    "Ablations",
    "Configuration",
    "Imitation",
    "Phase1a",
    "Phase1b",
    "Phase2",
    "Phase3",
    "Practising",
    "configurations",
    "limited",
    "load_configuration",
    "parse_configuration",
    "with_diagnosed",
]

_Range = tuple[float, float]
"""Lowest and highest value."""

Section = TypeVar("Section")


def limited(default: float, low: float, high: float = math.inf) -> Any:
    """A number of a section: its default and the range that is accepted, both ends included."""
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class Phase1a:
    """mu, f and g on transitions of the simulator, every one of them new."""

    pairs: int = limited(20_000_000, 1)
    """State-action pairs, each seen once."""
    batch: int = limited(1024, 1)
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    last_learning_rate: float = limited(1e-5, 0.0, 1.0)
    """The rate falls to it along half a cosine."""
    hidden: int = limited(256, 1, 4096)
    """Neurons in each of the two hidden layers of f and g."""
    encoder_hidden: int = limited(64, 1, 4096)
    """Neurons in mu's hidden layer."""
    checkpoint_seconds: float = limited(30.0, 0.0)


@dataclass(frozen=True)
class Phase1b:
    """The policy, by proximal policy optimisation on driving cars with mu frozen."""

    steps: int = limited(5_000_000, 1)
    """Largest number of steps, all cars together."""
    enough: float = limited(0.985, 0.0)
    """Share of the evaluation drives that reach their goal at which training ends; above 1: never before all steps."""
    cars: int = limited(512, 1, 100_000)
    rollout: int = limited(32, 2)
    """Ticks of every car between two updates."""
    batch: int = limited(8192, 2)
    epochs: int = limited(5, 1, 100)
    """Times that each tick is learned from."""
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    """At the beginning; it falls in a straight line to a twentieth."""
    discount: float = limited(0.99, 0.0, 1.0)
    hidden: int = limited(128, 1, 4096)
    """Neurons in each of the two hidden layers."""
    noise: float = limited(0.6, 1e-3, 10.0)
    """Standard deviation of the actions at the beginning, as a share of half their range."""
    evaluate_every: int = limited(12, 1)
    """Updates between two evaluations."""
    evaluation_cars: int = limited(512, 1, 100_000)
    """Drives of an evaluation; the last one has four times as many."""


@dataclass(frozen=True)
class Imitation:
    """Before phase 1b: what a teacher would do, learned in the states that the policy comes to."""

    rounds: int = limited(0, 0, 1000)
    """0: no teacher."""
    ticks: int = limited(100, 2)
    """That each robot drives in a round."""
    updates: int = limited(300, 1)
    """Steps of Adam after each round."""
    batch: int = limited(4096, 1)
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    noise: float = limited(0.25, 0.0, 10.0)
    """Standard deviation of what is added to half of the actions, as a share of half their range."""


@dataclass(frozen=True)
class Phase2:
    """phi on drives in the simulator, in rounds."""

    rounds: int = limited(6, 1, 1000)
    cars: int = limited(1500, 1)
    """That drive in each round."""
    steps: int = limited(200, 60)
    """Periods that each of them drives; more than the history, so that full ones occur."""
    updates: int = limited(400, 1)
    """Steps of Adam in each round."""
    batch: int = limited(2048, 1)
    learning_rate: float = limited(1e-3, 1e-8, 1.0)
    last_learning_rate: float = limited(1e-5, 0.0, 1.0)
    driven: float = limited(0.5, 0.0, 1.0)
    """Share of them that the policy drives, the others going at random."""
    retained: int = limited(1000, 1)
    """Rounds, the newest ones, that are learned from."""
    change: float = limited(0.005, 0.0, 1.0)
    """Share of the cars whose environment changes in a period: a load is hitched or let go, the wind turns."""
    noise: float = limited(0.003, 0.0, 1.0)
    """Standard deviation of what is added to the scaled rows, so that phi does not rely on the last digit."""


@dataclass(frozen=True)
class Phase3:
    """f, g and phi tuned on few data of the real robot, and on drives in the simulator that these data have corrected."""

    pairs: int = limited(20_000, 200)
    """Transitions recorded on circles without load: 0.1 % of the simulated ones."""
    run_pairs: int = limited(1000, 100)
    """Transitions of each recorded run."""
    cars: int = limited(2000, 0)
    """Drives in the corrected simulator; 0: tuned on the recorded data alone, which forgets loads."""
    steps: int = limited(240, 80)
    """Periods of each of them."""
    updates: int = limited(6000, 1)
    """Steps of Adam."""
    batch: int = limited(1024, 16)
    recorded: float = limited(0.25, 0.0, 1.0)
    """Share of each batch that is recorded data."""
    rollouts: int = limited(64, 0)
    """Short rollouts next to the single steps of a batch."""
    rollout_every: int = limited(5, 1)
    """One update in so many has them."""
    horizon: int = limited(10, 2, 50)
    """Steps of each of them."""
    learning_rate: float = limited(2e-3, 1e-8, 1.0)
    last_learning_rate: float = limited(1e-5, 0.0, 1.0)
    anchor: float = limited(0.003, 0.0)
    """Weight of |phi - mu(e)|^2 in the corrected simulator: the policy goes on seeing the latent that it knows."""


@dataclass(frozen=True)
class Practising:
    """In what world a car's policy practises, and what it is told of it; other robots have ``cost`` alone."""

    shelter: bool = True
    """A stand-in of the filter before each action; without, nowhere: neither in phase 1b nor in phase 2."""
    loads: bool = True
    """Scenes for the footprint with each load; without, for the robot alone."""
    footprint: bool = True
    """The policy sees free space around its footprint, and the radius; without, around its own body, always."""
    near: float = limited(0.05, 0.0)
    """Reward lost in a period at contact, falling to 0 at a clearance of 0.2 m."""
    contact: float = limited(0.05, 0.0)
    """Reward lost in each period of a contact."""
    cost: float = limited(0.0, 0.0)
    """Of a contact, when the best of a training's policies is chosen: return - cost x contacts on development drives;
    0: by the share that reach the goal alone."""
    penalties: tuple[float, ...] = ()
    """Grid of RMA-P: one policy each, the best of them chosen in the same way; empty: ``ablations.penalty`` alone."""

    def __post_init__(self) -> None:
        for value in self.penalties:
            if type(value) not in (int, float) or not 0.0 < value < math.inf:
                raise InputError(f"practice.penalties: got {value!r}, wanted positive numbers")


@dataclass(frozen=True)
class Ablations:
    """f and g that know no environment: Fix, trained where nothing acts, and Mix, trained in all environments."""

    pairs: int = limited(5_000_000, 1)
    hidden: int = limited(128, 1, 4096)
    penalty: float = limited(10.0, 0.0)
    """Reward lost by each contact when RMA-P's policy is trained."""


@dataclass(frozen=True)
class Configuration:
    """A whole training: simulator, ranges, networks, and one section for each phase.

    Raises InputError naming the key when something is unknown, missing or out of its bounds.
    """

    simulator: PhysicsModel
    """The physics, as its file has it; what is randomised stands in ``environment``."""
    state: Mapping[str, _Range]
    """Ranges of the state's entries; angles go all around, entries that are not named stay 0."""
    action: Mapping[str, _Range]
    environment: Mapping[str, _Range]
    """Ranges of what is randomised, by ``effect.parameter`` or ``base.parameter``."""
    seed: int = limited(0, 0)
    latents: int = limited(4, 1, 64)
    """Entries of z."""
    history: int = limited(52, 36, 1000)
    """Transitions that phi sees. Its two convolutions, of kernel 8 and stride 4, see all of them where it is 36, 52, 68
    and so on; with 50 they would miss the newest 14, of which the actuators' lag and a load just hitched are told."""
    absent: float = limited(0.2, 0.0, 1.0)
    """Share of the environments in which a given effect does nothing."""
    phase_1a: Phase1a = Phase1a()
    imitation: Imitation = Imitation()
    practice: Practising = Practising()
    phase_1b: Phase1b = Phase1b()
    phase_2: Phase2 = Phase2()
    phase_3: Phase3 = Phase3()
    ablations: Ablations = Ablations()

    @property
    def robot(self) -> str:
        """The name of the simulated robot's system."""
        return self.simulator.system.name

    def digest(self, *sections: str) -> str:
        """Twelve hexadecimal digits over everything that is common to all phases, and the named sections.

        How far phi looks back counts only where phi is trained, a teacher only where there is one.
        """
        plain = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in _SECTIONS}
        plain["simulator"] = write_model(self.simulator)
        if "phase_2" not in sections:
            del plain["history"]
        chosen = {name: asdict(getattr(self, name)) for name in sections if name in _SECTIONS}
        if not self.imitation.rounds:
            chosen.pop("imitation", None)  # nothing is made from it
        if self.practice == Practising():
            chosen.pop("practice", None)  # what was made before there was a choice is of today
        text = json.dumps({**plain, **chosen}, sort_keys=True)
        return sha256(text.encode()).hexdigest()[:12]

    def as_table(self) -> dict[str, Any]:
        """What the file says, defaults filled in: to be written next to what was trained."""
        table = {item.name: getattr(self, item.name) for item in fields(self)}
        sections = {name: asdict(table[name]) for name in _SECTIONS}
        ranges = {name: {key: list(pair) for key, pair in table[name].items()} for name in _RANGES}
        return {**table, **ranges, **sections, "simulator": write_model(self.simulator)}


_SECTIONS = {
    name: kind for name, kind in get_type_hints(Configuration).items() if hasattr(kind, "__dataclass_fields__")
}
_RANGES = ("state", "action", "environment")


def configurations() -> dict[str, Path]:
    """The configurations that ship with the project, by name."""
    with as_file(files("safedpa_sim.training") / "configurations") as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml")) if not path.stem.startswith("published")}


def load_configuration(source: str | Path = "car") -> Configuration:
    """The configuration in a file, or one that ships, by its name. Raises InputError naming the file and the key."""
    path = Path(source)
    if not path.exists() and path.parent == Path():
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
    """The configuration that a TOML text describes; its simulator's file is sought in ``folder``."""
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
    if found.robot != "car" and replace(found.practice, cost=0.0) != Practising():
        raise InputError(f"practice: got settings of a car for robot '{found.robot}', wanted cost alone")
    return found


def _environment(simulator: PhysicsModel, table: Mapping[str, Any]) -> dict[str, _Range]:
    """The ranges by path; every parameter must be one of the base or of an effect for the robot, within its bounds."""
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
"""Half width of a range over the distance of the value from doing nothing: as much as loads, floors and batteries
change from day to day; the configuration may name another range."""


def with_diagnosed(configuration: Configuration, model: PhysicsModel) -> Configuration:
    """The configuration with ``model`` as its simulator and each of the model's effects in the environment.

    Ranges: value +- half its distance from doing nothing, within the parameter's bounds. Ranges that the configuration
    has stay; so does its period. A parameter without a value at which it does nothing (one that only shapes its
    effect) stays as it was found. Raises InputError for a learned model, or one of another robot or other actions.
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
