"""A column map for a log of topics, proposed from what its topics hold; a person looks at it before it is used."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence

from safedpa.limits import printable
from safedpa.records.column_map.column_map import DERIVATIONS
from safedpa.records.readers.bags.topics import HEADER, RECEIPT, AbstractLog, LoggedTopic, split_source
from safedpa.systems import System

__all__ = ["best_system", "propose_map", "propose_sources", "sources_of"]

_WINDOW = 0.1
"""s over which a slope is taken that the proposal derives."""
_PATHS: Mapping[str, tuple[str, ...]] = {
    "x": ("pose.pose.position.x", "pose.position.x", "transform.translation.x", "vehicle_local_position:x"),
    "y": ("pose.pose.position.y", "pose.position.y", "transform.translation.y", "vehicle_local_position:y"),
    "yaw": (
        "pose.pose.orientation", "pose.orientation", "transform.rotation", "vehicle_local_position:heading",
    ),
    "speed": ("twist.twist.linear.x", "state.speed"),
    "yaw_rate": ("twist.twist.angular.z", "angular_velocity.z"),
    "target_speed": ("drive.speed", "speed", "twist.linear.x", "linear.x"),
    "target_yaw_rate": ("twist.angular.z", "angular.z"),
    "steer": ("drive.steering_angle", "steering_angle", "actuator_servos:control[0]"),
    "throttle": ("actuator_motors:control[0]",),
    "angle": ("position[0]",),
    "rate": ("velocity[0]",),
    "torque": ("effort[0]",),
}  # fmt: skip
"""Fields in which messages of ROS and PX4 carry a quantity, the likeliest first."""
_TEXT: Mapping[str, tuple[str, ...]] = {
    "throttle": ("throttle", "motor", "duty"),
    "steer": ("steering", "steer", "servo"),
    "target_speed": ("target_speed", "speed_cmd", "cmd_speed", "v_ref"),
    "torque": ("torque", "effort"),
    "angle": ("angle",),
    "rate": ("rate",),
}
"""Words in the names of topics that carry one number."""
_FLIPPED = ("vehicle_local_position:y", "vehicle_local_position:heading")
"""PX4 counts y to the right and yaw clockwise."""
_MOST_FIELDS = 40
"""Fields of a topic that are listed."""


def sources_of(topics: Iterable[LoggedTopic], *, clocks: bool = False) -> list[str]:
    """Every raw column of a log's topics, those of the topics with the most messages first; ``clocks``: and times."""
    ordered = sorted((topic for topic in topics if topic.count), key=lambda topic: (-topic.count, topic.name))
    return [
        f"{topic.name}:{path}" for topic in ordered for path in (*topic.fields, *(_clocks(topic) if clocks else ()))
    ]


def _clocks(topic: LoggedTopic) -> tuple[str, ...]:
    stamped = "header.stamp" in topic.fields or "timestamp" in topic.fields
    return (HEADER, RECEIPT) if stamped else (RECEIPT,)


def propose_sources(targets: Sequence[str], sources: Sequence[str]) -> dict[str, str]:
    """Raw columns for quantities, as far as their fields or topics say what they hold; each once.

    A quantity is rather taken from a topic that already gives another one.
    """
    found: dict[str, str] = {}
    for target in targets:
        free = [source for source in sources if source not in found.values()]
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
    for word in _TEXT.get(target, ()):
        same = [source for source in single if word in split_source(source)[0].lower()]
        if same:
            return sorted(same, key=len)
    return []


def best_system(systems: Sequence[System], sources: Sequence[str]) -> System:
    """The set of states and actions of which the log shows the most."""
    return max(systems, key=lambda one: len(propose_sources((*one.state_names, *one.action_names), sources)))


def propose_map(log: AbstractLog, system: System, others: Sequence[System] = ()) -> str:
    """A column map as TOML, with the log's topics, rates and fields as comments before it.

    ``others``: sets of states and actions of the same robot; what they have besides stands there as comments.
    """
    topics = log.topics()
    found = propose_sources((*system.state_names, *system.action_names), sources_of(topics.values()))
    lines = [f"# Proposed for {_plain(log.path.name)}, a {log.kind}; look at every line before you believe it.", "#"]
    for topic in topics.values():
        lines += _described(topic)
    lines += ["", "format = 1", f'robot = "{system.name}"', "", "[columns]"]
    first = next((found[name] for name in system.state_names if name in found), "")
    if first:
        stamped = "header.stamp" in topics[split_source(first)[0]].fields or log.kind.startswith("PX4")
        clock = "header" if stamped else "receipt"
        lines.append(
            f't = {{ topic = "{split_source(first)[0]}", clock = "{clock}" }}   # a row for each of its messages'
        )
    else:
        lines.append('# t = { topic = "/...", clock = "receipt" }   # a row for each message of this topic')
    names = (*system.state_names, *system.action_names)
    lines += [_line(name, system, found) for name in names]
    for other in others:
        lines += _besides(other, names, found, sources_of(topics.values()))
    return "\n".join(lines) + "\n"


def _besides(other: System, names: Sequence[str], found: Mapping[str, str], sources: Sequence[str]) -> list[str]:
    more = [name for name in (*other.state_names, *other.action_names) if name not in names]
    given = propose_sources(more, [source for source in sources if source not in found.values()])
    taken = ", ".join(name for name in names if name not in (*other.state_names, *other.action_names))
    return [f"# {_line(name, other, given)}, for a model that wants it in place of {taken}" for name in given]


def _line(name: str, system: System, found: Mapping[str, str]) -> str:
    unit = {variable.name: variable.unit for variable in (*system.state, *system.action)}[name]
    derivation = next((how for how, (target, _) in DERIVATIONS.items() if target == name), "")
    if name in found:
        topic, path = split_source(found[name])
        parts = [f'topic = "{_plain(topic)}"', f'field = "{path}"']
        parts += ["flip = true"] if found[name] in _FLIPPED else []
        return f"{name} = {{ {', '.join(parts)} }}   # {unit}"
    if derivation:
        return f'{name} = {{ derive = "{derivation}", window = {_WINDOW} }}   # {unit}; no topic measures it'
    return f'# {name} = {{ topic = "/...", field = "..." }}   # {unit}: no topic looks like it; choose from above'


def _described(topic: LoggedTopic) -> list[str]:
    rate = f"{topic.rate:.3g} Hz" if topic.rate else "no rate"
    head = f"# {_plain(topic.name)}   {_plain(topic.type)}, {topic.count} messages, {rate}"
    if topic.problem:
        return [head, f"#     cannot be read: {_plain(topic.problem)}"]
    fields = list(topic.fields)
    more = [f"and {len(fields) - _MOST_FIELDS} more"] if len(fields) > _MOST_FIELDS else []
    phrase = ", ".join(_shortened(fields)[:_MOST_FIELDS] + more)
    return [head, *textwrap.wrap(phrase, 118, initial_indent="#     ", subsequent_indent="#     ")]


def _shortened(fields: Sequence[str]) -> list[str]:
    """Long arrays as their first and last."""
    short: list[str] = []
    for path in fields:
        index = re.search(r"\[(\d+)\]", path)
        if index and int(index[1]) > 0 and short and short[-1].split("[")[0] == path.split("[")[0]:
            short[-1] = f"{path.split('[')[0]}[0..{index[1]}]{path[index.end() :]}"
        else:
            short.append(path)
    return list(dict.fromkeys(short))


def _plain(text: str) -> str:
    """For a comment or a string of TOML: nothing that ends either."""
    return printable(text, but='"\\')
