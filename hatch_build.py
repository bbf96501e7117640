"""Compiles decisions to C and a few modules of the services with mypyc while a wheel is built.

    SAFEDPA_COMPILE=0   never compiles: a wheel of Python source alone
    SAFEDPA_COMPILE=1   always compiles: the build fails where that is not possible
    unset               compiles if a C compiler is found; otherwise the wheel holds Python source, and a line says so

An editable installation gets neither: its decisions are compiled to the user's cache (``python -m safedpa.generate``),
and a compiled module would not follow when its source is edited.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

__all__ = ["CompilingHook"]

_SOURCES = {"safedpa": Path("shared"), "safedpa_sim": Path("sim")}
"""The folder of each package."""
_BUILT = "safedpa/native/built"
"""Where ``safedpa.native.library`` looks for compiled decisions first."""
_LIST = _SOURCES["safedpa"] / "safedpa" / "compiled.py"
_OPTIONS = "--follow-imports=skip", "--ignore-missing-imports", "--python-version=3.11"
"""Imported modules are not compiled along, so nothing else need be installed to compile."""
_FLAGS = "-ffp-contract=off"
"""No fused multiply-add: it rounds once where Python rounds twice, so results would differ from the source's."""


class CompilingHook(BuildHookInterface[Any]):
    """Adds compiled decisions and modules to a wheel."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """What ``safedpa.generate`` imports, and mypyc; nothing where nothing is compiled."""
        if not self._wanted() or self._reason() is not None:
            return []
        return [*self.config["generator"], *self.config["requires"]]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles, and reports in one line whether the wheel holds what was compiled.

        Raises RuntimeError where a demanded compilation fails.
        """
        if version == "editable" or not self._wanted():
            return
        self._work = work = Path(tempfile.mkdtemp(prefix="safedpa-"))
        problem = self._reason() or self._kernels(work / "kernels") or self._compiled(work / "modules", build_data)
        if problem is None:
            built = {str(file): f"{_BUILT}/{file.name}" for file in (work / "kernels").glob("*.so")}
            build_data["force_include"].update(built)
            self.app.display_info("safedpa: decisions and the services' innermost modules are compiled")
        elif self._forced():
            raise RuntimeError(f"safedpa: not compiled: {problem}; set SAFEDPA_COMPILE=0 for a wheel of Python source")
        else:
            self.app.display_warning(f"safedpa: a wheel of Python source: not compiled: {problem}")

    def _wanted(self) -> bool:
        return os.environ.get("SAFEDPA_COMPILE", "") != "0"

    def _forced(self) -> bool:
        return os.environ.get("SAFEDPA_COMPILE", "") == "1"

    def _reason(self) -> str | None:
        """Why nothing can be compiled; None: it can."""
        found = any(shutil.which(name) for name in (os.environ.get("CC", "cc").split()[0], "gcc", "clang"))
        return None if found else "no C compiler"

    def _kernels(self, folder: Path) -> str | None:
        """Compiles the decisions of the shipped robots into a folder. Returns what went wrong, or None."""
        # Not by PYTHONPATH: pip's isolated environment removes every path that an editable installation has added, and
        # the sources are one of them.
        sources = str(Path(self.root) / _SOURCES["safedpa"])
        code = f"import runpy, sys; sys.path.insert(0, {sources!r}); "
        code += "runpy.run_module('safedpa.generate', None, '__main__')"
        command = [sys.executable, "-c", code, str(folder)]
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        if done.returncode != 0 or not any(folder.glob("*.so")):
            reason = (done.stderr.strip().splitlines() or ["no output"])[-1]
            return f"python -m safedpa.generate: {reason}"
        return None

    def _compiled(self, work: Path, build_data: dict[str, Any]) -> str | None:
        """Puts the compiled modules into the wheel. Returns what went wrong, or None."""
        files = [name.replace(".", "/") + ".py" for name in listed(Path(self.root) / _LIST)]
        for file in files:
            (work / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(Path(self.root) / _SOURCES[Path(file).parts[0]] / file, work / file)
            for folder in (work / file).parents:
                if folder == work:
                    break
                (folder / "__init__.py").touch()
        command = [sys.executable, "-m", "mypyc", *_OPTIONS, *files]
        flags = {**os.environ, "CFLAGS": f"{os.environ.get('CFLAGS', '')} {_FLAGS}".strip()}
        done = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False, env=flags)
        made = sorted(path for path in work.rglob("*.so") if "build" not in path.relative_to(work).parts)
        if done.returncode != 0 or len(made) <= len(files):
            phrase = (done.stdout + done.stderr).strip().splitlines()
            return f"mypyc: {phrase[-1] if phrase else 'no modules came out'}"
        build_data["force_include"].update({str(path): str(path.relative_to(work)) for path in made})
        build_data["pure_python"], build_data["infer_tag"] = False, True
        return None

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the temporary folder."""
        if hasattr(self, "_work"):
            shutil.rmtree(self._work, ignore_errors=True)


def listed(path: Path) -> list[str]:
    """Returns the modules that ``compiled.py`` names, without importing it."""
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "MODULES":
            return [str(name) for name in ast.literal_eval(statement.value)]
    raise RuntimeError(f"{path}: names no MODULES")
