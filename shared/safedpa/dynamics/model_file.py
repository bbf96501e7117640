"""Reads and writes model files: TOML that users can read and change. Errors name the file and the key.

``fingerprint`` is a short hash of everything that a model's predictions depend on.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import sha256
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from safedpa.dynamics.base import AbstractBase, bases_of, robots_with_bases
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.dynamics.physics import PhysicsModel
from safedpa.dynamics.settings import LATENT_PREFIX, Setting, base_default, wanted
from safedpa.dynamics.user_files import load_user_files
from safedpa.effects.effect import AbstractEffect
from safedpa.effects.law import Varies, Where, conditioned, law_behind, law_of
from safedpa.effects.library import effect
from safedpa.effects.parameter import Parameter
from safedpa.errors import InputError, ModelFileError
from safedpa.limits import finite_number, limit, parse_toml, refuse_unknown, text_of_file_or_shipped, too_much
from safedpa.networks import load_weights, save_weights

FORMAT = 1
"""Version of the file format."""
_TOP = ("format", "robot", "period", "base", "networks", "effects")
_NETWORKS = ("weights", "digest")
_LAWS = (Where.key, Varies.key, "edge")
_PARAMETER_KEYS = ("value", "free", "unit")


def load_model(source: str | Path) -> PhysicsModel:
    """Returns the model in a file, or a shipped one by its name (``car`` or ``car.toml``).

    Raises ModelFileError naming the file and the key.

    Example:

        >>> safedpa.load_model("car").system.state_names
        ('x', 'y', 'yaw', 'speed')
    """
    path, text = text_of_file_or_shipped(source, shipped_models(), "a model file", ModelFileError)
    try:
        return parse_model(text, path.parent)
    except ModelFileError as error:
        raise ModelFileError(f"{source}: {error}") from error


def shipped_models() -> dict[str, Path]:
    """Returns the shipped model files by name, without the ending."""
    # the folder also has column maps, which are not models
    with as_file(files("safedpa.dynamics") / "models") as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml")) if not path.stem.endswith("_columns")}


def parse_model(text: str, folder: Path | None = None) -> PhysicsModel:
    """Returns the model that a TOML text describes; weights are read from ``folder``. See the docs page on model files.

    Raises ModelFileError naming the key.
    """
    # before parsing, because the text may name a robot or an effect that a user's file defines
    load_user_files()
    try:
        table = parse_toml(text)
    except InputError as error:
        raise ModelFileError(str(error)) from error
    refuse_unknown(table, _TOP, "", ModelFileError)
    if table.get("format") != FORMAT:  # before anything else: other formats have other keys
        got = f"got {table['format']!r}" if "format" in table else "missing"
        raise ModelFileError(f"format: {got}, wanted {FORMAT}; this program reads no other")
    robot = table.get("robot")
    base_table = table.get("base")
    if not isinstance(base_table, dict):
        raise ModelFileError("base: missing; wanted a table [base] with the key 'kind'")
    base, period = _base(robot, base_table), _period(table)
    if "networks" in table:
        base = _learned(base, table["networks"], folder or Path(), period)
    settings = _settings(
        "base",
        base.parameters,
        base_table,
        ("kind", *(base.nominal if isinstance(base, LearnedBase) else base).choices),
    )
    effects = []
    for entry in _effect_tables(table):
        item = _effect(base, entry)
        effects.append(item)
        settings.update(_settings(item.name, item.parameters, entry, ("name", *_LAWS)))
    # a document may come from the bus: fits and adaptation take time that grows with the free parameters
    free = sum(setting.free for setting in settings.values())
    if free > limit("model_free"):
        raise ModelFileError(str(too_much("model_free", free)))
    return PhysicsModel(base, effects, settings, period)


def save_model(model: PhysicsModel, path: str | Path) -> None:
    """Writes a model to a TOML file, and a learned model's weights next to it.

    Example:

        >>> safedpa.save_model(safedpa.load_model("friction.toml"), "copy.toml")
        >>> safedpa.load_model("copy.toml").effects
        (ViscousFriction(robot=pendulum, name=viscous_friction, parameters=coefficient),)
    """
    path, name = Path(path), ""
    if isinstance(model.base, LearnedBase):
        name = path.with_suffix(".safetensors").name
        save_weights(model.base.weights, path.with_name(name))
    path.write_text(write_model(model, name), encoding="utf-8")


def write_model(model: PhysicsModel, weights: str = "") -> str:
    """Returns the TOML text that ``parse_model`` reads back to the same model.

    ``weights`` is the name of a learned model's file of weights; by default that of the file they were read from.
    """
    physical = model.base.nominal if isinstance(model.base, LearnedBase) else model.base
    lines = [f"format = {FORMAT}", f'robot = "{model.system.name}"', f"period = {model.period!r}  # s", "", "[base]"]
    lines.append(f'kind = "{physical.kind}"')
    lines += [f'{key} = "{getattr(physical, key)}"' for key in physical.choices]
    lines += _setting_lines(model, "base", model.base.parameters)
    if isinstance(model.base, LearnedBase):
        source = model.base.weights.source
        name = weights or ("" if source is None else source.name)
        lines += ["", "[networks]", f'weights = "{name}"', f'digest = "{model.base.weights.digest}"']
    for item in model.effects:
        lines += ["", "[[effects]]", f'name = "{item.name}"', *_law_lines(item), f"# {item.equation}"]
        lines += _setting_lines(model, item.name, item.parameters)
    return "\n".join(lines) + "\n"


def _law_lines(item: AbstractEffect) -> list[str]:
    law = law_behind(item)
    if law is None:
        return []
    lines = [f'{law.key} = "{law.phrase}"']
    return [*lines, f"edge = {law.edge!r}"] if isinstance(law, Where) else lines


def _setting_lines(model: PhysicsModel, owner: str, parameters: tuple[Parameter, ...]) -> list[str]:
    lines = []
    for parameter in parameters:
        setting = model.settings[f"{owner}.{parameter.name}"]
        if owner == "base" and _is_implied(parameter, setting):
            continue
        # repr gives back the same float: fingerprints and replays depend on every bit
        value = f"{{ value = {setting.value!r}, free = true }}" if setting.free else repr(setting.value)
        lines.append(f"{parameter.name} = {value}  # {parameter.unit}")
    return lines


def _is_implied(parameter: Parameter, setting: Setting) -> bool:
    """Returns whether a file without the key means the same."""
    # so that a new parameter of a base does not change the fingerprints of old models, where it does nothing; a neutral
    # value other than 0, such as the pendulum's gravity, does something and is written
    silent = parameter.neutral == 0.0 or parameter.name.startswith(LATENT_PREFIX)
    return silent and setting == base_default(parameter)


def _base(robot: Any, table: Mapping[str, Any]) -> AbstractBase:
    if robot not in robots_with_bases():
        raise ModelFileError(
            f"robot: got {robot!r}, wanted one of {', '.join(robots_with_bases())}; a robot of your own is loaded with "
            "--effects FILE.py or --robot-file FILE.py"
        )
    kinds = bases_of(robot)
    if table.get("kind") not in kinds:
        wanted_kinds = " or ".join(f"'{kind}'" for kind in kinds)
        raise ModelFileError(f"base.kind: got {table.get('kind')!r}, wanted {wanted_kinds} for robot '{robot}'")
    maker = kinds[table["kind"]]
    choices: Mapping[str, tuple[str, ...]] = getattr(maker, "choices", {})
    for key, allowed in choices.items():
        if table.get(key) not in allowed:
            wanted = " or ".join(f"'{one}'" for one in allowed)
            raise ModelFileError(f"base.{key}: got {table.get(key)!r}, wanted {wanted}")
    return maker(**{key: table[key] for key in choices})


def _learned(nominal: AbstractBase, table: Any, folder: Path, period: float) -> LearnedBase:
    if not isinstance(table, dict) or not isinstance(table.get("weights"), str):
        raise ModelFileError("networks.weights: missing; wanted the name of a safetensors file next to the model file")
    refuse_unknown(table, _NETWORKS, "networks.", ModelFileError)
    try:
        weights = load_weights(folder / table["weights"])
    except InputError as error:
        raise ModelFileError(f"networks.weights: {error}") from error
    if table.get("digest", weights.digest) != weights.digest:
        raise ModelFileError(
            f"networks.digest: got {table['digest']}, the weights in '{table['weights']}' have {weights.digest}; "
            "they were changed after the model was written: choose the weights that it was written with"
        )
    trained = weights.description.period
    # the networks predict the change over one period, and cannot be scaled to another; 1e-9 s allows for decimals
    if abs(trained - period) > 1e-9:
        raise ModelFileError(f"period: got {period:g} s, the networks were trained for {trained:g} s; write that")
    return LearnedBase(nominal, weights)


def _effect_tables(table: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    entries = table.get("effects", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ModelFileError("effects: wanted one table [[effects]] per effect, with the key 'name'")
    if len(entries) > limit("model_effects"):
        raise ModelFileError(str(too_much("model_effects", len(entries))))
    return entries


def _effect(base: AbstractBase, entry: Mapping[str, Any]) -> AbstractEffect:
    name = entry.get("name")
    if not isinstance(name, str):
        got = f"got {name!r}" if "name" in entry else "missing"
        raise ModelFileError(f"effects.name: {got}, wanted the name of an effect; 'safedpa effects' lists them")
    try:
        item = effect(base.system.name, name)
    except InputError as error:
        raise ModelFileError(f"effects.name: {error}") from error
    keys = [key for key in (Where.key, Varies.key) if key in entry]
    if not keys:
        if "edge" in entry:
            raise ModelFileError(f"{name}.edge: got it without 'where', which it belongs to; leave it out")
        return item
    if len(keys) > 1 or (keys[0] == Varies.key and "edge" in entry):
        raise ModelFileError(
            f"{name}: got 'where' and 'varies' or its edge together; wanted one of them, leave one out"
        )
    edge = _number(f"{name}.edge", "", entry["edge"]) if "edge" in entry else None
    return conditioned(item, law_of(keys[0], entry[keys[0]], edge, name), base.system)


def _settings(
    owner: str, parameters: tuple[Parameter, ...], table: Mapping[str, Any], other_keys: tuple[str, ...]
) -> dict[str, Setting]:
    refuse_unknown(table, (*other_keys, *(parameter.name for parameter in parameters)), f"{owner}.", ModelFileError)
    found = {}
    for parameter in parameters:
        path = f"{owner}.{parameter.name}"
        if parameter.name in table:
            found[path] = _setting(path, parameter, table[parameter.name])
        elif owner == "base" and parameter.neutral is not None:
            found[path] = base_default(parameter)
        # a missing parameter of an effect is an error, which the model raises: an effect that silently does nothing, or
        # has a typical size, would be worse
    return found


def _setting(path: str, parameter: Parameter, entry: Any) -> Setting:
    table = entry if isinstance(entry, dict) else {"value": entry}
    refuse_unknown(table, _PARAMETER_KEYS, f"{path}.", ModelFileError)
    unit = table.get("unit", parameter.unit)
    if unit != parameter.unit:  # never converted: a wrong unit is more often a mistake than intended
        raise ModelFileError(f"{path}.unit: got '{unit}', wanted '{parameter.unit}'; convert the value")
    free = table.get("free", False)
    if not isinstance(free, bool):
        raise ModelFileError(f"{path}.free: got {free!r}, wanted true or false")
    if "value" not in table:
        raise ModelFileError(f"{path}.value: missing; give a number, {wanted(parameter)}")
    return Setting(_number(path, parameter.unit, table["value"]), free)


def _period(table: Mapping[str, Any]) -> float:
    period = _number("period", "s", table.get("period", 0.05))
    if not 1e-4 <= period <= 3600.0:
        raise ModelFileError(f"period: got {period:g}, wanted 0.0001 to 3600 s")
    return period


def _number(path: str, unit: str, value: Any) -> float:
    in_unit = "without unit" if unit in ("1", "") else f"in {unit}"
    return finite_number(path, value, f"a finite number {in_unit}", ModelFileError)


def fingerprint(model: PhysicsModel) -> str:
    """Returns twelve hexadecimal digits of the SHA-256 over the model file's keys and values, without comments.

    Learned networks count by the digest of their weights, not by the name of the weights' file.
    """
    # by the text, so that the fingerprint depends on what the model is, not on how it was constructed
    table = parse_toml(write_model(model))
    table.get("networks", {}).pop("weights", None)
    # sorted keys: the order in a file does not matter; the order of effects does, and lists keep theirs
    return sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:12]
