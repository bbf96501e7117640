"""From what a service said of itself at its start to the node that runs with it.

Setups are made up for recordings that do not tell them: of older programs, or begun and ended within five seconds.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

from safedpa.adaptation import AdaptationNode
from safedpa.bus import AbstractNode, LatentMessage, SetupMessage
from safedpa.bus.messages.service_info import setup_message
from safedpa.dynamics import PhysicsModel, fingerprint, load_model, parse_model, shipped_models
from safedpa.dynamics.model_setup import model_setup
from safedpa.errors import InputError
from safedpa.limits import parse_toml
from safedpa.perception import PerceptionNode, parse_perception
from safedpa.policy import PolicyNode
from safedpa.replay.tape import RobotTape, options_of
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_from_text, margin_text
from safedpa.safety.settings import parse_settings, write_settings

__all__ = ["REPLAYED", "complete_setups", "model_of_document", "node_of"]

REPLAYED = ("adaptation", "policy", "safety_filter")
"""Services that know a model and whose outputs a replay computes, in the order of the data flow; before them, where a
robot has sensors, perception."""


def node_of(setup: SetupMessage, folders: tuple[Path, ...] = ()) -> AbstractNode:
    """The node that runs with a setup of one of ``REPLAYED`` or of perception; weights are sought in ``folders``, too.

    Raises InputError when something in it is broken, or the weights are not to be found.
    """
    if setup.service == PerceptionNode.name:
        return PerceptionNode(parse_perception(setup.settings))
    model = model_of_document(setup.document, (*folders, *_own_folder(setup)))
    if setup.service == "adaptation":
        return AdaptationNode(model)
    if setup.service == "policy":
        return PolicyNode(model, controller=setup.controller or None)
    if setup.service == "safety_filter":
        margin = margin_from_text(setup.margin) if setup.margin else None
        return SafetyFilterNode(model, parse_settings(setup.settings), margin)
    raise InputError(f"service '{setup.service}': wanted one of {', '.join(REPLAYED)} or {PerceptionNode.name}")


def model_of_document(document: str, folders: tuple[Path, ...] = ()) -> PhysicsModel:
    """The model that a document describes; weights are sought in ``folders`` and among those that ship.

    Raises InputError when the document is broken or the weights are nowhere.
    """
    try:
        name = parse_toml(document).get("networks", {}).get("weights")
    except (InputError, AttributeError) as error:
        raise InputError(f"model: {error}; wanted the text of a model file") from error
    if name is None:
        return parse_model(document)
    shipped = tuple(dict.fromkeys(path.parent for path in shipped_models().values()))
    reasons = []
    for folder in (*folders, *shipped):
        try:
            return parse_model(document, folder)
        except InputError as error:
            reasons.append(str(error))
    raise InputError(
        f"model: its weights '{name}' were not recorded and are not found ({reasons[0]}); name their --weights"
    )


def _own_folder(setup: SetupMessage) -> tuple[Path, ...]:
    """Where the model file of the service's options lies, if that is on this machine."""
    path = Path(str(options_of(setup).get("model", "")))
    with contextlib.suppress(OSError, ValueError):  # a name that no file can have
        return (path.parent,) if path.suffix == ".toml" and path.is_file() else ()
    return ()


def complete_setups(tape: RobotTape, model: str = "", settings: str = "") -> list[str]:
    """Gives every service that has outputs but no setup one; returns what was assumed, in words.

    A model that is not named is the shipped one to which the recorded latents belong, or that of another service's
    setup. Raises InputError when there is none.
    """
    sees = PerceptionNode.name
    believed = tape.computed[sees] and not tape.setups.get(sees)
    reported = [f"{sees}: no setup was recorded; what it made of the scans is believed"] if believed else []
    lacking = [name for name in REPLAYED if tape.computed[name] and not tape.setups.get(name)]
    if not lacking:
        return reported
    found = load_model(model) if model else _model_of(tape)
    tape.setups |= {name: [(0, _assumed(name, found, settings or found.system.name))] for name in lacking}
    which = f"model {fingerprint(found)} of a {found.system.name}, the settings '{settings or found.system.name}'"
    return [
        *reported,
        f"{', '.join(lacking)}: no setup was recorded; assumed {which}, its shipped margin, the default controller",
    ]


def _assumed(service: str, model: PhysicsModel, settings: str) -> SetupMessage:
    setup = model_setup(setup_message(service, {}), model)
    if service != "safety_filter":
        return setup
    margin = margin_for(model)
    text = "" if margin is None else margin_text(margin)
    return replace(setup, settings=write_settings(settings_named(settings)), margin=text)


def _model_of(tape: RobotTape) -> PhysicsModel:
    latents = [entry.message for entry in tape.computed["adaptation"]]
    wanted = latents[0].model if latents and isinstance(latents[0], LatentMessage) else ""
    for path in shipped_models().values():
        model = load_model(path)
        if fingerprint(model) == wanted:
            return model
    raise InputError(
        f"{tape.files[0]}: the setup of its services was not recorded, and no shipped model has the fingerprint "
        f"'{wanted}'; name the model with --recorded-model"
    )
