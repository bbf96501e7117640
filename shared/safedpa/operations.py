"""One equation, three kinds of numbers.

Physics in this project is written once, over named scalars. The same lines then run on

- Python floats (one robot, no array overhead: the services),
- numpy arrays (many windows of a recording at once: comparison and diagnosis),
- torch tensors (thousands of robots with gradients: training),

because every function beyond ``+ - * /`` is taken from an ``Operations`` table that fits the numbers.
Torch is imported only when a torch tensor comes in.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

__all__ = ["FLOATS", "NUMPY", "Operations", "Scalar", "operations_for", "torch_operations"]

Scalar = Any
"""A Python float, a numpy array or a torch tensor, all entries of which mean the same quantity."""


@dataclass(frozen=True)
class Operations:
    """The elementwise functions that equations may use; all angles in radians."""

    sin: Callable[[Scalar], Scalar]
    cos: Callable[[Scalar], Scalar]
    tan: Callable[[Scalar], Scalar]
    atan: Callable[[Scalar], Scalar]
    tanh: Callable[[Scalar], Scalar]
    exp: Callable[[Scalar], Scalar]
    sqrt: Callable[[Scalar], Scalar]
    absolute: Callable[[Scalar], Scalar]
    sign: Callable[[Scalar], Scalar]
    minimum: Callable[[Scalar, Scalar], Scalar]
    maximum: Callable[[Scalar, Scalar], Scalar]
    where: Callable[[Any, Scalar, Scalar], Scalar]

    def clip(self, value: Scalar, low: Scalar, high: Scalar) -> Scalar:
        """min(max(value, low), high), elementwise."""
        return self.minimum(self.maximum(value, low), high)


FLOATS = Operations(
    sin=math.sin,
    cos=math.cos,
    tan=math.tan,
    atan=math.atan,
    tanh=math.tanh,
    exp=math.exp,
    sqrt=math.sqrt,
    absolute=abs,
    sign=lambda value: float((value > 0) - (value < 0)),
    minimum=min,
    maximum=max,
    where=lambda condition, yes, no: yes if condition else no,
)

NUMPY = Operations(
    sin=np.sin,
    cos=np.cos,
    tan=np.tan,
    atan=np.arctan,
    tanh=np.tanh,
    exp=np.exp,
    sqrt=np.sqrt,
    absolute=np.abs,
    sign=np.sign,
    minimum=np.minimum,
    maximum=np.maximum,
    where=np.where,
)


@cache
def torch_operations() -> Operations:
    """The table for torch tensors; plain numbers are allowed beside tensors."""
    import torch

    def lifted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(first: Any, second: Any) -> Any:
            reference = first if isinstance(first, torch.Tensor) else second
            if not isinstance(reference, torch.Tensor):
                reference = torch.zeros((), dtype=torch.float64)
            return function(
                torch.as_tensor(first, dtype=reference.dtype, device=reference.device),
                torch.as_tensor(second, dtype=reference.dtype, device=reference.device),
            )

        return call

    def unary(function: Callable[..., Any]) -> Callable[[Any], Any]:
        def call(value: Any) -> Any:
            # A plain number becomes a tensor without axes: it takes the precision of what it is combined with.
            return function(value if isinstance(value, torch.Tensor) else torch.tensor(value, dtype=torch.float64))

        return call

    return Operations(
        sin=unary(torch.sin),
        cos=unary(torch.cos),
        tan=unary(torch.tan),
        atan=unary(torch.atan),
        tanh=unary(torch.tanh),
        exp=unary(torch.exp),
        sqrt=unary(torch.sqrt),
        absolute=unary(torch.abs),
        sign=unary(torch.sign),
        minimum=lifted(torch.minimum),
        maximum=lifted(torch.maximum),
        where=torch.where,
    )


def operations_for(value: Any) -> Operations:
    """The table that fits ``value``: a float, a numpy array or a torch tensor."""
    if isinstance(value, (float, int)):
        return FLOATS
    if isinstance(value, np.ndarray):
        return NUMPY
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.Tensor):
        return torch_operations()
    raise TypeError(f"got {type(value).__name__}, wanted a float, a numpy array or a torch tensor")
