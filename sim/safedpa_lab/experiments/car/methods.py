"""The methods of the car experiment as real nodes, and the families of policies that they belong to.

What the paper's world is stands in the configuration that a model was trained with, and that its weights carry: a model
of another world is refused, so that no figure of the paper's family can rest on one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, final

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT, AbstractNode, Inputs, LatentMessage, Outputs, StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel, fingerprint, load_model, shipped_models
from safedpa.errors import InputError, did_you_mean
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.common.drives import stamp

_FORCE: Final = "constant_force."
_PRACTICE: Final = {"shelter": False, "loads": False, "footprint": False}
"""What the configuration's ``practice`` says of the paper's world."""


@final
@dataclass(frozen=True)
class Family:
    """Which models an experiment drives, and what their filters were calibrated on."""

    name: str
    phrase: str
    """For the page of results."""
    models: Path
    """Folder where ``safedpa train`` leaves them."""
    training: str
    """The command that makes them."""
    methods: tuple[str, ...] = ()
    """Driven when none is named; the usual ones when empty."""
    ships: bool = True
    """Whether models missing in the folder are taken from the shipped ones."""
    loads: tuple[str, ...] = ()
    """With which margins are calibrated; with those of the experiment when empty."""
    barriers: Mapping[str, float] = field(default_factory=dict)
    """Of the filter's settings, what was measured otherwise for this family."""

    def settings(self, source: str) -> FilterSettings:
        """The filter's settings from a file or by name, with the family's own numbers."""
        return settings_named(source).with_barriers(**self.barriers)

    def calibrating(self, loads: tuple[str, ...], drives: int) -> tuple[tuple[str, ...], int]:
        """The loads to calibrate with, and drives of each: as many in all as with each of the experiment's loads."""
        return (self.loads, drives * len(loads) // len(self.loads)) if self.loads else (loads, drives)

    def refuses(self, base: object) -> str:
        """Why a model's base does not belong to the family; empty when it does."""
        if self.ships:
            return ""
        if not isinstance(base, LearnedBase):
            return "is no learned one, and physics knows of loads"
        table: Mapping[str, Any] = base.weights.description.trained_on.get("configuration", {})
        reported = sorted(path for path in table.get("environment", {}) if not path.startswith(_FORCE))
        if not table or reported:
            return f"was trained with {', '.join(reported) or 'no one knows what'} in its environment"
        practice = table.get("practice", {})
        wrong = [key for key, value in _PRACTICE.items() if practice.get(key) is not value]
        if wrong:
            return f"was trained with practice.{wrong[0]} = {str(practice.get(wrong[0], True)).lower()}"
        if base.weights.has("policy") and "observation_body" not in base.weights.tensors:
            return "holds a policy that sees the footprint"
        return ""


FAMILIES: Final = {
    item.name: item
    for item in (
        Family(
            "best",
            "ours at its best: trained with loads, behind a stand-in of the filter",
            Path("learned/car"),
            "safedpa train car",
        ),
        Family(
            "paper",
            "trained in the paper's world: a drag force, no load, no footprint, no stand-in of the filter",
            Path("learned/car_paper"),
            "safedpa train car --configuration car_paper",
            methods=("safedpa", "safedpa_untuned", "rma", "rma_p", "ppo", "fix", "mix"),
            ships=False,
            loads=("none",),
            barriers={"braking_deceleration": 4.5, "braking_gain": 3.3},
        ),
    )
}
"""The braking numbers of the paper's are of the car without load: the page on the robot has the ways that they bound,
by an eighth at least, as the shipped ones bound those with every load."""


def family_named(name: str) -> Family:
    """The family of that name. Raises InputError that lists what exists."""
    if name not in FAMILIES:
        raise InputError(f"family '{name}': {did_you_mean(name, FAMILIES)}")
    return FAMILIES[name]


@dataclass(frozen=True)
class Method:
    """One row of the table. Model names are files ``<name>.toml`` of the learned folder, or models that ship."""

    name: str
    title: str
    model: str
    """Of adaptation and policy."""
    filter_model: str | None
    """None: no filter."""
    controller: str = "learned"
    """As the policy service names it. The goal seeker ignores obstacles; the planner plans around them."""
    adaptive: bool = True
    """Without, the latent stays what it is where nothing acts."""
    usual: bool = True
    """Whether it is driven when no method is named; planners take ten times as long."""
    meaning: str = ""


METHODS: dict[str, Method] = {
    item.name: item
    for item in (
        Method("safedpa", "SafeDPA", "car_learned", "car_learned", meaning="policy, history encoder, filter; tuned"),
        Method(
            "safedpa_untuned",
            "SafeDPA without tuning",
            "car_simulated",
            "car_simulated",
            meaning="the same as trained in the simulator",
        ),
        Method("rma", "RMA", "car_simulated", None, meaning="policy and history encoder, no filter"),
        Method("rma_p", "RMA-P", "car_rma_p", None, meaning="policy trained with a penalty on contact, no filter"),
        Method(
            "ppo",
            "PPO",
            "car_ppo",
            None,
            adaptive=False,
            usual=False,
            meaning="policy without a latent, trained in all environments; no filter",
        ),
        Method("fix", "Fix", "car_learned", "car_fix", meaning="filter with f, g of one fixed environment"),
        Method("mix", "Mix", "car_learned", "car_mix", meaning="filter with f, g of all environments, without z"),
        Method(
            "policy", "Policy alone", "car_simulated", None, adaptive=False, meaning="neither adaptation nor filter"
        ),
        Method("physics", "Physics model", "car", "car", "goal_seeker", meaning="estimator, goal seeker, filter"),
        Method("goal_seeker", "Goal seeker alone", "car", None, "goal_seeker", meaning="the goal seeker, no filter"),
        Method(
            "planner",
            "SafeDPA, planner",
            "car_learned",
            "car_learned",
            "planner",
            usual=False,
            meaning="SafeDPA with the sampling planner in place of the policy",
        ),
        Method(
            "physics_planner",
            "Physics model, planner",
            "car",
            "car",
            "planner",
            usual=False,
            meaning="estimator, sampling planner, filter",
        ),
    )
}
"""Every method by name, in the order of the table."""


def chosen_methods(
    names: tuple[str, ...], folder: Path, family: Family = FAMILIES["best"]
) -> tuple[list[Method], list[str]]:
    """The named methods (the family's without names) whose models exist, and sentences about those left out.

    Raises InputError for a name that does not exist, and for one that was asked for and lacks its model.
    """
    usual = family.methods or tuple(item.name for item in METHODS.values() if item.usual)
    for name in names:
        if name not in METHODS:
            raise InputError(f"method '{name}': {did_you_mean(name, METHODS)}")
    lacks = {name: _lack(METHODS[name], folder, family) for name in names or usual}
    missing = [f"{METHODS[name].title} is left out: {lack}" for name, lack in lacks.items() if lack]
    if names and missing:
        raise InputError(f"{missing[0]}; '{family.training} --out {folder}' makes it")
    return [METHODS[name] for name, lack in lacks.items() if not lack], missing


def drivable_methods(names: tuple[str, ...], folder: Path, family: Family) -> tuple[list[Method], list[str]]:
    """As ``chosen_methods``; raises InputError as well when not one of them can be driven."""
    present, missing = chosen_methods(names, folder, family)
    if not present:
        raise InputError(f"{folder}: none of the methods can be driven; {missing[0]}")
    return present, missing


def _lack(method: Method, folder: Path, family: Family) -> str:
    """What the method needs and lacks; empty if it is complete."""
    files = sorted({method.model, method.filter_model or method.model})
    for name in files:
        if model_path(name, folder, ships=family.ships) is None:
            return f"{name}.toml is {'neither' if family.ships else 'not'} in {folder}" + (
                " nor among the shipped models" if family.ships else ", and none that ships belongs to this family"
            )
        if refused := family.refuses(named_model(name, folder).base):
            return f"{name}.toml in {folder} {refused}"
    base = named_model(method.model, folder).base
    if method.controller == "learned" and not (isinstance(base, LearnedBase) and base.weights.has("policy")):
        return f"{method.model}.toml in {folder} has no policy among its weights"
    if method.adaptive and isinstance(base, LearnedBase) and not base.weights.has("phi"):
        return f"{method.model}.toml in {folder} has no history encoder (phi) among its weights"
    return ""


def model_path(name: str, folder: Path, *, ships: bool = True) -> str | None:
    """The model's file in the folder, else its name if it ships and those that ship will do, else None."""
    path = folder / f"{name}.toml"
    if path.is_file():
        return str(path)
    return name if ships and name in shipped_models() else None


@lru_cache(maxsize=16)
def named_model(name: str, folder: Path) -> PhysicsModel:
    """The model of that name, read once in each process. Raises InputError when there is none."""
    path = model_path(name, folder)
    if path is None:
        raise InputError(f"{name}.toml: not in {folder} nor among the shipped models; 'safedpa train car' makes it")
    return load_model(path)


def nodes_of(
    method: Method, folder: Path, settings: FilterSettings, margin: MarginCalibration | None
) -> list[AbstractNode]:
    """Adaptation, policy and filter of a method, new ones for one episode."""
    model = named_model(method.model, folder)
    adaptation = AdaptationNode(model) if method.adaptive else FixedLatentNode(model)
    policy = PolicyNode(model, controller=method.controller)
    if method.filter_model is None:
        return [adaptation, policy, SafetyFilterNode(model, dataclasses.replace(settings, enabled=False))]
    if method.filter_model == method.model:
        # The thresholds of an implausible state are those of models that predict as well as the shipped one.
        return [adaptation, policy, SafetyFilterNode(model, settings, margin, limits=None)]
    other = named_model(method.filter_model, folder)
    return [adaptation, policy, BlindFilterNode(other, settings, margin)]


@final
class FixedLatentNode(AbstractNode):
    """Replaces the adaptation: always reports the latent of the model file."""

    name = "adaptation"
    inputs = ()
    outputs = (LATENT,)
    share = 0.0

    def __init__(self, model: PhysicsModel) -> None:
        self._fingerprint = fingerprint(model)
        self._values = tuple(model.latent.tolist())

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del robot, inputs
        known, deviations = stamp(state), (0.0,) * len(self._values)
        return {LATENT: LatentMessage(**known, model=self._fingerprint, values=self._values, deviations=deviations)}


@final
class BlindFilterNode(AbstractNode):
    """The real filter with a model without latent: what the adaptation says of another model reaches it empty.

    So the ablations Fix and Mix differ from SafeDPA in the filter's f and g alone. Raises InputError when the model
    has a latent after all.
    """

    name = SafetyFilterNode.name
    inputs = SafetyFilterNode.inputs
    outputs = SafetyFilterNode.outputs
    share = SafetyFilterNode.share

    def __init__(self, model: PhysicsModel, settings: FilterSettings, margin: MarginCalibration | None) -> None:
        if model.latent_names:
            raise InputError(
                f"blind filter: got a model with latent {', '.join(model.latent_names)}, wanted one without; "
                "give it to adaptation and filter alike"
            )
        self._filter = SafetyFilterNode(model, settings, margin, limits=None)
        self._fingerprint = fingerprint(model)

    def prepare(self, robot: str, state: StateMessage) -> None:  # noqa: D102
        self._filter.prepare(robot, state)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        latent = inputs[LATENT]
        if isinstance(latent, LatentMessage):
            empty = dataclasses.replace(latent, model=self._fingerprint, values=(), deviations=())
            inputs = {**inputs, LATENT: empty}
        return self._filter.step(robot, state, inputs)

    def afterwards(self, robot: str) -> Outputs:  # noqa: D102
        return self._filter.afterwards(robot)

    def forget(self, robot: str) -> None:  # noqa: D102
        self._filter.forget(robot)
