"""The networks of the point robot by name: from a folder, or else those that ship."""

from __future__ import annotations

from pathlib import Path

from safedpa.dynamics import load_model
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.errors import InputError
from safedpa.networks import Weights

__all__ = ["weights_named"]


def weights_named(name: str, folder: Path = Path()) -> Weights:
    """The weights of ``point_<name>`` in the folder, or else of the one that ships. Raises InputError for none."""
    file = folder / f"point_{name}.toml"
    try:
        model = load_model(file if file.exists() else f"point_{name}")
    except InputError as error:
        raise InputError(f"{file}: {error}; train it with 'safedpa train point'") from error
    if not isinstance(model.base, LearnedBase):
        raise InputError(f"point_{name}: got a model without networks, wanted one of 'safedpa train point'")
    return model.base.weights
