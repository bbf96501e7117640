"""What a long experiment has made so far, in a folder: made again only where its settings or its code are others."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.networks import Weights, load_weights, save_weights
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.provenance.code import digests

__all__ = ["Retained", "key_of"]


def key_of(module: str, *settings: Any) -> str:
    """Sixteen digits that change with the settings, and with the code of training that stands behind a module."""
    code = {room: digest for room, digest in digests(module).items() if room.startswith(("safedpa_sim", "safedpa."))}
    return hashlib.sha256(json.dumps([code, [str(item) for item in settings]]).encode()).hexdigest()[:16]


@final
class Retained:
    """Results by name below ``folder``; without one nothing is kept. Raises InputError where it cannot be made."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error

    def weights(self, name: str, key: str, make: Callable[[], Weights]) -> Weights:
        """The weights of that name and key, made where there are none."""
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{key}.safetensors"
        if not path.is_file():
            save_weights(make(), path)
        return load_weights(path)

    def text(self, name: str, key: str, make: Callable[[], str]) -> str:
        """Likewise a text."""
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{key}.txt"
        if not path.is_file():
            with atomic_path(path) as unfinished:
                unfinished.write_text(make(), encoding="utf-8")
        return path.read_text(encoding="utf-8")

    def table(self, name: str, key: str, make: Callable[[], Any]) -> Any:
        """Likewise what JSON can say."""
        return json.loads(self.text(name, key, lambda: json.dumps(make())))

    def arrays(self, name: str, key: str, make: Callable[[], tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...]:
        """Likewise arrays."""
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{key}.npz"
        if not path.is_file():
            with atomic_path(path) as unfinished, unfinished.open("wb") as file:
                np.savez(file, *make())
        with np.load(path) as found:
            return tuple(found[part] for part in found.files)
