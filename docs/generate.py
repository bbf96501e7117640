"""Writes the generated parts of the pages next to it: ``python docs/generate.py``; ``--check`` only compares.

A generated part stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import click
from click.testing import CliRunner

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    STATE,
    TOPICS,
    AbstractNode,
    Answer,
    ComputedMessage,
    Message,
    Request,
    RosterEntry,
    Topic,
)
from safedpa.bus.logging import KINDS
from safedpa.bus.messages import messages, requests
from safedpa.bus.security.access_control import ROLES, may_write
from safedpa.limits import TABLE
from safedpa.live.node import DiagnosisNode
from safedpa.perception.node import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa_lab.experiments.pendulum import report as pendulum_report
from safedpa_lab.experiments.point import relinearised as point_relinearised_report
from safedpa_lab.experiments.point import report as point_report
from safedpa_services.command_line.group import safedpa
from safedpa_services.metrics.exporter import FAMILIES

sys.path.insert(0, str(Path(__file__).parent))
from asyncapi import document

LOOP: tuple[type[AbstractNode], ...] = (AdaptationNode, PolicyNode, SafetyFilterNode)
NODES = (*LOOP, PerceptionNode, DiagnosisNode)
PAGES = Path(__file__).parent
BLOCK = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
OBSERVERS = ("recorder", "dashboard", "workbench")


def topics() -> str:
    """The table of topics."""
    rows = [
        "| topic | key | message | written by | read by | delivery | largest age |",
        "|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS.values():
        service = "/{service}" if topic.per_service else ""
        readers = [
            node.name for node in NODES if topic is STATE or topic in (*node.inputs, *node.sensor_inputs, *node.listens)
        ]
        readers += ["robot"] if topic.name == "action" else []
        rows.append(
            f"| {topic.name} | `safedpa/{{fleet}}/{{robot}}/{topic.name}{service}` | `{topic.message.__name__}` "
            f"| {'every service' if topic.per_service else topic.writer} | {', '.join((*readers, *OBSERVERS))} "
            f"| {topic.delivery} | {_largest_age(topic)} |"
        )
    return "\n".join(rows)


def _largest_age(topic: Topic) -> str:
    """A decision is heard however late it comes; what belongs to a tick grows stale."""
    heard = topic.delivery == "all" and any(topic in node.listens for node in NODES)
    return "any" if heard else f"{topic.largest_age_ticks} ticks"


def flow() -> str:
    """The data flow of one tick, as a mermaid figure."""
    lines = ["```mermaid", "flowchart LR"]
    for node in LOOP:
        lines.append(f"    robot -- state --> {node.name}")
        for topic in node.inputs:
            lines.append(f"    {topic.writer} -- {topic.name} --> {node.name}")
    lines.append("    safety_filter -- action --> robot")
    lines.append("    safety_filter -. verdict .-> observers[recorder, dashboard: read everything, write no command]")
    lines.append("    safety_filter -. verdict .-> diagnosis")
    lines.append("    diagnosis -. model .-> loop[adaptation, policy, safety_filter]")
    lines.append("    loop -. takeover .-> diagnosis")
    return "\n".join([*lines, "```"])


def fields() -> str:
    """Every message with its fields, types and meaning."""
    return _fields_of([Message, ComputedMessage, *(topic.message for topic in TOPICS.values()), RosterEntry], messages)


def roles() -> str:
    """Who may do what on a secured bus, from the table of roles and the writer column."""
    rows = ["| role | writes | reads | asks | answers |", "|---|---|---|---|---|"]
    for role in ROLES.values():
        own = f"/{role.name}"
        writes = [
            topic.name + (own if topic.per_service else "") for topic in TOPICS.values() if may_write(role, topic)
        ]
        reads = "everything" if set(role.reads) == set(TOPICS.values()) else ", ".join(t.name for t in role.reads)
        name = "robot.NAME (its own topics alone)" if role.name == "robot" else role.name
        rows.append(
            f"| {name} | {', '.join(writes) or '-'} | {reads} | {', '.join(role.asks) or '-'} "
            f"| {', '.join(role.answers) or '-'} |"
        )
    return "\n".join(rows)


def asked() -> str:
    """Requests and answers with their fields."""
    return _fields_of([Request, Answer, requests.LeaseRequest, requests.LeaseAnswer], requests)


def events() -> str:
    """Every kind of event, in the order of the catalogue."""
    rows = ["| kind | what happened |", "|---|---|"]
    return "\n".join([*rows, *(f"| `{kind}` | {meaning} |" for kind, meaning in KINDS.items())])


def limits() -> str:
    """The table of limits."""
    rows = ["| limit | at most | of | since |", "|---|---|---|---|"]
    rows += [f"| `{item.name}` | {item.value:,} | {item.of} | {item.why} |" for item in TABLE.values()]
    return "\n".join(rows)


def metrics() -> str:
    """Every metric."""
    rows = ["| metric | type | labels | meaning |", "|---|---|---|---|"]
    for name, family in FAMILIES.items():
        rows.append(f"| `{name}` | {family.kind} | {', '.join(family.labels)} | {family.meaning} |")
    return "\n".join(rows)


def commands() -> str:
    """Every command with the first sentence of its help."""
    rows = ["| command | what it does |", "|---|---|"]
    context = click.Context(safedpa)
    for name in safedpa.list_commands(context):
        rows.append(f"| `safedpa {name}` | {_first_sentence(safedpa.get_command(context, name))} |")
    return "\n".join(rows)


def effects_library() -> str:
    """The tables of all effects, as ``safedpa effects --markdown`` prints them."""
    return CliRunner().invoke(safedpa, ["effects", "--markdown"], catch_exceptions=False).output.strip()


def _first_sentence(command: click.Command) -> str:
    help_text = " ".join((command.help or "").split("\n\n")[0].split())
    return help_text.split(". ")[0].rstrip(".").replace("|", "\\|")


def _fields_of(kinds: list[type], module: ModuleType) -> str:
    tree = ast.parse(inspect.getsource(module))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    parts = []
    for kind in kinds:
        rows = [
            f"**{kind.__name__}**: {inspect.cleandoc(kind.__doc__ or '')}",
            "",
            "| field | type | meaning |",
            "|---|---|---|",
        ]
        body = classes[kind.__name__].body
        for node, following in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                default = f", default `{ast.unparse(node.value)}`" if node.value else ""
                meaning = _text(following).replace("|", "\\|").replace("``", "`")
                rows.append(f"| `{node.target.id}` | {ast.unparse(node.annotation)}{default} | {meaning} |")
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _text(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return " ".join(node.value.value.split())
    return ""


def _of_result(name: str, *tables: Callable[[Mapping[str, Any]], str]) -> Callable[[], str]:
    """Tables of a file of results, as the command that made it writes them."""

    def made() -> str:
        result = json.loads((PAGES / "evidence" / "results" / f"{name}.json").read_text(encoding="utf-8"))
        return "\n\n".join(table(result) for table in tables)

    return made


def _pendulum() -> str:
    """Both questions of the pendulum, each filter with its own margin."""
    parts = pendulum_report.balancing_table, pendulum_report.hazard_table
    return _of_result("pendulum", *(lambda result, part=part: part(result, "own") for part in parts))()


GENERATED = {
    "commands": commands,
    "effects_library": effects_library,
    "topics": topics,
    "flow": flow,
    "fields": fields,
    "asked": asked,
    "events": events,
    "limits": limits,
    "metrics": metrics,
    "pendulum_own": _pendulum,
    "point_own": _of_result("point", lambda result: point_report.short_table(result, "methods")),
    "relinearised_rows": _of_result("relinearised", point_relinearised_report.rows_table),
    "roles": roles,
}


def renewed(text: str) -> str:
    """The page with its generated parts made again."""
    return BLOCK.sub(lambda found: f"{found[1]}{GENERATED[found[2]]()}\n{found[3]}", text)


def main() -> int:
    """Writes what is out of date; with ``--check`` only names it and returns 1."""
    stale = [
        page for page in sorted(PAGES.rglob("*.md")) if renewed(page.read_text("utf-8")) != page.read_text("utf-8")
    ]
    for page in stale:
        if "--check" in sys.argv:
            sys.stderr.write(f"docs/{page.relative_to(PAGES)} is out of date; run python docs/generate.py\n")
        else:
            page.write_text(renewed(page.read_text("utf-8")), "utf-8")
    described = PAGES / "reference" / "asyncapi.json"
    if not described.is_file() or described.read_text("utf-8") != document():
        stale.append(described)
        if "--check" in sys.argv:
            sys.stderr.write("docs/reference/asyncapi.json is out of date; run python docs/generate.py\n")
        else:
            described.write_text(document(), "utf-8")
    return int(bool(stale) and "--check" in sys.argv)


if __name__ == "__main__":
    sys.exit(main())
