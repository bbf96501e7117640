"""Setups for recordings that do not tell them: of older programs, or begun and ended within five seconds."""

from __future__ import annotations

from dataclasses import replace

from safedpa.bus import LatentMessage, SetupMessage
from safedpa.bus.wire.setup import setup_message
from safedpa.dynamics import PhysicsModel, fingerprint, load_model, shipped_models
from safedpa.dynamics.model_setup import model_setup
from safedpa.errors import InputError
from safedpa.replay.setups import REPLAYED
from safedpa.replay.tape import Tape
from safedpa.safety.margin_text import margin_text
from safedpa.safety.settings import write_settings
from safedpa.safety.shipped import margin_for, settings_named

__all__ = ["complete_setups"]


def complete_setups(tape: Tape, model: str = "", settings: str = "") -> list[str]:
    """Gives every service that has outputs but no setup one; returns what was assumed, in words.

    A model that is not named is the shipped one to which the recorded latents belong, or that of another service's
    setup. Raises InputError when there is none.
    """
    lacking = [name for name in REPLAYED if tape.computed[name] and not tape.setups.get(name)]
    if not lacking:
        return []
    found = load_model(model) if model else _model_of(tape)
    tape.setups |= {name: [(0, _assumed(name, found, settings or found.system.name))] for name in lacking}
    which = f"model {fingerprint(found)} of a {found.system.name}, the settings '{settings or found.system.name}'"
    return [f"{', '.join(lacking)}: no setup was recorded; assumed {which}, its shipped margin, the default controller"]


def _assumed(service: str, model: PhysicsModel, settings: str) -> SetupMessage:
    setup = model_setup(setup_message(service, {}), model)
    if service != "safety_filter":
        return setup
    margin = margin_for(model)
    text = "" if margin is None else margin_text(margin)
    return replace(setup, settings=write_settings(settings_named(settings)), margin=text)


def _model_of(tape: Tape) -> PhysicsModel:
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
