"""Arrays to named scalars and back: equations see names, callers see arrays."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from safedpa.dynamics.dynamics import Array
from safedpa.operations import FLOATS, NUMPY, Operations, Scalar, operations_for

__all__ = ["columns", "common_operations", "is_torch", "joined", "like", "single_robot"]

_FLOAT = np.dtype(np.float64)


def is_torch(array: Any) -> bool:
    """Whether it is a torch tensor; torch is not imported to find out."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(array, torch.Tensor)


def common_operations(state: Array, *others: Array | None) -> Operations:
    """The table for numbers that meet: floats for numpy arrays without leading axes, else that of the state.

    Raises TypeError when a torch tensor meets a numpy state: there is no telling which kind should come out.
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
    """The entries of the last axis of ``array``, as numbers that fit a state ``alongside`` it."""
    if isinstance(array, np.ndarray):
        if array.ndim == 1:
            return [float(value) for value in array.tolist()]
        if is_torch(alongside):
            array = like(alongside, array)
    return [array[..., index] for index in range(array.shape[-1])]


def joined(entries: list[Scalar], operations: Operations) -> Array:
    """The array (..., entries) of numbers that may have different leading axes."""
    if operations is FLOATS:
        return np.array(entries)
    if operations is NUMPY:
        return np.stack(np.broadcast_arrays(*entries), axis=-1)
    import torch

    return torch.stack(torch.broadcast_tensors(*entries), dim=-1)  # type: ignore[no-untyped-call]


def like(state: Array, values: np.ndarray[Any, Any]) -> Array:
    """The numbers as an array of the state's kind, precision and device."""
    if isinstance(state, np.ndarray):
        return np.asarray(values, dtype=np.float64)
    import torch

    return torch.as_tensor(np.array(values), dtype=state.dtype, device=state.device)


def single_robot(state: Array, action: Array, latent: Array | None) -> bool:
    """Whether all are vectors of ordinary floats: one robot."""
    return _vector(state) and _vector(action) and (latent is None or _vector(latent))


def _vector(part: Array) -> bool:
    return type(part) is np.ndarray and part.ndim == 1 and part.dtype == _FLOAT
