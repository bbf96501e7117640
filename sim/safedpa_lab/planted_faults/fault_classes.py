"""Faults that a developer makes, by class: the places where each could stand are found in the syntax tree.

A class says what its fault is, in which folders it could stand, which words a place's statement or function must
contain, and how a node of the tree changes. No line is named anywhere: what is written tomorrow is looked at as well.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from safedpa_lab.planted_faults.ast_changes import (
    dropped,
    everything_used,
    field_left_out,
    guard_gone,
    later_wins,
    longer,
    miscounted,
    not_durable,
    not_ended,
    one_ahead,
    other_extreme,
    spread,
    turned,
    unit_lost,
)
from safedpa_lab.planted_faults.interfaces import PRODUCT, handed_over, interfaces_of

Change = Callable[[ast.AST], Iterator[ast.AST]]


def assigned(statement: ast.AST) -> str:
    """The name that a statement alone gives a value; empty where it is no such statement."""
    match statement:
        case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr()):
            return name
    return ""


@dataclass(frozen=True)
class FaultClass:
    """One kind of fault.

    :param name: short, as in the record.
    :param where: globs of files, from the root.
    :param words: regular expression that the names of the function and its class, or the statement, must match.
    :param changes: what a node of the tree may become.
    :param derived: changes that depend on the whole product below a root.
    """

    name: str
    where: tuple[str, ...]
    phrase: str
    changes: tuple[Change, ...]
    derived: Callable[[Path], tuple[Change, ...]] = lambda _: ()


SAFETY, DIAGNOSIS = "shared/safedpa/safety/**/*.py", "shared/safedpa/diagnosis/**/*.py"
BUS, SERVICES = "shared/safedpa/bus/**/*.py", "services/safedpa_services/**/*.py"
LABORATORY, SIMULATION = "sim/safedpa_lab/experiments/**/*.py", "sim/safedpa_sim/**/*.py"
MARGINS = tuple(
    f"shared/safedpa/{part}/*.py" for part in ("safety/margins", "calibration", "safety/prediction", "runtime")
)
RECORDS, LIVE = "shared/safedpa/records/**/*.py", "shared/safedpa/live/*.py"
COMPARE, FLEET, REPLAY = "shared/safedpa/comparison/*.py", "shared/safedpa/fleet/*.py", "shared/safedpa/replay/*.py"
ADAPTATION = "shared/safedpa/adaptation/*.py"

HANDED_OVER = "handed over"
"""Name of the class of faults at the interfaces between modules."""


def _hand_overs(root: Path) -> tuple[Change, ...]:
    return (partial(handed_over, known=interfaces_of(root)),)


CLASSES: tuple[FaultClass, ...] = (
    FaultClass("sign of an error over the margin", (*MARGINS, LIVE), r"error|margin|watch|shift|excess|gap", (turned,)),
    FaultClass(
        "watched while something else drives",
        (*MARGINS, LIVE, ADAPTATION, SAFETY, SERVICES),
        r"watchdog|guard|applied|driv|stale|fresh|fallback|paus|stand",
        (guard_gone,),
    ),
    FaultClass(
        "the smaller of two margins", (*MARGINS, SAFETY, LIVE), r"margin|quantile|widen|allow", (other_extreme,)
    ),
    FaultClass(
        "a step ahead in calibration",
        (*MARGINS, ADAPTATION, COMPARE, "shared/safedpa/live/*.py"),
        r"latent|window|history|step|tick|calibrat|predict",
        (one_ahead,),
    ),
    FaultClass(
        "held-out rows used",
        (DIAGNOSIS, *MARGINS, COMPARE, FLEET),
        r"held|fold|split|train|left_out|calibrat|kept",
        (everything_used, guard_gone),
    ),
    FaultClass(
        "a standard error without its factor",
        (DIAGNOSIS, COMPARE, FLEET, LIVE, ADAPTATION, LABORATORY),
        r"standard|deviation|variance|spread|interval|uncertain|covariance|sqrt|std|ddof|quantile",
        (spread,),
    ),
    FaultClass(
        "a field that is no longer compared",
        (REPLAY, COMPARE),
        r"differ|compar|same|agree|field|equal",
        (field_left_out,),
    ),
    FaultClass(
        "a factor of units", (RECORDS, COMPARE, SAFETY, SERVICES, "shared/safedpa/ros/*.py"), r".", (unit_lost,)
    ),
    FaultClass(
        "a link that outlives its certificate",
        (
            "shared/safedpa/bus/security/*.py",
            "shared/safedpa/bus/transport/*.py",
            "services/safedpa_services/router/*.py",
            "services/safedpa_services/supervisor/certificate*.py",
        ),
        r"expir|certificate|until|valid|after|not_|link|key",
        (guard_gone, later_wins),
    ),
    FaultClass(
        "a message for another service",
        (BUS, "shared/safedpa/runtime/node.py", "shared/safedpa/adaptation/node.py", "shared/safedpa/policy/node.py"),
        r"sender|writer|source|robot|name|role|identity|fleet|foreign|subject",
        (guard_gone,),
    ),
    FaultClass(
        "older input displaces newer",
        (BUS, LIVE, SERVICES),
        r"tick|epoch|sequence|newe|latest|published|stamp|version",
        (later_wins,),
    ),
    FaultClass(
        "not made durable",
        (SERVICES, RECORDS, BUS, REPLAY, "shared/safedpa/dynamics/*.py", LIVE, FLEET),
        r"fsync|flush|replace|sync|write|durable|rename|save",
        (not_durable,),
    ),
    FaultClass(
        "a hung service is never killed",
        (
            "services/safedpa_services/supervisor/*.py",
            "shared/safedpa/bus/service/*.py",
            "shared/safedpa/api/deployment.py",
        ),
        r"kill|terminat|hung|hang|silent|heartbeat|restart|stop|dead|wait|beat|end",
        (not_ended, guard_gone, longer),
    ),
    FaultClass("patience ten times longer", (ADAPTATION, SAFETY, BUS, SERVICES, LIVE), r".", (longer,)),
    FaultClass(
        "miscounted in an experiment",
        (LABORATORY, "sim/safedpa_lab/faults/*.py"),
        r"collision|hit|contact|count|relaxed|below|violat|wrong|reached|sum|any",
        (miscounted,),
    ),
    FaultClass(
        "a bound that is not enforced",
        (SAFETY, RECORDS, BUS),
        r"raise|refus|bound|limit|finite|largest",
        (guard_gone, dropped),
    ),
    # What a constructor sets is missing at once: any test would notice.
    FaultClass(HANDED_OVER, PRODUCT, r"^(?!__init__ )", (), _hand_overs),
)


@dataclass(frozen=True)
class Fault:
    """One place and what it becomes."""

    kind: str
    """Name of its class."""
    path: str
    """Of the file, from the root."""
    line: int
    function: str
    """Qualified name of what it is in; empty in the module's own body."""
    before: str
    after: str
    first: int
    """Of the bytes that are replaced."""
    end: int
    """Behind them."""

    def planted(self, source: str) -> str:
        """The file with the fault; all but the place is as it was."""
        letters = source.encode()
        return (letters[: self.first] + self.after.encode() + letters[self.end :]).decode()


