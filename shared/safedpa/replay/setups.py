"""From what a service said of itself at its start to the node that runs with it."""

from __future__ import annotations

import contextlib
from pathlib import Path

from safedpa.adaptation import AdaptationNode
from safedpa.bus import AbstractNode, SetupMessage
from safedpa.dynamics import PhysicsModel, parse_model, shipped_models
from safedpa.errors import InputError
from safedpa.limits import parse_toml
from safedpa.policy import PolicyNode
from safedpa.replay.tape import options_of
from safedpa.safety.margin_text import margin_from_text
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.settings import parse_settings

__all__ = ["REPLAYED", "model_of_document", "node_of"]

REPLAYED = ("adaptation", "policy", "safety_filter")
"""Services whose outputs a replay computes, in the order of the data flow."""


def node_of(setup: SetupMessage, folders: tuple[Path, ...] = ()) -> AbstractNode:
    """The node that runs with a setup of one of ``REPLAYED``; weights are sought in ``folders``, too.

    Raises InputError when something in it is broken, or the weights are not to be found.
    """
    model = model_of_document(setup.document, (*folders, *_own_folder(setup)))
    if setup.service == "adaptation":
        return AdaptationNode(model)
    if setup.service == "policy":
        return PolicyNode(model, controller=setup.controller or None)
    if setup.service == "safety_filter":
        margin = margin_from_text(setup.margin) if setup.margin else None
        return SafetyFilterNode(model, parse_settings(setup.settings), margin)
    raise InputError(f"service '{setup.service}': wanted one of {', '.join(REPLAYED)}")


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
