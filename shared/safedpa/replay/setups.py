"""Builds the node of a service from its recorded setup.

Setups are assumed for recordings without them: those of older programs, or shorter than five seconds.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

from safedpa.adaptation import AdaptationNode
from safedpa.bus import AbstractNode, LatentMessage, SetupMessage
from safedpa.bus.messages.service_info import setup_message
from safedpa.dynamics import PhysicsModel, fingerprint, load_model, parse_model, shipped_models
from safedpa.dynamics.model_offer import model_setup
from safedpa.errors import InputError
from safedpa.limits import parse_toml
from safedpa.perception import PerceptionNode, parse_perception
from safedpa.policy import PolicyNode
from safedpa.replay.tape import RobotTape, options_of
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_from_text, margin_text
from safedpa.safety.settings import parse_settings, write_settings

REPLAYED = ("adaptation", "policy", "safety_filter")
"""Replayed services with a model, in the order of the data flow; perception comes before them if there are sensors."""


def node_of(setup: SetupMessage, folders: tuple[Path, ...] = ()) -> AbstractNode:
    """Builds the node for a setup of perception or one of ``REPLAYED``; weights are also searched in ``folders``.

    Raises InputError if the setup is invalid or the weights are not found.
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
    """Parses a model file's text; its weights are searched in ``folders`` and among the shipped ones.

    Raises InputError if the document is invalid or the weights are not found.
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
        f"model: its weights '{name}' were not recorded and are not found ({reasons[0]}); name them with --weights"
    )


def _own_folder(setup: SetupMessage) -> tuple[Path, ...]:
    """Folder of the model file in the options of the service, if it exists on this machine."""
    path = Path(str(options_of(setup).get("model", "")))
    with contextlib.suppress(OSError, ValueError):  # not a valid file name
        return (path.parent,) if path.suffix == ".toml" and path.is_file() else ()
    return ()


def complete_setups(tape: RobotTape, model: str = "", settings: str = "") -> list[str]:
    """Adds a setup for every service that has outputs but none; returns sentences about the assumptions.

    Without ``model``, the shipped model with the fingerprint of the recorded latents is used. Raises InputError if
    there is none. Outputs of a perception without a setup are accepted as recorded, and so are those of a policy if
    the other services have setups: the robot's own policy is no service.
    """
    lacking = [name for name in (PerceptionNode.name, *REPLAYED) if tape.computed[name] and not tape.setups.get(name)]
    accepted = {PerceptionNode.name, *(["policy"] if tape.setups.get("safety_filter") else [])} & {*lacking}
    notes = [f"{name}: no setup was recorded; its outputs are accepted as recorded" for name in sorted(accepted)]
    lacking = [name for name in lacking if name not in accepted]
    if not lacking:
        return notes
    found = load_model(model) if model else _shipped_model(tape)
    tape.setups |= {name: [(0, _assumed_setup(name, found, settings or found.system.name))] for name in lacking}
    which = f"model {fingerprint(found)} of a {found.system.name}, the settings '{settings or found.system.name}'"
    return [
        *notes,
        f"{', '.join(lacking)}: no setup was recorded; assumed {which}, its shipped margin, the default controller",
    ]


def _assumed_setup(service: str, model: PhysicsModel, settings: str) -> SetupMessage:
    setup = model_setup(setup_message(service, {}), model)
    if service != "safety_filter":
        return setup
    margin = margin_for(model)
    text = "" if margin is None else margin_text(margin)
    return replace(setup, settings=write_settings(settings_named(settings)), margin=text)


def _shipped_model(tape: RobotTape) -> PhysicsModel:
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
