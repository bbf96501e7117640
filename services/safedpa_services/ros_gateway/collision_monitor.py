"""Converts the parameters of Nav2's collision monitor to a robot file, and lists what is different afterwards.

Names and defaults of the parameters: docs.nav2.org/configuration/packages/configuring-collision-monitor.html.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import need
from safedpa.limits import file_of_at_most, readable
from safedpa.ros.sensor_messages import CLOUD, COSTMAP, POLYGON_INSTANCE, RANGE, covering_capsule
from safedpa_services.ros_gateway.sensor_tables import LASER

__all__ = ["Conversion", "convert_collision_monitor"]

_MOST_BYTES = 64 * 1024
"""A file with the parameters of all nodes of Nav2 has 15 KB."""
_SOURCE_TYPES: Final = {
    "scan": LASER, "pointcloud": CLOUD, "range": RANGE, "costmap": COSTMAP, "polygon": POLYGON_INSTANCE,
}  # fmt: skip
_ACTIONS: Final = ("stop", "slowdown", "limit", "approach")
_LONGEST_TIME_OUT = 1.0
_INSCRIBED, _LETHAL, _SCALED = 253, 254, 252
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_DROPPED = {
    "visualize": "zones are not published as polygons; the recording and the dashboard show the rays",
    "stop_pub_timeout": "commands are sent in every period, also while the robot is stopped",
    "simulation_time_step": "the filter predicts with the model of the robot",
}
"""Parameters without an equivalent, and what applies instead."""


@final
@dataclass
class Conversion:
    """The robot file as TOML, and one sentence for each difference."""

    text: str = ""
    differences: list[str] = field(default_factory=list)

    def differs(self, sentence: str) -> None:
        """Notes a difference, each once."""
        if sentence not in self.differences:
            self.differences.append(sentence)


def convert_collision_monitor(path: Path, robot: str = "differential_drive", endpoint: str = "") -> Conversion:
    """Converts the parameters of the collision monitor in a YAML file, alone or among those of other nodes.

    Raises InputError naming the parameter if the file cannot be read or contradicts itself.
    """
    try:
        given = _parameters(_loaded(path))
        found = Conversion()
        tables = _tables(given, found, robot, endpoint or "tcp/127.0.0.1:7447")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    found.text = _toml(tables, f"# Converted from {path.name}; check every line. Lengths in m, times in s.")
    return found


def _loaded(path: Path) -> Any:
    need("ros", what="reading YAML")
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        data = file_of_at_most(path, "yaml_bytes")
        if len(data) > _MOST_BYTES:
            raise InputError(f"got {len(data)} bytes, wanted {_MOST_BYTES} at most: the part of the collision monitor")
        if b"<<" in data:  # a few lines of merges can become gigabytes
            raise InputError("got a merge key '<<', wanted the parameters written out")
        return YAML(typ="safe").load(data.decode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({getattr(error, 'strerror', None) or 'not UTF-8'})") from error
    except (YAMLError, ValueError, RecursionError, AttributeError, TypeError, KeyError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else ""
        raise InputError(f"is not valid YAML{where}; wanted the parameters of a ROS 2 node") from error


def _parameters(table: Any, depth: int = 0) -> Mapping[str, Any]:
    """Parameters of the first node that has zones and sources."""
    if isinstance(table, dict) and depth < 4:
        own = table.get("ros__parameters")
        if isinstance(own, dict) and "polygons" in own and "observation_sources" in own:
            return own
        for inner in list(table.values())[:200]:
            found = _parameters(inner, depth + 1) if isinstance(inner, dict) else {}
            if found:
                return found
    if depth == 0:
        raise InputError("has no node with 'polygons' and 'observation_sources'; wanted those of the collision monitor")
    return {}


def _tables(given: Mapping[str, Any], found: Conversion, robot: str, endpoint: str) -> dict[str, Any]:
    command = "TwistStamped" if _flag(given, "enable_stamped_cmd_vel", False) else "Twist"
    if "enable_stamped_cmd_vel" not in given:
        found.differs("command.type: the file does not set enable_stamped_cmd_vel; Twist, as before Nav2 for Kilted")
    zones, footprint = _zones(given, found)
    sources, exclusions = _sources(given, found)
    names = [one["name"] for one in sources]
    for zone in zones:
        zone["sources"] = [one for one in zone.get("sources", names) if one in names] or names
    if not sources:
        raise InputError("observation_sources: got none that can be read, wanted at least one")
    if not _flag(given, "base_shift_correction", True):
        found.differs("base_shift_correction: points always follow the odometry")
    found.differs(
        "between the zones and the driver, the safety filter changes each command as little as its barriers need"
    )
    found.differs("collision_monitor/toggle: a service in Nav2, here the topic /collision_monitor/enable (Bool)")
    if not _flag(given, "enabled", True):
        found.differs("enabled: false switches off the zones; the filter stays on")
        zones = [{**zone, "enabled": False} for zone in zones]
    tables: dict[str, Any] = {
        "": {"format": 2, "robot": robot, "name": "r1"},
        "wire": {"endpoint": endpoint, "frame": _text(given, "odom_frame_id", "odom")},
        "odometry": {"topic": "/odom"},
        "nominal": {"topic": _topic(_text(given, "cmd_vel_in_topic", "cmd_vel_smoothed"))},
        "command": {
            "topic": _topic(_text(given, "cmd_vel_out_topic", "cmd_vel")), "type": f"geometry_msgs/msg/{command}",
        },
        "frames": {
            "base": _text(given, "base_frame_id", "base_footprint"),
            "largest_age": max(0.1, min(_number(given, "transform_tolerance", 0.1), 10.0)),
        },
        "surroundings": {"field": [-100.0, 100.0, -100.0, 100.0], "footprint": footprint["capsule"]},
        "monitor": {"enable": "/collision_monitor/enable"},
    }  # fmt: skip
    if footprint["topic"]:
        tables["footprint"] = {"topic": footprint["topic"]}
    elif not footprint["known"]:
        found.differs("surroundings.footprint: the file has none; enter yours, the disc of 0.25 m is a placeholder")
    if tables["wire"]["frame"] == "map":
        found.differs("odom_frame_id 'map': the odometry is in 'odom'; add [localisation] for the map")
        tables["wire"]["frame"] = "odom"
    if _text(given, "state_topic", ""):
        tables["monitor"]["state"] = _topic(_text(given, "state_topic", ""))
    if _flag(given, "use_sim_time", False):
        tables["clock"] = {"topic": "/clock"}
    tables.update({"sources": sources, "exclusions": exclusions, "zones": zones})
    for key, instead in _DROPPED.items():
        if any(key in part for part in (given, *(one for one in given.values() if isinstance(one, dict)))):
            found.differs(f"{key}: {instead}")
    return tables


def _zones(given: Mapping[str, Any], found: Conversion) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The zones, and what the approach zones say about the footprint."""
    zones: list[dict[str, Any]] = []
    footprint: dict[str, Any] = {"topic": "", "capsule": [0.0, 0.0, 0.25], "known": False}
    for name in _names(given, "polygons"):
        own = _table(given, name)
        action = _text(own, "action_type", "")
        action = {"slow": "slowdown"}.get(action, action)
        if action not in _ACTIONS:
            raise InputError(f"{name}.action_type: got '{readable(action)}'; {did_you_mean(action, _ACTIONS)}")
        if action == "approach":
            footprint = _approach(name, own, found, footprint)
        else:
            zones.append(_zone(name, own, action, found))
    return zones, footprint


