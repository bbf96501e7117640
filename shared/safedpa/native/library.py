"""Compiles C sources at run time, caches the compiled kernels by digest in a private folder, and loads them.

A kernel is the file ``<digest of source and flags>-<digest of the file>.so``. It is written under another name and
renamed when it is complete, so processes may compile the same source at the same time. Before it is loaded, its
contents are compared with the digest in its name. A folder or file that another user owns or may write is refused.
Texts from which sources are made are stored next to it, as ``<key>-<digest of the file>.json``.
``SAFEDPA_COMPILE=0`` forbids compiling and loading.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import platform
import shlex
import shutil
import stat
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from hashlib import blake2b
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from queue import Queue
from threading import Lock, Thread
from typing import Any, Final

from safedpa.disk import why_not_written
from safedpa.errors import SafedpaError

__all__ = [
    "NoKernelError",
    "build_into",
    "cache_folder",
    "is_compiled",
    "later",
    "load",
    "load_module",
    "module_source",
    "recall",
    "remark",
    "remember",
    "why_not_compiled",
]

_FLAGS: Final = ("-std=c99", "-shared", "-fPIC", "-ffp-contract=off", "-fno-math-errno")
"""No fused multiply-add, which rounds once where NumPy rounds twice. Without errno, sqrt is one instruction; its result
is the same."""
_LINES: Final = ((4000, "-O2"), (8000, "-O1"))
"""Up to so many lines a source is optimised so far, and beyond not at all: a compiler takes about a second for each.
Results do not depend on it."""
_MODULE: Final = "safedpa_kernel"
_PARTS: Final = ("programs.c", "search.c", "least_violation.c", "networks.c", "selection.c", "module.c")
_PACKAGED: Final = Path(__file__).with_name("built")
"""Kernels of what ships, compiled when a wheel is built; as private as the package itself."""
_LOADING = Lock()
_PENDING: Final[list[Callable[[], None]]] = []
"""Tasks of ``later`` that are not done."""
_FAILED: Final[dict[tuple[object, ...], str]] = {}
"""Why a compiler failed, by key, folder and command."""
_SECONDS: Final = 60.0
"""s after which a compiler is ended."""
_MOST_FILES: Final = 200
"""Kernels, and as many texts, that the folder keeps; the oldest go first."""


class NoKernelError(SafedpaError):
    """There is no compiled kernel; the message says why in one line. The caller uses its NumPy implementation."""


def load(source: str) -> ctypes.PyDLL:
    """Returns the loaded kernel of a C source: the one of this process, of the cache, or one compiled now.

    Raises NoKernelError where compiling is forbidden, where there is no compiler, where it fails, or where the folder
    cannot be used.
    """
    if os.environ.get("SAFEDPA_COMPILE", "") == "0":
        raise NoKernelError("SAFEDPA_COMPILE=0 forbids compiling")
    return _load(source, cache_folder())


def is_compiled(source: str) -> bool:
    """Returns whether ``load`` needs no compiler for this source and for the extension module, or fails at once."""
    if os.environ.get("SAFEDPA_COMPILE", "") == "0":
        return True
    try:
        folder = cache_folder()
        flags = (*_FLAGS, *_python_flags())
        for one, own in ((module_source(), flags), (source, _FLAGS)):
            key, _, _ = _key(one, own)
            if not any(_files(place, key, ".so") for place in (_PACKAGED, folder)):
                return False
    except (NoKernelError, OSError):
        pass
    return True


def later(task: Callable[[], None]) -> None:
    """Runs a task in a thread of its own, after those given before; the end of the process does not wait for it."""
    _PENDING.append(task)
    _tasks().put(task)


@cache
def _tasks() -> Queue[Callable[[], None]]:
    tasks: Queue[Callable[[], None]] = Queue()

    def work() -> None:
        while True:
            task = tasks.get()
            try:
                task()
            except Exception:  # those that follow are waited for
                logging.getLogger("safedpa").exception("equations are computed by Python: compiling failed")
            finally:
                _PENDING.remove(task)

    Thread(target=work, name="safedpa-compiler", daemon=True).start()
    return tasks


def _after_fork() -> None:
    """In a forked process there is no other thread: no lock is held, and pending tasks begin again."""
    global _LOADING  # noqa: PLW0603
    _LOADING = Lock()
    _tasks.cache_clear()
    pending = _PENDING.copy()
    _PENDING.clear()
    for task in pending:
        later(task)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@cache
def remark(reason: str) -> None:
    """Reports once in a process why equations that could be compiled are not."""
    logging.getLogger("safedpa").warning("equations are computed by Python, which is slower: %s", reason)


def cache_folder() -> Path:
    """The folder of compiled kernels: ``safedpa/kernels`` in ``$XDG_CACHE_HOME``, by default ``~/.cache``.

    Raises NoKernelError where there is no home directory.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    try:
        root = Path(given) if Path(given).is_absolute() else Path.home() / ".cache"
    except RuntimeError as error:
        raise NoKernelError("no home directory: set XDG_CACHE_HOME") from error
    return root / "safedpa" / "kernels"


