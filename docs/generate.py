"""Writes the generated parts of the pages beside it: ``python docs/generate.py``; ``--check`` only compares.

A generated part stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from pathlib import Path

from safedpa.adaptation import AdaptationNode
from safedpa.bus import STATE, TOPICS, AbstractNode, Message, messages
from safedpa.policy import PolicyNode
from safedpa.safety.node import SafetyFilterNode

NODES: tuple[type[AbstractNode], ...] = (AdaptationNode, PolicyNode, SafetyFilterNode)
PAGES = Path(__file__).parent
BLOCK = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
OBSERVERS = ("recorder", "dashboard")


def topics() -> str:
    """The table of topics."""
    rows = [
        "| topic | key | message | written by | read by | delivery | largest age |",
        "|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS.values():
        service = "/{service}" if topic.writer == "*" else ""
        readers = [node.name for node in NODES if topic is STATE or topic in node.inputs]
        readers += ["robot"] if topic.name == "action" else []
        rows.append(
            f"| {topic.name} | `safedpa/{{fleet}}/{{robot}}/{topic.name}{service}` | `{topic.message.__name__}` "
            f"| {'every service' if topic.writer == '*' else topic.writer} | {', '.join((*readers, *OBSERVERS))} "
            f"| {topic.delivery} | {topic.largest_age_ticks} ticks |"
        )
    return "\n".join(rows)


def flow() -> str:
    """The data flow of one tick, as a mermaid figure."""
    lines = ["```mermaid", "flowchart LR"]
    for node in NODES:
        lines.append(f"    robot -- state --> {node.name}")
        for topic in node.inputs:
            lines.append(f"    {topic.writer} -- {topic.name} --> {node.name}")
    lines.append("    safety_filter -- action --> robot")
    lines.append("    safety_filter -. verdict .-> observers[recorder, dashboard: read everything, write no command]")
    return "\n".join([*lines, "```"])


def fields() -> str:
    """Every message with its fields, types and meaning."""
    tree = ast.parse(inspect.getsource(messages))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    kinds: list[type[Message]] = [Message, *(topic.message for topic in TOPICS.values())]
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


GENERATED = {"topics": topics, "flow": flow, "fields": fields}


def renewed(text: str) -> str:
    """The page with its generated parts made anew."""
    return BLOCK.sub(lambda found: f"{found[1]}{GENERATED[found[2]]()}\n{found[3]}", text)


def main() -> int:
    """Writes what is out of date; with ``--check`` only names it and returns 1."""
    stale = [page for page in sorted(PAGES.glob("*.md")) if renewed(page.read_text("utf-8")) != page.read_text("utf-8")]
    for page in stale:
        if "--check" in sys.argv:
            sys.stderr.write(f"docs/{page.name} is out of date; run python docs/generate.py\n")
        else:
            page.write_text(renewed(page.read_text("utf-8")), "utf-8")
    return int(bool(stale) and "--check" in sys.argv)


if __name__ == "__main__":
    sys.exit(main())
