"""Converts arrays to scalars by entry and back: equations work on scalars, callers on arrays."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from safedpa.dynamics.dynamics import Array
from safedpa.operations import FLOATS, NUMPY, Operations, Scalar, operations_for

_FLOAT = np.dtype(np.float64)


def is_torch(array: Any) -> bool:
    """Returns whether ``array`` is a torch tensor, without importing torch."""
    torch = sys.modules.get("torch")  # a tensor exists only where torch has been imported; the import takes seconds
    return torch is not None and isinstance(array, torch.Tensor)


def common_operations(state: Array, *others: Array | None) -> Operations:
    """Returns the operations for arrays that are combined: floats for vectors of NumPy, else those of the state's kind.

    Raises TypeError when a torch tensor is combined with a NumPy state: the kind of the result would be ambiguous.
    """
    if not isinstance(state, np.ndarray):
        return operations_for(state)
    single = state.ndim == 1
    for other in others:
        if isinstance(other, np.ndarray):
            single = single and other.ndim == 1
        elif is_torch(other):
            raise TypeError("got a numpy state with a torch action or latent, wanted one kind; convert the state")
    return FLOATS if single else NUMPY


def columns(array: Array, alongside: Array) -> list[Scalar]:
    """Returns the entries of the last axis of ``array``, as numbers that combine with the state ``alongside``."""
    if isinstance(array, np.ndarray):
        if array.ndim == 1:
            # Python's floats: arithmetic on NumPy's scalars takes several times as long
            return [float(value) for value in array.tolist()]
        if is_torch(alongside):
            array = like(alongside, array)
    return [array[..., index] for index in range(array.shape[-1])]


def joined(entries: list[Scalar], operations: Operations) -> Array:
    """Returns the array (..., entries) of entries, whose leading axes are broadcast."""
    if operations is FLOATS:
        return np.array(entries)
    if operations is NUMPY:
        return np.stack(np.broadcast_arrays(*entries), axis=-1)
    import torch

    return torch.stack(torch.broadcast_tensors(*entries), dim=-1)  # type: ignore[no-untyped-call]


def like(state: Array, values: np.ndarray[Any, Any]) -> Array:
    """Returns ``values`` as an array of the state's kind, precision and device."""
    if isinstance(state, np.ndarray):
        return np.asarray(values, dtype=np.float64)
    import torch

    # a copy: as_tensor shares memory, and a caller may write into its tensor
    return torch.as_tensor(np.array(values), dtype=state.dtype, device=state.device)


def single_robot(state: Array, action: Array, latent: Array | None) -> bool:
    """Returns whether all are NumPy vectors of float64: the fast functions for one robot apply."""
    return _vector(state) and _vector(action) and (latent is None or _vector(latent))


def _vector(part: Array) -> bool:
    # the exact type: a subclass may define other arithmetic, and float32 would round differently
    return type(part) is np.ndarray and part.ndim == 1 and part.dtype == _FLOAT
