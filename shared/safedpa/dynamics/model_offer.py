"""Models on the bus: in setup messages, and as offered replacements of the current one, which are checked."""

from __future__ import annotations

from dataclasses import replace

from safedpa.bus import ModelMessage, SetupMessage
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.dynamics.model_file import fingerprint, parse_model, write_model
from safedpa.dynamics.physics import PhysicsModel
from safedpa.errors import ModelFileError
from safedpa.limits import check_plain_model


def offered_model(offer: ModelMessage, current: PhysicsModel) -> PhysicsModel:
    """Returns the model that the offer's document describes.

    Weights are not sent over the bus: a learned model must have the weights of the current one. Raises InputError if
    the document is not plain, is broken, belongs to another system or period, or differs from the offer's fingerprint.
    """
    # before parsing: a hostile document must not reach the parser's costly paths
    check_plain_model(offer.document)
    weights = current.base.weights if isinstance(current.base, LearnedBase) else None
    # the document names a file of weights: it is only read from the folder of the current ones
    folder = None if weights is None or weights.source is None else weights.source.parent
    model = parse_model(offer.document, folder)
    found = fingerprint(model)
    if found != offer.fingerprint:
        raise ModelFileError(f"fingerprint: the document has {found}, the offer says {offer.fingerprint}")
    for name, got, wanted in (
        ("robot", model.system.name, current.system.name),
        ("states", model.system.state_names, current.system.state_names),
        ("actions", model.system.action_names, current.system.action_names),
        ("period", model.period, current.period),
        ("networks.digest", _digest(model), _digest(current)),
    ):
        if got != wanted:
            raise ModelFileError(f"{name}: got {got}, the model in force has {wanted}; offer one of the same robot")
    return model


def _digest(model: PhysicsModel) -> str:
    return model.base.weights.digest if isinstance(model.base, LearnedBase) else "none"


def model_setup(setup: SetupMessage, model: PhysicsModel) -> SetupMessage:
    """Returns ``setup`` with the model's fingerprint and document."""
    return replace(setup, fingerprint=fingerprint(model), document=write_model(model))
