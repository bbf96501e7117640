"""Whatever a folder of foreign logs contains, no process that we start imports it."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NAMES = ("multiprocessing", "pickle", "json", "argparse", "numpy", "click", "concurrent", "safedpa", "sitecustomize")
"""Modules that our processes import, as files in the folder."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose modules leave a mark when they are imported."""
    place = tmp_path / "logs"
    place.mkdir()
    for name in NAMES:
        (place / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\n")
    return place


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}


@pytest.mark.processes
@pytest.mark.parametrize("start", ["script", "module"])
def test_a_command_in_a_foreign_folder_runs_nothing_of_it(folder: Path, start: str) -> None:
    (folder / "drive.csv").write_text("t,x\n0,1\n")
    safedpa = Path(sys.executable).with_name("safedpa")
    command = [str(safedpa)] if start == "script" else [sys.executable, "-P", "-m", "safedpa_services"]
    subprocess.run(
        [*command, "compare", "car", "drive.csv"],
        cwd=folder, env=environment(), capture_output=True, check=False, timeout=120.0,
    )  # fmt: skip
    assert not (folder.parent / "ran").exists()


@pytest.mark.processes
def test_workers_of_a_library_call_in_a_foreign_folder_import_nothing_of_it(folder: Path) -> None:
    """A script of the user's lies elsewhere; the processes that it starts have the folder as working directory."""
    script = folder.parent / "own" / "script.py"
    script.parent.mkdir()
    script.write_text(
        "from safedpa.fleet.workers import in_processes\n"
        "if __name__ == '__main__':\n"
        "    print(sorted(in_processes(abs, [-1, -2], 2, lambda job, why: why)))\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=120.0,
    )  # fmt: skip
    assert done.stdout == "[1, 2]\n", done.stderr
    assert not (folder.parent / "ran").exists()


def starts_python(path: Path) -> list[str]:
    """Returns the names by which a module starts processes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = {"Popen", "ProcessPoolExecutor", "get_context", "create_subprocess_exec", "run"}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            owner = getattr(getattr(node.func, "value", None), "id", "")
            if name in calls and (name != "run" or owner == "subprocess"):
                found.append(name)
    return found


PLACES = [
    path for part in ("shared", "services") for path in sorted((ROOT / part).rglob("*.py")) if starts_python(path)
]
ISOLATED = {
    "private_folder.py": "-I",
    "own_process.py": 'cwd="/"',  # and -S: the search path is given
    "screenshot.py": "viewer_program",  # no Python
    "library.py": "compiler",  # no Python
}


@pytest.mark.parametrize("path", PLACES, ids=lambda path: path.name)
def test_every_place_that_starts_a_process_isolates_it(path: Path) -> None:
    assert ISOLATED.get(path.name, "PYTHONSAFEPATH") in path.read_text(encoding="utf-8"), path
