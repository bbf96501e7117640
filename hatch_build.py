"""Compiles a few modules with mypyc while a wheel is built; from the same source, so that there is one implementation.

    SAFEDPA_COMPILE=0   never: a wheel of Python source alone
    SAFEDPA_COMPILE=1   always: the build fails where it cannot be done
    unset               where a C compiler is at hand; otherwise the wheel of Python source, and a line that says so

An editable installation is never compiled: what stands next to a source file could not change with it.
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
"""Where the packages stand."""
_LIST = _SOURCES["safedpa"] / "safedpa" / "compiled.py"
_OPTIONS = "--follow-imports=skip", "--ignore-missing-imports", "--python-version=3.11"
"""What the modules import from others stays what it is in Python; so nothing else need be installed to build."""
_FLAGS = "-ffp-contract=off"
"""No a * b + c in one operation, where a processor has it: its bits would not be those of Python."""


class CompilingHook(BuildHookInterface[Any]):
    """Adds the compiled modules to a wheel."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """The compiler of Python, only where the one for C is there."""
        return list(self.config["requires"]) if self._wanted() and self._reason() is None else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles, and says in one line whether the wheel holds compiled modules."""
        if version == "editable" or not self._wanted():
            return
        problem = self._reason() or self._compiled(build_data)
        if problem is None:
            self.app.display_info("safedpa: the modules of every decision are compiled")
        elif self._forced():
            raise RuntimeError(f"safedpa: not compiled: {problem}; set SAFEDPA_COMPILE=0 for a wheel of Python source")
        else:
            self.app.display_warning(f"safedpa: a wheel of Python source: not compiled: {problem}")

    def _wanted(self) -> bool:
        return os.environ.get("SAFEDPA_COMPILE", "") != "0"

    def _forced(self) -> bool:
        return os.environ.get("SAFEDPA_COMPILE", "") == "1"

    def _reason(self) -> str | None:
        """Why it cannot be done; None: it can."""
        found = any(shutil.which(name) for name in (os.environ.get("CC", "cc").split()[0], "gcc", "clang"))
        return None if found else "no C compiler"

    def _compiled(self, build_data: dict[str, Any]) -> str | None:
        """Puts the compiled modules into the wheel; what went wrong, or None."""
        files = [name.replace(".", "/") + ".py" for name in listed(Path(self.root) / _LIST)]
        work = Path(tempfile.mkdtemp(prefix="safedpa-"))
        self._work = work
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
        """Removes what was made on the way."""
        if hasattr(self, "_work"):
            shutil.rmtree(self._work, ignore_errors=True)


def listed(path: Path) -> list[str]:
    """The modules that ``compiled.py`` names, without importing it."""
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "MODULES":
            return [str(name) for name in ast.literal_eval(statement.value)]
    raise RuntimeError(f"{path}: names no MODULES")