def _approach(name: str, own: Mapping[str, Any], found: Conversion, footprint: dict[str, Any]) -> dict[str, Any]:
    found.differs(
        f"{name}: 'approach' is replaced by the filter, which predicts with the model, its delay and its brakes; "
        "time_before_collision and min_points do not count"
    )
    if _text(own, "type", "") == "circle":
        if "radius" not in own:
            found.differs(f"{name}: its radius comes from a topic, which no footprint can; enter the largest")
            return footprint
        return {**footprint, "capsule": [0.0, 0.0, _number(own, "radius", 0.25)], "known": True}
    points = _points(f"{name}.points", own.get("points"))
    if not points:
        return {**footprint, "topic": _topic(_text(own, "footprint_topic", "local_costmap/published_footprint"))}
    import numpy as np

    capsule = [round(value + 0.005, 2) for value in covering_capsule(np.array(points))]
    return {**footprint, "capsule": capsule, "known": True}


def _zone(name: str, own: Mapping[str, Any], action: str, found: Conversion) -> dict[str, Any]:
    zone: dict[str, Any] = {"name": _plain(name), "action": action, "min_points": _number(own, "min_points", 4)}
    if "max_points" in own:
        zone["min_points"] = _number(own, "max_points", 3) + 1
    zone.update(_shape(name, own, found))
    keys = {"slowdown": {"ratio": "slowdown_ratio"}, "limit": {"linear": "linear_limit", "angular": "angular_limit"}}
    for key, parameter in keys.get(action, {}).items():
        zone[key] = _number(own, parameter, 0.5)
    counts = {"trigger_after": "trigger_consecutive_points", "release_after": "release_consecutive_points"}
    zone.update({key: _number(own, parameter, 1) for key, parameter in counts.items() if parameter in own})
    if "sources_names" in own:
        zone["sources"] = [_plain(one) for one in _names(own, "sources_names")]
    zone["enabled"] = _flag(own, "enabled", True)
    zone["enable"] = f"/collision_monitor/{_plain(name)}/enable"
    found.differs("NAME.enabled: a parameter in Nav2, here the topic of the key 'enable' (Bool)")
    return {key: max(1, int(value)) if key in ("min_points", *counts) else value for key, value in zone.items()}