def faults_in(root: Path, kind: FaultClass) -> list[Fault]:
    """Every place where a fault of the class could stand, in the order of files and lines."""
    files = sorted({path for glob in kind.where for path in root.glob(glob) if not path.name.startswith("generated_")})
    makers = (*kind.changes, *kind.derived(root))
    return [fault for path in files for fault in _in_file(root, path, kind, makers)]


def _in_file(root: Path, path: Path, kind: FaultClass, makers: Sequence[Change]) -> Iterator[Fault]:
    source, phrase = path.read_text(encoding="utf-8"), re.compile(kind.phrase)
    letters = source.encode()
    starts = [0]
    for line in letters.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def text(node: ast.AST) -> tuple[int, int]:
        first = starts[getattr(node, "lineno", 1) - 1] + getattr(node, "col_offset", 0)
        return first, starts[getattr(node, "end_lineno", 1) - 1] + getattr(node, "end_col_offset", 0)

    seen = set[tuple[int, int, str]]()
    for node, statement, function in places(ast.parse(source)):
        changes = [change for make in makers for change in make(node)]
        notice = f"{function.rpartition('.')[2]} {letters[slice(*text(statement))].decode()}" if changes else ""
        if not phrase.search(notice.lower()):
            continue
        first, end = text(node)
        for change in changes:
            before, after = letters[first:end].decode(), written(change, node)
            if before != after and (first, end, after) not in seen:
                seen.add((first, end, after))
                where, row = str(path.relative_to(root)), getattr(node, "lineno", 1)
                yield Fault(kind.name, where, row, function, before, after, first, end)


def places(
    node: ast.AST, statement: ast.stmt | None = None, names: tuple[str, ...] = ()
) -> Iterator[tuple[ast.AST, ast.stmt, str]]:
    """Nodes, each with its innermost statement and the qualified name of the function or class around it.

    Annotations, decorators, formats and docstrings are left alone: no fault there changes what is computed.
    """
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "format_spec", "type_params"):
            continue
        for child in value if isinstance(value, list) else (value,):
            if not isinstance(child, ast.AST) or isinstance(child, (ast.JoinedStr, ast.expr_context, ast.alias)):
                continue
            if assigned(child).startswith("__"):  # what a module shows
                continue
            within = child if isinstance(child, ast.stmt) else statement
            if within is not None and hasattr(child, "lineno"):
                yield child, within, ".".join(names)
            inside = (*names, child.name) if isinstance(child, (ast.FunctionDef, ast.ClassDef)) else names
            yield from places(child, within, inside)


def written(change: ast.AST, node: ast.AST) -> str:
    """The change as it is in the file: what spans several lines keeps the indent of the place."""
    text = ast.unparse(ast.fix_missing_locations(change))
    if isinstance(node, ast.stmt):
        return text.replace("\n", "\n" + " " * node.col_offset)
    return f"({text})" if isinstance(change, (ast.BinOp, ast.BoolOp, ast.IfExp, ast.UnaryOp, ast.Compare)) else text
