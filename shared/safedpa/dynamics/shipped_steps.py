"""The steps of the shipped models as C, compiled when a wheel or the environment is built."""

from __future__ import annotations

from typing import Final

from safedpa.dynamics import load_model, shipped_models
from safedpa.dynamics.recorded_step import step_texts
from safedpa.equations.tape import NotRecordableError
from safedpa.native.steps import step_source

__all__ = ["sources"]

_SLOW: Final = 0.05
_QUICKER: Final = (0.01, 0.005)
"""s; a robot whose own model is as slow may also be driven at the shorter periods."""


def sources() -> list[str]:
    """Returns the C of every shipped model without networks, each once."""
    found: dict[str, None] = {}
    for name in shipped_models():
        model = load_model(name)
        quicker = _QUICKER if name == model.system.name and model.period >= _SLOW else ()
        for period in (model.period, *quicker):
            texts = step_texts(
                model.equations(period), (model.system.state_names, model.system.action_names, model.latent_names)
            )
            if texts is None:
                continue
            try:
                found[step_source(*texts)[0]] = None
            except NotRecordableError:  # an operation without C: Python computes it
                continue
    return list(found)
