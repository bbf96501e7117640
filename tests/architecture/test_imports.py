"""Imports go down only, services know each other by the bus alone, and every process starts lightly."""

import ast
import graphlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[2]
SERVICES = ROOT / "services" / "safedpa_services"
SHARED_BY_SERVICES = {"service_main", "service_factories", "web"}
LAUNCHERS = {"command_line", "supervisor"}
"""What a person starts: these may know the services and the simulator."""
HEAVY = {"torch", "rerun", "plotly", "scipy", "pandas", "matplotlib"}

PACKAGES = sorted(path.name for path in SERVICES.iterdir() if (path / "__init__.py").exists())
MAINS = sorted(name for name in PACKAGES if (SERVICES / name / "__main__.py").exists())


@cache
def imported(path: Path) -> set[str]:
    """Every module that a file names in an import, wherever it stands."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_the_contracts_of_import_linter_are_kept() -> None:
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([program, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_module_imports_itself_through_others() -> None:
    """Imports for annotations and imports within functions count."""
    graph = grimp.build_graph(
        "safedpa", "safedpa_services", "safedpa_sim", "safedpa_lab", include_external_packages=False
    )
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    graphlib.TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("service", [name for name in PACKAGES if name not in LAUNCHERS])
def test_a_service_imports_no_other_service(service: str) -> None:
    allowed = {service, *SHARED_BY_SERVICES}
    for path in (SERVICES / service).rglob("*.py"):
        for module in imported(path):
            if module.startswith("safedpa_services."):
                assert module.split(".")[1] in allowed, f"{path}: {module}"


def test_nothing_but_what_a_person_starts_imports_the_simulator() -> None:
    for path in SERVICES.rglob("*.py"):
        if path.relative_to(SERVICES).parts[0] not in LAUNCHERS:
            assert not any(module.split(".")[0] == "safedpa_sim" for module in imported(path)), path


@pytest.mark.long
def test_the_library_imports_neither_services_nor_simulator_and_nothing_the_laboratory() -> None:
    upper = {"safedpa_services", "safedpa_lab"}
    for folder, banned in (
        ("shared", {*upper, "safedpa_sim"}),
        ("sim/safedpa_sim", upper),
        ("services", {"safedpa_lab"}),
    ):
        for path in (ROOT / folder).rglob("*.py"):
            assert not banned & {module.split(".")[0] for module in imported(path)}, path


def loaded_by(module: str) -> set[str]:
    """Top-level packages in memory after importing a module in a fresh interpreter."""
    code = f"import sys, {module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.mark.long
@pytest.mark.parametrize("service", [*MAINS, "command_line"])
def test_a_process_starts_lightly(service: str) -> None:
    module = f"safedpa_services.{service}" + (".__main__" if service in MAINS else "")
    allowed = {"rerun"} if service == "dashboard" else set()
    assert not (HEAVY - allowed) & loaded_by(module)


def test_the_robot_starts_lightly() -> None:
    assert not HEAVY & loaded_by("safedpa_sim.robots.__main__")


def test_who_asks_for_settings_loads_no_filter_and_who_drives_a_car_no_other_robot_s_effects() -> None:
    """Six processes start at once, and the robot waits for the last of them."""
    code = (
        "import sys, safedpa.safety; from safedpa.dynamics import load_model; load_model('car');"
        "from safedpa.safety.defaults import settings_named; settings_named('car');"
        "from safedpa.effects import effect; effect('car', 'payload');"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "safedpa.robots.car.effects.forces" in loaded
    assert not {name for name in loaded if ".pendulum.effects" in name or ".point.effects" in name}
    assert not {"safedpa.safety.solver.sqp", "safedpa.safety.checks.check_filter", "rich", "subprocess"} & loaded


def test_what_draws_is_loaded_where_something_is_drawn() -> None:
    loaded = loaded_by("safedpa_services.command_line.up, safedpa_services.supervisor.screen")
    assert "rich" not in loaded


def test_what_a_package_names_is_there_whichever_module_was_loaded_first() -> None:
    code = (
        "import safedpa.safety.checks.check_filter, safedpa.safety.filter, safedpa.safety as safety;"
        "assert callable(safety.check_filter) and set(safety.__all__) <= set(dir(safety));"
        "from safedpa.safety import *;"
        "assert SafetyFilter is safety.SafetyFilter"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
