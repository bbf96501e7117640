"""One filter, one h: who decides actions, who writes slopes of barriers, and who asks for the name of a robot."""

import ast
import importlib
import inspect
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

from safedpa.safety import AbstractBarrier, AbstractEquationBarrier

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("shared", "services", "sim")

DECIDERS = {
    "safedpa.safety.filter": "SafetyFilter",
    "safedpa.safety.compiled_decision": "its search in C",
    "safedpa.safety.batch.filter": "its batch",
    "safedpa.safety.session.filter_session": "a filter and what it remembers",
    "safedpa_lab.benchmarks.peers.filters": "peers, to compare with",
    "safedpa_lab.experiments.adversary.peer_filters": "peers",
    "safedpa_lab.experiments.adversary.bends": "asks SafetyFilter",
    "safedpa_lab.experiments.adversary.linear.problem": "asks SafetyFilter",
    "safedpa_lab.experiments.adversary.mirrors": "asks SafetyFilter",
    "safedpa_lab.point.relinearised": "asks PointFilter",
    "safedpa_sim.pendulum.policy_task": "asks BatchFilter",
    "safedpa_sim.point.filtering": "asks BatchFilter",
    "safedpa_sim.training.environments.car_task": "asks BatchFilter",
}
"""Modules with something that decides: a method ``decide``."""
CONDITIONS = {
    "safedpa.safety.solver.constraints": "poses it",
    "safedpa.safety.batch.filter": "poses it for many",
    "safedpa.safety.margins.error_clipping": "how far h may fall: measures errors",
    "safedpa.safety.checks.probes": "looks for states without an action",
    "safedpa_lab.theory.boundary_layer": "the theory's bound",
    "safedpa.safety.deadlock.escape": "how long a deadlock escape takes",
    "safedpa_lab.experiments.adversary.bends": "judges",
    "safedpa_lab.experiments.adversary.car_grid": "judges",
    "safedpa_lab.experiments.adversary.linear.judge": "judges",
    "safedpa_lab.experiments.adversary.peer_filters": "peers",
    "safedpa_lab.experiments.adversary.systems": "judges",
    "safedpa_lab.point.relinearised": "judges which decision to keep",
    "safedpa_lab.pendulum.invariance": "the largest set in which it can be kept",
}
"""Modules that write the condition's 1 - eta."""
OWN_SLOPES = {
    "AbstractEquationBarrier": "the recorder's",
    "DistanceFieldBarrier": "of the interpolation in a map",
    "FunctionBarrier": "what its user gives, else differences",
    "HigherOrderBarrier": "its user's derivatives",
    "LipschitzBarrier": "those of another barrier, and the length of a chord",
    "LookAheadBarrier": "those of another barrier, at another point",
    "RolloutBarrier": "by the model's sensitivity along a simulated path",
    "StoppingBarrier": "differences of a simulated manoeuvre",
}
"""Public barriers with slopes of their own, none of which is a formula for a gradient."""


def sources(*folders: str) -> Iterator[tuple[Path, ast.Module]]:
    for folder in folders or FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path, parsed(path)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts[1:])


def barrier_modules() -> set[str]:
    """Modules with a class whose bases lead to a barrier, by their names: importing all others would take 330 MB."""
    classes, aliases = list[tuple[str, set[str], str]](), list[tuple[str, str]]()
    for path, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                bases = {ast.unparse(base).partition("[")[0].rpartition(".")[2] for base in node.bases}
                classes.append((node.name, bases, module_of(path)))
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                aliases += [(name.name, name.asname) for name in node.names if name.asname]
            elif isinstance(node, ast.Assign) and isinstance(node.value, (ast.Name, ast.Attribute, ast.Subscript)):
                given = ast.unparse(node.value).partition("[")[0].rpartition(".")[2]
                aliases += [(given, target.id) for target in node.targets if isinstance(target, ast.Name)]
    names, before = {"AbstractBarrier"}, 0
    while len(names) > before:
        before = len(names)
        names |= {name for name, bases, _ in classes if bases & names}
        names |= {alias for name, alias in aliases if name in names}
    return {module for _, bases, module in classes if bases & names}


