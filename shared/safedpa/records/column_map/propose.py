"""Proposes a column map for a log of topics from its fields and topic names; the user must check it."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence

from safedpa.errors import InputError
from safedpa.limits import printable
from safedpa.records.column_map.column_map import DERIVATIONS
from safedpa.records.readers.bags.timeline import place_messages
from safedpa.records.readers.bags.topics import HEADER, RECEIPT, AbstractLog, LoggedTopic, split_source
from safedpa.systems import System

__all__ = ["COMMANDED", "MEASURED", "best_system", "propose_map", "propose_sources", "sources_of"]

_WINDOW = 0.1
"""Window for derived states in a proposal, s."""
_PATHS: Mapping[str, tuple[str, ...]] = {
    "x": ("pose.pose.position.x", "pose.position.x", "transform.translation.x", "vehicle_local_position:x"),
    "y": ("pose.pose.position.y", "pose.position.y", "transform.translation.y", "vehicle_local_position:y"),
    "yaw": (
        "pose.pose.orientation", "pose.orientation", "transform.rotation", "vehicle_local_position:heading",
    ),
    "speed": ("twist.twist.linear.x", "state.speed", "twist.linear.x", "linear.x"),
    "turn_rate": ("twist.twist.angular.z", "angular_velocity.z", "twist.angular.z", "angular.z"),
    "target_speed": ("drive.speed", "speed", "twist.linear.x", "linear.x"),
    "target_turn_rate": ("twist.angular.z", "angular.z"),
    "steer": ("drive.steering_angle", "steering_angle", "actuator_servos:control[0]"),
    "throttle": ("actuator_motors:control[0]",),
    "angle": ("position[0]",),
    "rate": ("velocity[0]",),
    "torque": ("effort[0]",),
}  # fmt: skip
"""Fields of ROS and PX4 messages that contain a quantity, the most common first."""
_TOPIC_KEYWORDS: Mapping[str, tuple[str, ...]] = {
    "throttle": ("throttle", "motor", "duty"),
    "steer": ("steering", "steer", "servo"),
    "target_speed": ("target_speed", "speed_cmd", "cmd_speed", "v_ref"),
    "speed": ("speed", "velocity"),
    "torque": ("torque", "effort"),
    "angle": ("angle",),
    "rate": ("rate",),
}
"""Words in the names of topics with a single number."""
COMMANDED = re.compile(r"cmd|command|target|desired|setpoint|reference|nominal|_ref\b|/ref\b|goal", re.IGNORECASE)
"""Names of topics and columns with commands, not measurements."""
MEASURED = ("speed", "turn_rate", "rate", "angle")
"""Quantities whose fields commands also have."""
_FLIPPED = ("vehicle_local_position:y", "vehicle_local_position:heading")
"""PX4 has y to the right and yaw clockwise, so the sign is flipped."""
_MAX_FIELDS = 40
"""Number of fields that are listed for a topic."""


def sources_of(topics: Iterable[LoggedTopic], *, clocks: bool = False) -> list[str]:
    """Lists the raw columns of all topics, those with most messages first; with ``clocks`` also their times."""
    ordered = sorted((topic for topic in topics if topic.count), key=lambda topic: (-topic.count, topic.name))
    return [
        f"{topic.name}:{path}" for topic in ordered for path in (*topic.fields, *(_clocks(topic) if clocks else ()))
    ]


def _clocks(topic: LoggedTopic) -> tuple[str, ...]:
    stamped = "header.stamp" in topic.fields or "timestamp" in topic.fields
    return (HEADER, RECEIPT) if stamped else (RECEIPT,)


def propose_sources(targets: Sequence[str], sources: Sequence[str]) -> dict[str, str]:
    """Guesses a raw column for each quantity from fields and topic names; uses each column at most once.

    Topics that already supply another quantity are preferred.
    """
    found: dict[str, str] = {}
    for target in targets:
        free = [source for source in sources if source not in found.values()]
        if target in MEASURED:
            free = [source for source in free if not COMMANDED.search(split_source(source)[0])]
        elif target.startswith("target_"):
            free.sort(key=lambda source: not COMMANDED.search(split_source(source)[0]))
        candidates = _by_path(target, free) or _by_topic(target, free)
        if candidates:
            used = {split_source(source)[0] for source in found.values()}
            found[target] = next((one for one in candidates if split_source(one)[0] in used), candidates[0])
    return found


def _by_path(target: str, sources: Sequence[str]) -> list[str]:
    for wanted in _PATHS.get(target, ()):
        same = [source for source in sources if wanted in (source, split_source(source)[1])]
        if same:
            return same
    return []


def _by_topic(target: str, sources: Sequence[str]) -> list[str]:
    single = [source for source in sources if split_source(source)[1] == "data"]
    for word in _TOPIC_KEYWORDS.get(target, ()):
        same = [source for source in single if word in split_source(source)[0].lower()]
        if same:
            return sorted(same, key=len)
    return []


def best_system(systems: Sequence[System], sources: Sequence[str]) -> System:
    """The system for which the log has most of the states and actions."""
    return max(systems, key=lambda one: len(propose_sources((*one.state_names, *one.action_names), sources)))


def propose_map(log: AbstractLog, system: System, others: Sequence[System] = ()) -> str:
    """Returns a column map as TOML, preceded by comments with the topics, rates and fields of the log.

    ``others`` are variants of the robot; columns for their additional states and actions are added as comments.
    """
    topics = log.topics()
    found = propose_sources((*system.state_names, *system.action_names), sources_of(topics.values()))
    lines = [f"# Proposed for {_toml_safe(log.path.name)}, a {log.kind}; check every line before you use it.", "#"]
    for topic in topics.values():
        lines += _topic_comment(topic)
    lines += ["", "format = 1", f'robot = "{system.name}"', "", "[columns]"]
    first = next((found[name] for name in system.state_names if name in found), "")
    if first:
        clocked = split_source(first)[0]
        stamped = "header.stamp" in topics[clocked].fields or log.kind.startswith("PX4")
        clock, reason = _clock_that_works(log, clocked, found.values()) if stamped else ("receipt", "")
        lines.append(
            f't = {{ topic = "{_toml_safe(clocked)}", clock = "{clock}" }}   # a row for each of its messages{reason}'
        )
    else:
        lines.append('# t = { topic = "/...", clock = "receipt" }   # a row for each message of this topic')
    names = (*system.state_names, *system.action_names)
    lines += [_map_line(name, system, found) for name in names]
    for other in others:
        lines += _alternatives(other, names, found, sources_of(topics.values()))
    return "\n".join(lines) + "\n"


def _clock_that_works(log: AbstractLog, topic: str, sources: Iterable[str]) -> tuple[str, str]:
    """The clock for the rows: the stamps, unless they are missing, or on another clock than those of other topics."""
    wanted: dict[str, tuple[str, ...]] = {topic: ()}
    for source in sources:
        name, path = split_source(source)
        wanted[name] = (*wanted.get(name, ()), path)
    before = len(log.findings)
    try:
        found = log.series(wanted)
        if found[topic].stamp is None:
            return "receipt", "; its stamps are 0"
        _, findings = place_messages(log.path, found, topic, HEADER)
        bad = sum(one.count for one in findings if one.kind == "bad_stamp" and one.message.startswith(f"{topic}:"))
        if 2 * bad > len(found[topic].receipt):
            return "receipt", "; most of its stamps are wrong"
    except InputError:
        return "receipt", "; the stamps of the topics are of two clocks"
    finally:
        del log.findings[before:]
    return "header", ""


def _alternatives(other: System, names: Sequence[str], found: Mapping[str, str], sources: Sequence[str]) -> list[str]:
    more = [name for name in (*other.state_names, *other.action_names) if name not in names]
    given = propose_sources(more, [source for source in sources if source not in found.values()])
    taken = ", ".join(name for name in names if name not in (*other.state_names, *other.action_names))
    return [f"# {_map_line(name, other, given)}, for a model that has it in place of {taken}" for name in given]


def _map_line(name: str, system: System, found: Mapping[str, str]) -> str:
    unit = {variable.name: variable.unit for variable in (*system.state, *system.action)}[name]
    derivation = next((how for how, (target, _) in DERIVATIONS.items() if target == name), "")
    if name in found:
        topic, path = split_source(found[name])
        parts = [f'topic = "{_toml_safe(topic)}"', f'field = "{path}"']
        parts += ["flip = true"] if found[name] in _FLIPPED else []
        return f"{name} = {{ {', '.join(parts)} }}   # {unit}"
    if derivation:
        return f'{name} = {{ derive = "{derivation}", window = {_WINDOW} }}   # {unit}; no topic measures it'
    return f'# {name} = {{ topic = "/...", field = "..." }}   # {unit}: no topic matches; choose one from above'


def _topic_comment(topic: LoggedTopic) -> list[str]:
    rate = f"{topic.rate:.3g} Hz" if topic.rate else "no rate"
    head = f"# {_toml_safe(topic.name)}   {_toml_safe(topic.type)}, {topic.count} messages, {rate}"
    if topic.problem:
        return [head, f"#     cannot be read: {_toml_safe(topic.problem)}"]
    fields = list(topic.fields)
    more = [f"and {len(fields) - _MAX_FIELDS} more"] if len(fields) > _MAX_FIELDS else []
    phrase = ", ".join(_short_field_list(fields)[:_MAX_FIELDS] + more)
    return [head, *textwrap.wrap(phrase, 118, initial_indent="#     ", subsequent_indent="#     ")]


def _short_field_list(fields: Sequence[str]) -> list[str]:
    """Shortens arrays to their index range."""
    short: list[str] = []
    for path in fields:
        index = re.search(r"\[(\d+)\]", path)
        if index and int(index[1]) > 0 and short and short[-1].split("[")[0] == path.split("[")[0]:
            short[-1] = f"{path.split('[')[0]}[0..{index[1]}]{path[index.end() :]}"
        else:
            short.append(path)
    return list(dict.fromkeys(short))


def _toml_safe(text: str) -> str:
    """Makes a text safe inside a TOML comment or string."""
    return printable(text, but='"\\')
