"""From messages to shapes: the right ones for a drive, and no valid message raises."""

import math
from dataclasses import fields, replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus import (
    HEALTH,
    LATENT,
    NO_ROBOT,
    STATE,
    TOPICS,
    VERDICT,
    ReceivedMessage,
    RejectedMessage,
    decode,
    encode,
)
from safedpa.bus.messages.messages import LARGEST_NUMBER, RosterEntry
from safedpa.drawing import Lines, Rings
from safedpa.robots.car.barriers.obstacles import braking_of
from safedpa.safety import FilterSettings
from safedpa_services.dashboard.fleet_view import MOST_ROBOTS, FleetView
from safedpa_services.dashboard.shapes import Bands, Curves, Note
from safedpa_services.dashboard.world import body_entries

_NUMBERS = st.floats(-LARGEST_NUMBER, LARGEST_NUMBER) | st.floats(-5.0, 5.0)
_VECTORS = st.lists(_NUMBERS, max_size=6).map(tuple)
_TEXTS = st.text(max_size=12) | st.sampled_from(["passed", "filter", "watchdog", "fallback", "running"])
_OF_TYPE = {
    "Count": st.integers(0, 30) | st.integers(0, 2**63 - 1),
    "Number": _NUMBERS,
    "Positive": st.floats(1e-9, LARGEST_NUMBER),
    "bool": st.booleans(),
    "str": _TEXTS,
    "Vector": _VECTORS,
    "Rows": st.lists(_VECTORS, max_size=5).map(tuple),
    "tuple[str, ...]": st.lists(_TEXTS, max_size=3).map(tuple),
}


_OF_TYPE["tuple[RosterEntry, ...]"] = st.lists(
    st.builds(RosterEntry, **{field.name: _OF_TYPE[field.type] for field in fields(RosterEntry)}), max_size=3
).map(tuple)


def _messages(topic):
    return st.builds(topic.message, **{field.name: _OF_TYPE[field.type] for field in fields(topic.message)})


_ITEMS = st.sampled_from(list(TOPICS.values())).flatmap(lambda topic: st.tuples(st.just(topic), _messages(topic)))


def _received(topic, message, robot="r1", at=0.0):
    return ReceivedMessage(topic, robot, message, b"", f"safedpa/fleet/{robot}/{topic.name}", at)


def _entries(frames):
    return [entry for frame in frames for entry in frame.entries]


@pytest.fixture(scope="module")
def recording(look, tmp_path_factory):
    from safedpa_services.dashboard.rerun_recording import RerunRecording

    recording = RerunRecording(
        look, "fleet", save=tmp_path_factory.mktemp("any") / "any.rrd", bind="127.0.0.1", grpc_port=None
    )
    yield recording
    recording.close()


@pytest.mark.long
@settings(max_examples=100)
@given(items=st.lists(st.tuples(_ITEMS, st.sampled_from(["r1", "r 2", "ü/x", NO_ROBOT])), max_size=6))
def test_any_valid_message_can_be_drawn(look, recording, tick_of, items):
    view = FleetView(look)
    known = [_received(topic, message) for topic, message in tick_of(0)]
    strange = [
        _received(topic, decode(topic.message, encode(message)), robot, 0.1 * k)
        for k, ((topic, message), robot) in enumerate(items)
    ]
    frames = view.take(known, 0.0) + view.take(strange, 1.0) + view.take([], 9.0)
    recording.arrange(view.fields)
    recording.draw(frames)
    assert all(math.isfinite(frame.at) for frame in frames)


def test_a_tick_shows_everything_under_the_robots_name(look, tick_of):
    view = FleetView(look)
    entries = _entries(view.take([_received(*item) for k in (0, 1) for item in tick_of(k)], 0.0))
    paths = {"/".join(entry.path[2:]) for entry in entries if entry.path[:2] == ("robots", "r1")}
    assert len(paths) == len({entry.path for entry in entries})
    assert paths >= {
        "world/field", "world/obstacles", "world/clearance", "world/goal", "world/body", "world/load", "world/swept",
        "world/trail", "world/predicted", "barrier", "action/target_speed", "action/steer", "residual",
        "latent/towed_load.mass_ratio", "verdict/filter", "verdict/in_force", "services/policy", "steps/policy", "log",
    }  # fmt: skip


def _shape(look, topic, message, path, kind):
    view = FleetView(look)
    entries = _entries(view.take([_received(topic, message)], 0.0))
    return next(e.shape for e in entries if "/".join(e.path[2:]) == path and isinstance(e.shape, kind))


def test_the_clearance_ring_is_where_the_capsules_axis_must_stop(look, tick_of):
    state = tick_of(0)[0][1]
    rings = _shape(look, STATE, state, "world/clearance", Rings)
    assert rings.radii == pytest.approx(
        [radius + state.footprint[2] + look.clearance for *_, radius in state.obstacles]
    )