@pytest.fixture(scope="module")
def barriers() -> None:
    """Every module with a barrier in memory; what needs a program that is not there is left out."""
    for module in sorted(barrier_modules()):
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("safedpa"):
                raise


@pytest.mark.long
def test_nothing_else_decides_an_action() -> None:
    found = {
        module_of(path)
        for path, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.name == "decide"
    }
    assert found == set(DECIDERS)


def test_who_asks_a_filter_asks_it() -> None:
    """In a module that is reported to ask one every ``decide`` calls that filter's."""
    asking = {name: role.removeprefix("asks ") for name, role in DECIDERS.items() if role.startswith("asks ")}
    for path, tree in sources():
        kind = asking.get(module_of(path))
        if kind is None:
            continue
        assert any(isinstance(node, ast.Call) and ast.unparse(node.func).startswith(kind) for node in ast.walk(tree)), (
            path
        )
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.name == "decide":
                assert "decide" in _calls(node.body), path


def _calls(nodes: Iterable[ast.AST]) -> set[str]:
    calls = (node for part in nodes for node in ast.walk(part) if isinstance(node, ast.Call))
    return {ast.unparse(node.func).rpartition(".")[2] for node in calls}


def test_what_shelters_training_is_the_filter() -> None:
    """Wherever a condition asks whether robots are with_filter, what follows asks a filter, itself or by its own
    method.

    Who asks only whether to hand ``with_filter`` on, or puts it into a name, calls nothing that decides, and is no
    case.
    """
    seen = set()
    for path, tree in sources("sim"):
        methods = {node.name: node.body for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        for node in ast.walk(tree):
            if not isinstance(node, (ast.If, ast.IfExp)) or "with_filter" not in ast.unparse(node.test):
                continue
            follows = node.body if isinstance(node, ast.If) else [node.body]
            calls = _calls(follows)
            if not calls:
                continue
            within = calls.union(*(_calls(methods[name]) for name in calls if name in methods))
            assert "decide" in within, f"{path}:{node.lineno}"
            seen.add(module_of(path))
    assert seen == {
        "safedpa_sim.pendulum.policy_task",
        "safedpa_sim.point.policy_task",
        "safedpa_sim.training.environments.car_task",
    }


def test_nothing_else_poses_the_condition_of_a_barrier() -> None:
    found = set()
    for path, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and isinstance(node.left, ast.Constant):
                share = ast.unparse(node.right).rpartition(".")[2].strip("_").lower()
                if node.left.value == 1 and share == "eta":
                    found.add(module_of(path))
    assert found == set(CONDITIONS)


def subclasses(kind: type) -> Iterator[type]:
    for own in kind.__subclasses__():
        yield own
        yield from subclasses(own)


def test_no_barrier_but_the_recorders_writes_a_gradient(barriers: None) -> None:
    shipped = {one for one in subclasses(AbstractBarrier) if one.__module__.startswith(("safedpa.", "safedpa_"))}
    writing = {one.__name__ for one in shipped if {"h_and_grad", "lie_derivative", "grad_h"} & set(vars(one))}
    assert {name for name in writing if not name.startswith("_")} == set(OWN_SLOPES)


def test_an_equations_only_road_to_slopes_is_the_recorder(barriers: None) -> None:
    equations = {one for one in subclasses(AbstractEquationBarrier) if one.__module__.startswith("safedpa")}
    assert {one.__name__ for one in equations} >= {"ObstacleBarrier", "FieldBarrier", "SpeedBarrier", "CorridorBarrier"}
    for one in equations:
        assert not {"h", "h_and_grad", "starting_at"} & set(vars(one)), one
        assert list(inspect.signature(one.equation).parameters) == ["given", "operations"], one


def test_nothing_generic_names_a_robot_that_ships() -> None:
    found: dict[str, set[str]] = {}
    for path, tree in sources("shared", "services"):
        if "robots" in path.relative_to(ROOT).parts:
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in ("car", "pendulum", "point"):
                found.setdefault(str(path.relative_to(ROOT)), set()).add(str(node.value))
    assert not found
