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


STARTERS = {
    "workers of a library call": """
        from safedpa.fleet.workers import in_processes
        print(sorted(in_processes(abs, [-1, -2], 2, lambda job, why: why)) == [1, 2])""",
    "reader of a file": """
        import contextlib
        import safedpa
        from safedpa.records import load_run
        for file in ("drive.csv", "drive.mcap"):
            with contextlib.suppress(safedpa.SafedpaError):  # what is in them does not matter
                load_run(file, safedpa.load_model("car").system)
        print(True)""",
    "worker of the workbench": """
        import asyncio
        from safedpa_services.workbench.session.worker import Worker
        worker = Worker()
        print(asyncio.run(worker.ask(callable)))  # of the function that reports progress
        worker.stop()""",
    "files of the viewer": """
        from safedpa_services.web.viewer import Viewer
        print(Viewer().file("favicon.ico") is not None)""",
    "trial of a model": """
        from safedpa.bus.service.sandbox import JobProcess
        process = JobProcess("safedpa_services.model_trial:run_model_trial")
        print("problem" in process.submit(None).outcome(wait=True))
        process.close()""",
    "keys of a run": """
        from safedpa_services.supervisor.private_folder import private_folder
        with private_folder() as place:
            print(place.exists())""",
}


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("name", STARTERS)
def test_no_process_of_a_library_call_in_a_foreign_folder_imports_from_it(folder: Path, name: str) -> None:
    """A script of the user's lies elsewhere; the processes that it starts have the folder as working directory."""
    for file in ("drive.csv", "drive.mcap"):
        (folder / file).write_text("t,x\n0,1\n")
    script = folder.parent / "own" / "script.py"
    script.parent.mkdir()
    script.write_text("if __name__ == '__main__':" + STARTERS[name])
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=120.0,
    )  # fmt: skip
    assert done.stdout == "True\n", done.stderr
    assert not (folder.parent / "ran").exists()


STARTS = {
    "subprocess": ("Popen", "run", "call", "check_call", "check_output", "getoutput"),
    "os": ("system", "popen", "execv", "execve", "execvp", "execl", "posix_spawn", "spawnv", "spawnl"),
    "asyncio": ("create_subprocess_exec", "create_subprocess_shell"),
}
"""Functions that start processes by the module that is named at the call; the names below are enough without one."""
NAMED = ("Popen", "ProcessPoolExecutor", "get_context", "Process", "Pool", "create_subprocess_exec")


PARTS_OF_NAMES = ("subprocess", "Popen", "Pool", "get_context", "Process(", "os.sys", "os.popen", "os.exec", "spawn")
"""Text without any of these calls none of them: most modules need not be parsed."""


def starts_python(path: Path) -> list[str]:
    """Returns the names by which a module starts processes."""
    found, text = [], path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)) if any(part in text for part in PARTS_OF_NAMES) else ():
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            owner = getattr(getattr(node.func, "value", None), "id", "")
            if name in NAMED or name in STARTS.get(owner, ()):
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


def test_processes_of_the_laboratory_inherit_the_safe_path_of_its_commands() -> None:
    """``main`` of the command line sets it, so that a process loses it only with an environment of its own."""
    assert 'os.environ["PYTHONSAFEPATH"] = "1"' in (
        ROOT / "services" / "safedpa_services" / "command_line" / "__init__.py"
    ).read_text(encoding="utf-8")
    for path in (path for path in (ROOT / "sim").rglob("*.py") if starts_python(path)):
        text = path.read_text(encoding="utf-8")
        assert "env=" not in text or "os.environ" in text, path


@pytest.mark.parametrize("path", PLACES, ids=lambda path: path.name)
def test_every_place_that_starts_a_process_isolates_it(path: Path) -> None:
    assert ISOLATED.get(path.name, "PYTHONSAFEPATH") in path.read_text(encoding="utf-8"), path
