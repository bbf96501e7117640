"""f and g of learned networks by C (``native/networks.c``), where that gives the bits of ``LearnedNetworks``.

Sums of float32 depend on their order, and NumPy leaves that to its BLAS. So each product is tried on inputs of every
kind before it is used: C in the order of OpenBLAS, else a call of the BLAS that NumPy has loaded. Where neither gives
NumPy's bits there is no compiled network, and NumPy computes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache, partial
from threading import Event
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import Float32Array
from safedpa.equations.tape import FLOAT_FORMS, FUNCTIONS, NotRecordableError, Recorded, Tape, name_of
from safedpa.native.captured import Captured
from safedpa.native.library import NoKernelError, is_compiled, later, load, load_module, remark
from safedpa.native.translate import Translator
from safedpa.networks.frame import Frame
from safedpa.systems.robots import robots

__all__ = ["CompiledNetworks", "Product", "frame_source", "frame_sources"]

Product = tuple[Float32Array, Float32Array, Float32Array, Float32Array | None]
"""y (columns,) = x (rows,) a (rows, columns): a, x, y, and the part of a buffer that is then cut below zero."""

_SYMBOLS: Final = (("scipy_cblas_sgemv64_", True), ("cblas_sgemv64_", True), ("cblas_sgemv", False))
"""What NumPy's BLAS calls the product of a vector and a matrix, and whether its integers have 64 bits."""
_TRIALS: Final = 24
_USED: Final = (1.0, 0.5, 0.1, 0.02)
"""Shares of the inputs that are not 0."""
_SEED: Final = 4813


@final
class CompiledNetworks:
    """Makes ``safedpa_kernel.Networks`` at once if its C is in the cache, otherwise by a background thread."""

    def __init__(
        self, frame: Frame, sizes: tuple[int, int, int], products: Sequence[Product], seen: Float32Array
    ) -> None:
        """``sizes``: states, actions, latents; ``seen``: the input (features + latents, ...), given to the first."""
        self._networks: Any = None
        self._done = Event()
        self._products = list(products)
        self._watched = [each for each in map(Captured, frame.functions) if each.values or each.impure]
        try:
            source, constants = frame_source(frame, sizes[0])
            if any(each.impure for each in self._watched):
                raise NotRecordableError("the features read what a recording would freeze")
            ready = is_compiled(source)
        except NotRecordableError:  # features that are no equations
            self._done.set()
            return
        make = partial(self._make, frame, sizes, seen, source, constants)
        if ready:
            make()
        else:
            later(make)

    @property
    def networks(self) -> Any:
        """The object with ``known(state, latent)``; None: NumPy computes."""
        if self._watched and not all(each.unchanged() for each in self._watched):
            return None
        return self._networks

    def wait(self) -> None:
        """Waits until there is no compiler to wait for."""
        self._done.wait()

    def _make(
        self, frame: Frame, sizes: tuple[int, int, int], seen: Float32Array, source: str, constants: list[float]
    ) -> None:
        try:
            library, (gemv, wide) = load(source), _numpy_gemv()
            features = ctypes.cast(library.frame_features, ctypes.c_void_p).value
            own = (*sizes, len(frame.feature_names))
            made = load_module().Networks(
                features, constants, own, frame.turned, self._products, seen, self._products[-1][2], gemv, wide,
                (library, self._products, seen),
            )  # fmt: skip
            if all(_has_numpys_bits(made, index, one) for index, one in enumerate(self._products)):
                self._networks = made
        except NoKernelError as error:
            remark(str(error))
        finally:
            self._done.set()


def frame_source(frame: Frame, states: int) -> tuple[str, list[float]]:
    """Returns the C of a frame's features and of cosine and sine of its heading, and the constants of the call.

    Raises NotRecordableError for features that are no equations.
    """
    tape, translator = Tape(), Translator()
    state = [Recorded(tape, f"s{index}") for index in range(states)]
    try:
        results = [name_of(entry) for entry in frame.seen_and_heading(state, tape.operations())]
        if len(results) != len(frame.feature_names) + 2:
            raise ValueError("the features have other names")
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        raise NotRecordableError(str(error)) from error
    tape.keep(results)
    body = [f"const double {number.name} = s[{index}];" for index, number in enumerate(state)]
    for name, form, operands in tape.lines:
        written = FLOAT_FORMS.get(form, f"{form}({', '.join(f'{{{i}}}' for i in range(len(operands)))})")
        term = (written if form in FUNCTIONS else form).format(*operands)
        body.append(f"const double {name} = {translator.expression(term)};")
    body += [f"out[{index}] = {translator.expression(name)};" for index, name in enumerate(results)]
    head = '#include <math.h>\n\n__attribute__((visibility("default"))) void frame_features('
    lines = "\n    ".join(["(void)k;", *body])
    return f"{head}const double *s, const double *k, double *out)\n{{\n    {lines}\n}}\n", translator.constants


def frame_sources() -> list[str]:
    """Returns the C of the frames of all robots with learned models, each once."""
    frames = [(robot.frame(), len(robot.system.state_names)) for robot in robots().values()]
    return list(dict.fromkeys(frame_source(frame, states)[0] for frame, states in frames if frame is not None))


def _has_numpys_bits(made: Any, index: int, product: Product) -> bool:
    """Chooses how C computes a product; returns whether it has NumPy's bits."""
    a, x, y, _ = product
    random = np.random.default_rng([_SEED, *a.shape])
    before, inputs = x.copy(), list[Float32Array]()
    for trial in range(_TRIALS):
        drawn = random.normal(0.0, 10.0 ** (trial % 5 - 2), len(x))
        drawn[random.random(len(x)) > _USED[trial % len(_USED)]] = 0.0
        inputs.append(drawn.astype(np.float32))
    try:
        return any(all(_is_equal(made, index, sparse, product, one) for one in inputs) for sparse in (True, False))
    finally:
        x[:], y[:] = before, 0.0


def _is_equal(made: Any, index: int, sparse: bool, product: Product, values: Float32Array) -> bool:
    a, x, y, cut = product
    x[:] = values
    wanted = x.dot(a)
    try:
        made.multiply(index, sparse)
    except ValueError:  # this processor, or NumPy's BLAS, does not offer it
        return False
    if cut is not None:
        np.maximum(wanted, 0.0, out=wanted)
    return bool(np.isfinite(wanted).all()) and wanted.tobytes() == y.tobytes()


@cache
def _numpy_gemv() -> tuple[int, bool]:
    """Returns the address of the product in the BLAS that NumPy has loaded, and its integers; 0: it is not found."""
    from numpy._core import _multiarray_umath  # type: ignore[attr-defined]

    try:
        library = ctypes.CDLL(_multiarray_umath.__file__)  # its symbols, and those of what it is linked to
    except (OSError, TypeError):
        return 0, False
    for name, wide in _SYMBOLS:
        found = getattr(library, name, None)
        if found is not None:
            return ctypes.cast(found, ctypes.c_void_p).value or 0, wide
    return 0, False