def _shape(name: str, own: Mapping[str, Any], found: Conversion) -> dict[str, Any]:
    kind = _text(own, "type", "")
    if kind not in ("polygon", "circle", "velocity_polygon"):
        found.differs(f"{name}: type '{readable(kind)}' is not one of Nav2's; read as a polygon")
    if kind == "circle":
        if "radius" in own:
            return {"radius": _number(own, "radius", 0.0)}
        topic = _text(own, "polygon_sub_topic", "")
        if not topic:
            raise InputError(f"{name}: got no radius and no polygon_sub_topic, wanted one of them")
        found.differs(f"{name}: until its radius arrives the robot is stopped, in Nav2 the zone does nothing")
        return {"radius_topic": _topic(topic)}
    if kind == "velocity_polygon":
        found.differs(f"{name}: for a velocity outside all its polygons the last one counts, in Nav2 the previous one")
        parts = [_velocity_polygon(name, part, own) for part in _names(own, "velocity_polygons")]
        return {"velocity": parts, "holonomic": _flag(own, "holonomic", False)}
    points = _points(f"{name}.points", own.get("points"))
    if points:
        return {"points": points}
    topic = _text(own, "polygon_sub_topic", "") or _text(own, "footprint_topic", "")
    if not topic:
        raise InputError(f"{name}: got no points and no polygon_sub_topic, wanted one of them")
    found.differs(f"{name}: until its polygon arrives the robot is stopped, in Nav2 the zone does nothing")
    return {"topic": _topic(topic)}


def _velocity_polygon(name: str, part: str, own: Mapping[str, Any]) -> dict[str, Any]:
    table = _table(own, part)
    points = _points(f"{name}.{part}.points", table.get("points"))
    if not points:
        raise InputError(f"{name}.{part}.points: missing")
    found: dict[str, Any] = {
        "points": points,
        "linear": [_number(table, "linear_min", -1.0), _number(table, "linear_max", 1.0)],
        "angular": [_number(table, "theta_min", -1.0), _number(table, "theta_max", 1.0)],
    }
    if "direction_start_angle" in table or "direction_end_angle" in table:
        ends = (("direction_start_angle", -math.pi), ("direction_end_angle", math.pi))
        found["direction"] = [_number(table, key, default) for key, default in ends]
    return found