def load_module() -> Any:
    """Returns the extension module of decisions, with ``Step``, ``Networks``, ``Rows`` and ``Search``.

    Raises NoKernelError without a compiled module.
    """
    with _LOADING:  # two copies would have two sets of types
        return _loaded_module()


@cache
def _loaded_module() -> Any:
    if os.environ.get("SAFEDPA_COMPILE", "") == "0":
        raise NoKernelError("SAFEDPA_COMPILE=0 forbids compiling")
    path = _path_of(module_source(), (*_FLAGS, *_python_flags()), cache_folder())
    try:
        loader = ExtensionFileLoader(_MODULE, str(path))
        spec = spec_from_loader(_MODULE, loader)
        assert spec is not None
        module = module_from_spec(spec)
        loader.exec_module(module)
    except ImportError as error:
        raise NoKernelError(f"{path.name} cannot be loaded: {str(error).splitlines()[0]}") from error
    return module


@cache
def module_source() -> str:
    """The C of the extension module."""
    return "\n".join(Path(__file__).with_name(part).read_text(encoding="utf-8") for part in _PARTS)


def why_not_compiled() -> str:
    """Why decisions are computed by Python; empty: they are compiled. The first call may compile for two seconds."""
    try:
        load_module()
    except NoKernelError as error:
        return str(error)
    return ""


def recall(key: str) -> str | None:
    """Returns the text that the cache has under a key; None: there is none."""
    with contextlib.suppress(NoKernelError, OSError):
        folder = cache_folder()
        _make_private(folder)
        path = _cached(folder, key, ".json")
        return None if path is None else path.read_text(encoding="utf-8")
    return None


def remember(key: str, text: str) -> None:
    """Stores a text in the cache under a key, where that is possible."""
    with contextlib.suppress(NoKernelError, OSError):
        folder = cache_folder()
        _make_private(folder)
        with tempfile.TemporaryDirectory(prefix="new-", dir=folder) as work:
            made = Path(work) / "text.json"
            made.write_text(text, encoding="utf-8")
            _keep(made, folder, key)


def _keep(made: Path, folder: Path, key: str) -> Path:
    """Moves a complete file to its name in the folder."""
    made.chmod(0o600)
    path = folder / f"{key}-{_digest(made.read_bytes())}{made.suffix}"
    made.replace(path)
    _remove_oldest(folder, path)
    return path


def build_into(folder: Path, sources: Sequence[str]) -> None:
    """Compiles the extension module and these sources into a folder, for a wheel. Raises NoKernelError."""
    folder.mkdir(parents=True, exist_ok=True)
    for source, flags in ((module_source(), (*_FLAGS, *_python_flags())), *((one, _FLAGS) for one in sources)):
        # readable by the users of the wheel, who are others than the one who built it
        _compiled(folder, *_key(source, flags)).chmod(0o644)


def _python_flags() -> tuple[str, ...]:
    # the version is in the key as well: an extension is for one version of Python
    return f"-I{sysconfig.get_paths()['include']}", f"-DMADE_FOR_PYTHON={sys.hexversion}"


@cache
def _load(source: str, folder: Path) -> ctypes.PyDLL:
    path = _path_of(source, _FLAGS, folder)
    try:
        # PyDLL keeps the interpreter's lock: a kernel takes microseconds, and to get the lock back may take 5 ms
        return ctypes.PyDLL(str(path))
    except OSError as error:
        raise NoKernelError(f"{path.name} cannot be loaded: {str(error).splitlines()[0]}") from error


@cache
def _key(source: str, flags: tuple[str, ...]) -> tuple[str, str, tuple[str, ...]]:
    """Returns the key in the name of a kernel, the source, and all flags."""
    every = (_optimisation(source), *flags)
    # without folders, which differ between the machine that builds a wheel and the one that uses it
    named = tuple(flag for flag in every if not flag.startswith("-I"))
    parts = source, named, platform.machine(), platform.libc_ver(), platform.system()
    return _digest(repr(parts).encode()), source, every


