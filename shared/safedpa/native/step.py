"""A kernel for one step of a model: the next state, and its slopes in the action, each in one C call."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from dataclasses import replace
from threading import local
from typing import Any, Self, final

import numpy as np

from safedpa.native.c_source import PRELUDE, Constants, function_source, slope_lines
from safedpa.native.library import load, load_module
from safedpa.native.tracing import RecordedFunction

__all__ = ["StepKernel"]

_EXPORTS = """
__attribute__((visibility("default"))) void call_step(
    const double *s, const double *a, const double *z, const double *t, const double *k, double *out)
{
    step(s, a, z, t, k, out);
}

__attribute__((visibility("default"))) void call_tangent(
    const double *s, const double *a, const double *z, const double *t, const double *k, double *out, double *slopes)
{
    step(s, a, z, t, k, out);
    tangent(s, a, z, t, k, slopes);
}
"""


@final
class StepKernel:
    """x[t+1] and d(x[t+1])/d(a) of a recording with the inputs state, action, latent and time.

    NaN and infinity are results as others are: nothing is raised. Threads may share an instance.
    """

    def __init__(self, functions: ctypes.PyDLL, constants: Any, sizes: tuple[int, ...]) -> None:
        self._step, self._tangent = functions.call_step, functions.call_tangent
        self._step.restype = self._tangent.restype = None
        self._constants, self._sizes = constants, sizes
        self._spaces, self._library = local(), functions
        self._object: Any = None

    @classmethod
    def compiled(cls, recording: RecordedFunction) -> Self:
        """Compiles, or finds in the cache. Raises NotRecordableError for an operation without C or without a slope."""
        constants = Constants()
        slopes, table = slope_lines(recording.lines, constants, recording.inputs[1], recording.results)
        body = [f"const double {name} = {term};" for name, term in slopes]
        body += [f"out[{index}] = {entry};" for index, entry in enumerate(entry for row in table for entry in row)]
        names = ("s", "a", "z", "t")
        text = [
            PRELUDE,
            function_source("step", recording, constants, names),
            function_source("tangent", replace(recording, results=()), constants, names, lambda *_: body),
            _EXPORTS,
        ]
        functions = load("\n".join(text))
        sizes = (*map(len, recording.inputs), len(recording.results))
        return cls(functions, np.array(constants.values), sizes)

    def step(
        self, state: Iterable[float], action: Iterable[float], latent: Iterable[float], time: float
    ) -> list[float]:
        """x[t+1] (states,). Raises ValueError for inputs of another size."""
        work = self._filled(state, action, latent, time)
        self._step(*work.inputs)
        found: list[float] = work.out[:]
        return found

    def compiled_step(self) -> Any:
        """The same functions as ``safedpa_kernel.Step``. Raises NoKernelError."""
        if self._object is None:
            addresses = [ctypes.cast(each, ctypes.c_void_p).value for each in (self._step, self._tangent)]
            states, actions, latents = self._sizes[:3]
            constants = self._constants.tolist()
            self._object = load_module().Step(*addresses, constants, states, actions, latents, self._library)
        return self._object

    def tangent(
        self, state: Iterable[float], action: Iterable[float], latent: Iterable[float], time: float
    ) -> tuple[list[float], list[list[float]]]:
        """x[t+1] (states,) and its slopes in the action (states, actions). Raises ValueError as ``step``."""
        work, actions = self._filled(state, action, latent, time), self._sizes[1]
        self._tangent(*work.inputs, work.slopes)
        slopes = work.slopes[:]
        return work.out[:], [slopes[row * actions : (row + 1) * actions] for row in range(self._sizes[4])]

    def _filled(
        self, state: Iterable[float], action: Iterable[float], latent: Iterable[float], time: float
    ) -> _Workspace:
        try:
            work: _Workspace = self._spaces.work
        except AttributeError:
            work = self._spaces.work = _Workspace(self._sizes, self._constants)
        work.s[:], work.a[:], work.z[:] = [*state], [*action], [*latent]
        work.t[0] = time
        return work


@final
class _Workspace:
    """The arrays of one thread."""

    def __init__(self, sizes: tuple[int, ...], constants: Any) -> None:
        self.s, self.a, self.z, self.t, self.out = ((ctypes.c_double * size)() for size in sizes)
        self.slopes = (ctypes.c_double * (sizes[4] * sizes[1]))()
        self.inputs = (self.s, self.a, self.z, self.t, ctypes.c_void_p(constants.ctypes.data), self.out)
