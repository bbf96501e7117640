"""The pendulum's view: sector, estimated wind, phase plane."""

import math
from itertools import pairwise
from typing import Any

import pytest
from tests.messages import latent_of, stamp, state_of, verdict_of

from safedpa.bus import LatentMessage, StateMessage, VerdictMessage
from safedpa.drawing import Lines
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa_services.dashboard.display_settings import DisplaySettings, display_settings
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.pendulum import phase_bounds, wind_entry
from safedpa_services.dashboard.robot_view import RobotView

EDGE = math.pi / 4


@pytest.fixture(scope="module")
def pendulum() -> DisplaySettings:
    return display_settings(load_model("pendulum"), settings_named("pendulum"))


def state(tick: int, angle: float = 0.1, rate: float = 0.4, **other: Any) -> StateMessage:
    given: dict[str, Any] = {"corridor": (-EDGE, EDGE), "goal": (0.0,), "field": (), "footprint": (), **other}
    return state_of(angle, rate, **stamp(tick, 0.01), applied=(1.0,), period=0.01, lockstep=True, **given)


def verdict(tick: int) -> VerdictMessage:
    predicted = ((0.11, 0.5), (0.12, 0.6))
    return verdict_of("corrected", **stamp(tick, 0.01), action=(1.0,), nominal=(9.0,), predicted=predicted)


def latent(*values: float) -> LatentMessage:
    return latent_of(*values, **stamp(1, 0.01))


def paths(entries: list[Any]) -> set[str]:
    return {"/".join(entry.path) for entry in entries}


def test_states_and_verdicts_give_rod_sector_phase_plane_and_curves(pendulum: DisplaySettings) -> None:
    view = RobotView(pendulum)
    assert "action/torque" in paths(view.start())
    first = view.take(state(1), 0.0)
    assert paths(first) >= {"world/rod", "world/tip", "world/sector", "world/goal", "phase/safe_set", "phase/now"}
    assert paths(view.take(verdict(1), 0.0)) >= {"phase/predicted", "barrier", "action/torque"}
    assert "phase/trail" in paths(view.take(state(2, 0.12), 0.0))
    assert "phase/trail" not in paths(view.take(state(4, 5.0), 0.0)), "a new swing is no stretch of the last one"


@pytest.mark.parametrize("other", [{"corridor": ()}, {"corridor": (1.0, -1.0)}, {"goal": (1.0, 2.0)}, {"goal": ()}])
def test_a_scene_with_invalid_parts_is_drawn_without_them(pendulum: DisplaySettings, other: dict[str, Any]) -> None:
    drawn = paths(RobotView(pendulum).take(state(1, **other), 0.0))
    assert "world/rod" in drawn
    assert ("phase/safe_set" in drawn) is ("corridor" not in other)


@pytest.mark.parametrize(("low", "high"), [(-0.4, 0.9), (0.9, 2.0 * math.pi - 0.4), (0.0, 9.0)])
def test_the_arc_of_the_corridor_is_smooth_and_at_most_one_turn(pendulum: DisplaySettings, low: float, high: float):
    """Chords deviate from the circle by less than a thousandth of its radius."""
    entries = RobotView(pendulum).take(state(1, corridor=(low, high)), 0.0)
    sector = next(entry.shape for entry in entries if entry.path == ("world", "sector"))
    assert isinstance(sector, Lines)
    points = sector.strips[0]
    assert points[0] == pytest.approx((-1.15 * math.sin(low), 1.15 * math.cos(low)))
    middles = [math.dist((0.0, 0.0), (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]))) for a, b in pairwise(points)]
    assert min(middles) > 1.148
    assert len(points) < 200
    length = sum(math.dist(one, other) for one, other in pairwise(points))
    assert length == pytest.approx(1.15 * min(high - low, 2.0 * math.pi), rel=2e-3)


def test_the_drawn_safe_set_is_that_of_the_filter(pendulum: DisplaySettings) -> None:
    entries = RobotView(pendulum).take(state(1), 0.0)
    outline = next(entry.shape for entry in entries if entry.path == ("phase", "safe_set"))
    assert isinstance(outline, Lines)
    for angle, ahead in outline.strips[0]:
        assert -EDGE - 1e-12 <= angle <= EDGE + 1e-12
        assert min(abs(angle + ahead - edge) for edge in (-EDGE, EDGE)) < 1e-12, "every corner lies on h = 0"
    now = next(entry.shape for entry in entries if entry.path == ("phase", "now"))
    assert now.centres == ((0.1, pytest.approx(0.25 * 0.4)),)


def test_the_arrow_points_with_the_wind_and_positive_angles_lean_left(pendulum: DisplaySettings) -> None:
    entry = wind_entry(latent(3.0, -2.0), pendulum)
    assert entry is not None
    assert isinstance(entry.shape, Lines)
    (x0, y0), (x1, y1) = entry.shape.strips[0]
    assert x1 - x0 == pytest.approx(-0.26 / 5.0 * 3.0)
    assert y1 - y0 == pytest.approx(-0.26 / 5.0 * 2.0)
    assert "world/wind" in paths(_after_a_state(pendulum, latent(3.0, -2.0)))
    assert "world/wind" not in paths(_after_a_state(pendulum, latent(3.0))), "a latent of another model is no wind"


def _after_a_state(look: DisplaySettings, message: LatentMessage) -> list[Any]:
    view = RobotView(look)
    view.take(state(1), 0.0)
    return view.take(message, 0.0)


def test_the_wind_is_read_from_the_latent_of_networks() -> None:
    model = load_model("pendulum_learned")
    look = display_settings(model, settings_named("pendulum"))
    base: Any = model.base
    for wind in ((2.8, 2.8), (-4.0, 0.5), (0.0, -3.9)):
        read = look.wind(tuple(base.networks.encode(wind).tolist()))
        assert read is not None
        assert math.dist(read, wind) < 0.5
    assert look.wind((math.nan, 0.0)) is None


def test_a_model_without_wind_has_no_arrow() -> None:
    model = load_model("dfki_pendulum")
    assert display_settings(model, settings_named("pendulum")).wind(tuple(model.latent.tolist())) is None


def test_the_phase_plane_shows_the_corridor(pendulum: DisplaySettings) -> None:
    bounds = phase_bounds(state(1), pendulum)
    assert bounds is not None
    assert bounds[0] < -EDGE < EDGE < bounds[1]
    assert phase_bounds(state(1, corridor=()), pendulum) is None
    assert FleetView(pendulum).fields == {}


def test_rerun_draws_it(pendulum: DisplaySettings, tmp_path: Any) -> None:
    from safedpa_services.dashboard.rerun_recording import RerunRecording
    from safedpa_services.dashboard.shapes import TimelineFrame

    view = RobotView(pendulum)
    recording = RerunRecording(pendulum, "fleet", save=tmp_path / "p.rrd", bind="127.0.0.1", grpc_port=None)
    recording.arrange({"r1": (-1.0, 1.0, -0.5, 0.5)})
    recording.draw([TimelineFrame(0.0, tuple(view.start())), TimelineFrame(0.1, tuple(view.take(state(1), 0.0)))])
    recording.draw([TimelineFrame(0.2, tuple(view.take(latent(3.0, -2.0), 0.0)))])
    recording.close()
    assert (tmp_path / "p.rrd").stat().st_size > 5_000