def _sources(given: Mapping[str, Any], found: Conversion) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    sources, areas = [], dict[str, dict[str, Any]]()
    for name in _names(given, "observation_sources"):
        own = _table(given, name)
        kind = _text(own, "type", "scan")
        known = {"pointcloud2": "pointcloud", "laserscan": "scan"}.get(kind.lower(), kind)
        if known != kind:
            found.differs(f"{name}: type '{readable(kind)}' is not one of Nav2's; read as {known}")
        if known not in _SOURCE_TYPES:
            raise InputError(f"{name}.type: got '{readable(kind)}'; {did_you_mean(kind, list(_SOURCE_TYPES))}")
        sources.append(_source(name, known, own, given, found))
        for area in _names(own, "exclusion_zones") if "exclusion_zones" in own else []:
            areas[area] = _exclusion(area, _table(given, area), found)
            sources[-1]["exclusions"] = [*sources[-1].get("exclusions", []), areas[area]["name"]]
    return sources, list(areas.values())


def _source(
    name: str, kind: str, own: Mapping[str, Any], given: Mapping[str, Any], found: Conversion
) -> dict[str, Any]:
    asked = _number(own, "source_timeout", _number(given, "source_timeout", 2.0))
    time_out = asked if 0.0 < asked <= _LONGEST_TIME_OUT else _LONGEST_TIME_OUT
    if asked != time_out:
        never = " (never)" if asked == 0.0 else ""
        found.differs(f"{name}: source_timeout {asked:g} s{never} becomes 1 s, since the filter accepts no older data")
    source: dict[str, Any] = {
        "name": _plain(name), "topic": _topic(_text(own, "topic", "scan")), "type": _SOURCE_TYPES[kind],
        "time_out": max(0.05, time_out), "enabled": _flag(own, "enabled", True),
        "enable": f"/collision_monitor/{_plain(name)}/enable",
    }  # fmt: skip
    found.differs(
        "sources: the mount comes from tf, as in Nav2; 'enabled' applies to the zones, and 'safedpa sense' switches a "
        "source off for the filter"
    )
    if kind == "pointcloud":
        source["height"] = [_number(own, "min_height", 0.05), _number(own, "max_height", 0.5)]
        source["nearest"] = min(max(_number(own, "min_range", 0.0), 0.0), 10.0)
        if _flag(own, "use_global_height", False):
            found.differs(f"{name}: use_global_height is not used; heights are in the body frame")
        if _text(own, "transport_type", "raw") != "raw":
            found.differs(f"{name}: transport_type: only raw clouds can be read; name the raw topic")
    elif kind == "costmap":
        cost = max(1, min(_LETHAL, int(_number(own, "cost_threshold", _INSCRIBED))))
        source["occupied"] = max(1, cost * 98 // _SCALED if cost <= _SCALED else cost - _LETHAL + 100)
        source["unknown_is_occupied"] = _flag(own, "treat_unknown_as_obstacle", True)
    elif kind == "polygon":
        source["sampling"] = min(max(_number(own, "sampling_distance", 0.1), 0.01), 10.0)
        found.differs(f"{name}: for the filter, what is behind its polygons and next to them stays unknown")
    elif kind == "range" and "obstacles_angle" in own:
        found.differs(f"{name}: obstacles_angle is 1 degree")
    return source


def _exclusion(name: str, own: Mapping[str, Any], found: Conversion) -> dict[str, Any]:
    area: dict[str, Any] = {
        "name": _plain(name), "frame": _text(own, "frame_id", ""), "enabled": _flag(own, "enabled", False),
        "enable": f"/collision_monitor/{_plain(name)}/enable",
    }  # fmt: skip
    found.differs("NAME.enabled: a parameter in Nav2, here the topic of the key 'enable' (Bool)")
    if _text(own, "type", "polygon") == "circle":
        area["radius"] = _number(own, "radius", 0.0)
    else:
        area["points"] = _points(f"{name}.points", own.get("points"))
    area["height"] = [max(-1e3, _number(own, "min_height", -1e3)), min(1e3, _number(own, "max_height", 1e3))]
    if "frame_hold_timeout" in own:
        found.differs(f"{name}: frame_hold_timeout: frames.largest_age applies")
    return area


def _table(given: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    own = given.get(name)
    if not isinstance(own, dict):
        raise InputError(f"{readable(name)}: got no parameters of this name, wanted those of a listed zone or source")
    return own


def _names(given: Mapping[str, Any], key: str) -> list[str]:
    value = given.get(key, [])
    value = [value] if isinstance(value, str) else value
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value) or len(value) > 64:
        raise InputError(f"{key}: got {type(value).__name__}, wanted a list of up to 64 names")
    return list(dict.fromkeys(value))


def _text(given: Mapping[str, Any], key: str, default: str) -> str:
    value = given.get(key, default)
    if not isinstance(value, str) or len(value) > 200:
        raise InputError(f"{key}: got {readable(str(value)[:40])}, wanted a text")
    return readable(value)


def _flag(given: Mapping[str, Any], key: str, default: bool) -> bool:
    value = given.get(key, default)
    if not isinstance(value, bool):
        raise InputError(f"{key}: got {readable(str(value)[:40])}, wanted true or false")
    return value


def _number(given: Mapping[str, Any], key: str, default: float) -> float:
    value = given.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e6:
        raise InputError(f"{key}: got {readable(str(value)[:40])}, wanted a number")
    return float(value)


def _points(key: str, value: Any) -> list[list[float]]:
    """Corners from a text ``[[x, y], ...]``, a list of pairs, or a flat list; empty if there are none."""
    if value is None or value == "":
        return []
    if isinstance(value, str):
        flat: list[Any] = [float(one) for one in _NUMBER.findall(value[:20_000])]
        if re.sub(_NUMBER, "", value[:20_000]).strip("[], \n\t"):
            raise InputError(f"{key}: got '{readable(value[:40])}', wanted [[x, y], [x, y], ...] in m")
    elif isinstance(value, list):
        flat = [one for part in value[:200] for one in (part if isinstance(part, list) else [part])]
    else:
        raise InputError(f"{key}: got {type(value).__name__}, wanted [[x, y], [x, y], ...] in m")
    if not all(isinstance(one, (int, float)) and not isinstance(one, bool) and abs(one) <= 1e4 for one in flat):
        raise InputError(f"{key}: got something that is no number, wanted [[x, y], [x, y], ...] in m")
    if len(flat) < 6 or len(flat) % 2:
        raise InputError(f"{key}: got {len(flat)} numbers, wanted x and y of 3 corners or more")
    return [[float(flat[index]), float(flat[index + 1])] for index in range(0, len(flat), 2)]


def _topic(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _plain(name: str) -> str:
    """A valid name of a zone, a source and a part of a topic."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (plain if plain[:1].isalpha() else f"n{plain}")[:40]


def _toml(tables: Mapping[str, Any], head: str) -> str:
    lines = [head]
    for name, table in tables.items():
        for one in table if isinstance(table, list) else [table]:
            inner = {key: value for key, value in one.items() if key == "velocity"}
            header = "" if not name else f"[[{name}]]" if isinstance(table, list) else f"[{name}]"
            lines += ["", header] if header else []
            lines += [f"{key} = {_value(value)}" for key, value in one.items() if key not in inner]
            for part in inner.get("velocity", []):
                lines += [f"[[{name}.velocity]]", *(f"{key} = {_value(value)}" for key, value in part.items())]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value)