def _wheels(look, state):
    """Directions of the long sides of the four drawn wheels, rear ones first [rad]."""
    body = next(entry.shape for entry in body_entries(state, look) if entry.path == ("world", "body"))
    sides = [max(pairwise(wheel), key=lambda side: math.dist(*side)) for wheel in body.strips[2:]]
    return [math.atan2(b[1] - a[1], b[0] - a[0]) % math.pi for a, b in sides]


@pytest.mark.parametrize(
    ("actions", "applied", "front"),
    [
        (("target_speed", "steer"), (1.0, 0.3), 0.3),
        (("throttle", "steer"), (0.2, -0.3), -0.3),
        (("speed", "yaw_rate"), (1.0, 0.3), 0.0),  # a rate is no angle of a wheel
        (("target_speed", "steer"), (), 0.0),  # a robot that does not report its action
        (("target_speed", "steer"), (1.0,), 0.0),
        (("target_speed", "steer"), (1.0, 0.3, 0.3), 0.0),
    ],
)
def test_front_wheels_turn_with_the_steering_and_rear_ones_do_not(look, tick_of, actions, applied, front):
    state = replace(tick_of(0)[0][1], values=(2.0, 1.0, 0.5, 1.2), applied=applied)
    system = SimpleNamespace(state_names=look.system.state_names, action_names=actions)
    wheels = _wheels(replace(look, system=system, swept=lambda _state: None), state)
    assert wheels == pytest.approx([0.5, 0.5, 0.5 + front, 0.5 + front])


def test_the_swept_capsule_reaches_as_far_as_the_car_needs_to_stop(look, tick_of):
    state = replace(tick_of(0)[0][1], values=(0.0, 0.0, 0.0, 2.0))
    swept = _shape(look, STATE, state, "world/swept", Lines)
    farthest = max(x for x, _ in swept.strips[0])
    assert farthest == pytest.approx(0.4 + 0.15 + braking_of(FilterSettings.for_robot("car")).distance(2.0))


def test_actions_are_drawn_with_nominal_actions_and_limits_and_h_has_a_gap_when_unknown(look, tick_of):
    verdict = replace(tick_of(0)[2][1], status="fallback", h_now=0.0, h_next=0.0, nominal=())
    view = FleetView(look)
    entries = _entries(view.take([_received(STATE, tick_of(0)[0][1]), _received(VERDICT, verdict)], 0.0))
    curves = {"/".join(e.path[2:]): e.shape.values for e in entries if isinstance(e.shape, Curves) and not e.static}
    assert curves["action/steer"] == pytest.approx((math.nan, 0.1, -0.34, 0.34), nan_ok=True)
    assert curves["barrier"] == pytest.approx((math.nan, math.nan, 0.02, 0.0), nan_ok=True)


def test_the_latent_carries_the_models_names_and_deviations(look, tick_of):
    view = FleetView(look)
    entries = _entries(view.take([_received(*item) for item in tick_of(0)], 0.0))
    bands = [e.shape for e in entries if isinstance(e.shape, Bands) and not e.static]
    assert [(band.name, band.value, band.deviation) for band in bands] == [
        (look.latent_names[0], 0.4, 0.1),
        (look.latent_names[1], 2.5, 0.3),
    ]


def test_refused_bytes_are_logged_a_few_times_and_counted(look, tick_of):
    view = FleetView(look)
    view.take([_received(*tick_of(0)[0])], 0.0)
    refused = [
        RejectedMessage("safedpa/fleet/r1/state", "r1", "no msgpack"),
        RejectedMessage("rubbish", "", "no key"),
    ] * 40
    notes = [e.shape for e in _entries(view.take(refused, 0.0)) if isinstance(e.shape, Note)]
    assert view.refused == 80
    assert len(notes) == 20


def test_a_flood_of_robot_names_is_bounded(look, tick_of):
    view = FleetView(look)
    state = tick_of(0)[0][1]
    for k in range(200):
        view.take([_received(STATE, state, f"r{k}")], 0.0)
    assert len(view.fields) == MOST_ROBOTS


def test_a_service_of_the_whole_fleet_is_shown_with_every_robot_and_falls_silent(look, tick_of):
    view = FleetView(look)
    health = replace(tick_of(0)[3][1], service="recorder")
    items = [_received(STATE, tick_of(0)[0][1], name) for name in ("r1", "r2")]
    shown = _entries(view.take([*items, _received(HEALTH, health, NO_ROBOT)], 0.0))
    assert {e.path[1] for e in shown if e.path[2:] == ("services", "recorder")} == {"r1", "r2"}
    silent = _entries(view.take([], 1.5))
    lanes = {(e.path[1], e.path[-1], e.shape.state) for e in silent if e.path[2] == "services"}
    assert lanes == {("r1", "recorder", "silent"), ("r2", "recorder", "silent")}
    assert not any(isinstance(e.shape, Note) for e in _entries(view.take([], 2.5)))


def test_a_latent_of_an_unknown_robot_shows_nothing(look, tick_of):
    assert FleetView(look).take([_received(LATENT, tick_of(0)[1][1])], 0.0) == []