def _path_of(source: str, flags: tuple[str, ...], folder: Path) -> Path:
    """Returns the file of a source: of the package, of the cache, or compiled now."""
    key, _, every = _key(source, flags)
    for path in _files(_PACKAGED, key, ".so"):
        # as private as the sources next to it: others may not write
        shared = any(each.stat().st_mode & 0o022 for each in (_PACKAGED, path))
        if not shared and path.name == f"{key}-{_digest(path.read_bytes())}.so":
            return path
    try:
        _make_private(folder)
        return _cached(folder, key, ".so") or _compiled(folder, key, source, every)
    except OSError as error:
        raise NoKernelError(f"{folder}: {why_not_written(error)}") from error


def _optimisation(source: str) -> str:
    lines = source.count("\n")
    return next((flag for most, flag in _LINES if lines <= most), "-O0")


def _digest(data: bytes) -> str:
    return blake2b(data, digest_size=16).hexdigest()


def _files(folder: Path, key: str, suffix: str) -> list[Path]:
    """The files of a key; a glob would take ten times as long."""
    try:
        names = os.listdir(folder)
    except OSError:  # there is none, or it cannot be read: then there is no kernel in it
        return []
    return [folder / name for name in names if name.startswith(f"{key}-") and name.endswith(suffix)]


def _make_private(folder: Path) -> None:
    """Creates the folder for this user alone. Raises NoKernelError for one that another user owns or may write."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    # a user who may write the folder above could exchange this one between the check and the loading
    _check_owner(folder.parent, stat.S_ISDIR)
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_owner(folder, stat.S_ISDIR)


def _check_owner(path: Path, kind: object) -> None:
    found = path.lstat()  # of a link itself: its target may be exchanged
    if not kind(found.st_mode):  # type: ignore[operator]
        raise NoKernelError(f"{path}: got a link or another kind of file; remove it")
    if hasattr(os, "geteuid") and found.st_uid != os.geteuid():
        raise NoKernelError(f"{path}: belongs to user {found.st_uid}, wanted the user of this process; remove it")
    if found.st_mode & 0o022:
        raise NoKernelError(f"{path}: other users may write it, wanted a private one; chmod go-w it")


def _cached(folder: Path, key: str, suffix: str) -> Path | None:
    """Returns a file of the cache whose contents have the digest in its name; others are removed."""
    for path in _files(folder, key, suffix):
        _check_owner(path, stat.S_ISREG)
        if path.name == f"{key}-{_digest(path.read_bytes())}{suffix}":
            return path
        path.unlink(missing_ok=True)
    return None


def _compiled(folder: Path, key: str, source: str, flags: tuple[str, ...]) -> Path:
    import subprocess  # only where a kernel is compiled: a service must start in 0.7 s

    compiler = _compiler()
    for headers in (Path(flag[2:]) for flag in flags if flag.startswith("-I")):
        if not (headers / "Python.h").is_file():
            raise NoKernelError(f"{headers} has no Python.h: install the headers of this Python")
    # a compiler that fails or hangs is not asked again for the same source
    attempt = key, folder, *compiler
    if attempt in _FAILED:
        raise NoKernelError(_FAILED[attempt])
    with tempfile.TemporaryDirectory(
        prefix="new-", dir=folder
    ) as work:  # 0700; on the same disk, so renaming is atomic
        text, made = Path(work) / "kernel.c", Path(work) / "kernel.so"
        text.write_text(source, encoding="utf-8")
        command = [*compiler, *flags, "-o", str(made), str(text), "-lm"]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, timeout=_SECONDS, stdin=subprocess.DEVNULL
            )
        except subprocess.TimeoutExpired as error:
            _FAILED[attempt] = f"{compiler[0]} took more than {_SECONDS:g} s"
            raise NoKernelError(_FAILED[attempt]) from error
        if done.returncode != 0 or not made.is_file():
            reason = (done.stderr.strip().splitlines() or ["no output"])[0]
            _FAILED[attempt] = f"{compiler[0]} failed: {reason.replace(work, '')}"
            raise NoKernelError(_FAILED[attempt])
        return _keep(made, folder, key)


def _compiler() -> list[str]:
    """Returns the command of the C compiler: ``$CC``, cc, gcc or clang."""
    given = shlex.split(os.environ.get("CC", ""))
    for command in (given, ["cc"], ["gcc"], ["clang"]):
        if command and (found := shutil.which(command[0])):
            return [found, *command[1:]]
    raise NoKernelError("no C compiler was found (cc, gcc or clang)")


def _remove_oldest(folder: Path, kept: Path) -> None:
    def age(path: Path) -> float:
        try:
            return path.stat().st_mtime
        except OSError:  # another process removed it
            return 0.0

    files = sorted((path for path in folder.glob(f"*{kept.suffix}") if path != kept), key=age)
    for path in files[: max(len(files) + 1 - _MOST_FILES, 0)]:
        path.unlink(missing_ok=True)
