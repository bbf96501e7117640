"""C from recorded equations, compiled at run time where a C compiler is present, with the same results as NumPy.

Read ``tracing`` first (a user's functions become a recording), then ``c_source`` (a recording becomes a C function),
``library`` (the compiler, the cache of compiled kernels, and what is refused) and ``rollout`` (a model under its backup
and the minimum of h, with ``path_minimum.c``). Without a compiler every caller uses its NumPy implementation.
"""

from safedpa.native.library import NoKernelError

__all__ = ["NoKernelError"]
