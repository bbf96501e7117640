"""``safedpa calibrate``: margins from recorded drives, and those of the theorem on transitions."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from tests.safety.node_steps import asked, latent_at, state_at

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT
from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.calibration.from_recordings import own_errors, recorded_bound
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.records import McapRecorder
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings, MarginCalibration, one_step_errors
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_services.command_line.calibrate import command
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

Values = NDArray[np.float64]
FOOTPRINT = (0.08, 0.40, 0.12)
MODEL = load_model("car")
SETTINGS = FilterSettings.for_robot("car")


def recorded(path: Path, robots: Iterable[CarRobot], ticks: int, margin: MarginCalibration | None) -> Path:
    """States and latents of drives of one robot, one after the other."""
    with McapRecorder(path) as file:
        for robot in robots:
            listener = AdaptationNode(MODEL)
            nodes = [AdaptationNode(MODEL), PolicyNode(MODEL), SafetyFilterNode(MODEL, settings_named("car"), margin)]
            for tick in drive(robot, nodes, ticks):
                latent = listener.step("r1", tick.state, {})[LATENT]
                listener.afterwards("r1")
                at = 10**9 + tick.state.tick * 50_000_000
                file.write(key_of("fleet", "r1", STATE), encode(tick.state), at, at)
                file.write(key_of("fleet", "r1", LATENT), encode(latent), at, at)
    return path


def test_both_margins_are_written_with_their_coverage_on_fresh_steps(tmp_path: Path) -> None:
    drives, out = [CarRobot(Scene.random(4, "chair"), 0.05)], tmp_path / "margin.toml"
    recording = recorded(tmp_path / "recording.mcap", drives, 800, margin_for(MODEL))
    result = CliRunner().invoke(command, [str(recording), "--out", str(out)])
    assert result.exit_code == 0, result.output
    found = MarginCalibration.load(out)
    assert found.fingerprint == fingerprint(MODEL)
    assert set(found.theorem) == set(found.epsilon) == {"obstacle", "field", "speed"}
    assert 600 <= found.transitions < 700  # four fifths of 799
    assert set(found.covered) == {f"{name}.{kind}" for name in ("conformal", "theorem") for kind in found.epsilon}
    for kind, epsilon in found.epsilon.items():
        assert found.covered[f"conformal.{kind}"] > 0.95
        assert found.covered[f"theorem.{kind}"] > 0.97
        assert found.theorem[kind] > epsilon
        assert f"conformal {epsilon:.4f}" in result.output
    assert found.constants["step"] > 0.0


def test_with_enough_drives_the_margins_are_over_drives(tmp_path: Path) -> None:
    """Ten short drives of one robot, each a start of its own; the order of the file is that of nothing."""
    drives = [CarRobot(Scene.random(epoch, "box"), 0.05, epoch=epoch) for epoch in range(1, 11)]
    path = recorded(tmp_path / "recording.mcap", drives, 40, None)
    out = tmp_path / "margin.toml"
    result = CliRunner().invoke(command, [str(path), "--out", str(out), "--coverage", "0.85"])
    assert result.exit_code == 0, result.output
    found = MarginCalibration.load(out)
    assert (found.drives, found.transitions) == (8, 8 * 39)
    assert set(found.drive) == set(found.epsilon) == {"obstacle", "field", "speed"}
    assert all(found.drive[kind] >= epsilon for kind, epsilon in found.epsilon.items())
    assert {f"drive.{kind}" for kind in found.epsilon} <= set(found.covered)
    assert "312 transitions of 8 drives" in result.output
    few = CliRunner().invoke(command, [str(path), "--out", str(out), "--coverage", "0.9"])
    assert "too few drives for a margin of a whole drive" in few.output
    assert MarginCalibration.load(out).drives == 0


@dataclasses.dataclass
class Drawn:
    """Transitions whose true step is the model's, disturbed in its own frame."""

    state: Values
    action: Values
    following: Values
    latent: Values
    footprints: set[tuple[float, ...]]


def drawn(count: int, sizes: tuple[float, ...], seed: int = 0) -> Drawn:
    random = np.random.default_rng(seed)
    state = random.uniform((-3, -3, -np.pi, -0.4), (3, 3, np.pi, 1.8), (count, 4))
    action = random.uniform((-0.6, -0.34), (2.0, 0.34), (count, 2))
    latent = np.tile(MODEL.latent, (count, 1))
    own = random.uniform(-1, 1, (count, 4)) * sizes
    c, s = np.cos(state[:, 2]), np.sin(state[:, 2])
    change = np.column_stack([c * own[:, 0] - s * own[:, 1], s * own[:, 0] + c * own[:, 1], own[:, 2], own[:, 3]])
    return Drawn(state, action, MODEL.step(state, action, latent) + change, latent, {FOOTPRINT})


def test_own_errors_are_the_disturbance() -> None:
    errors = own_errors(MODEL, drawn(200, (0.01, 0.0, 0.02, 0.03)))
    assert np.abs(errors).max(axis=0) == pytest.approx([0.01, 0.0, 0.02, 0.03], rel=0.05, abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("sizes", [(0.01, 0.01, 0.0, 0.0), (0.0, 0.0, 0.03, 0.0), (0.0, 0.0, 0.0, 0.1)])
def test_what_it_covers_in_norm_it_covers_in_h(sizes: tuple[float, ...]) -> None:
    """Disturbed in one kind of entry alone, so that a factor that is missing for it shows."""
    found = drawn(6000, sizes)
    used = np.arange(6000) < 4000
    bound = recorded_bound(MODEL, SETTINGS, found, used, 0.99)
    obstacles = np.column_stack([np.random.default_rng(1).uniform(-3, 3, (40, 2)), np.full(40, 0.2)])
    barriers = car_barriers(SETTINGS, FOOTPRINT, obstacles, (-4, 4, -4, 4))
    errors = one_step_errors(MODEL, barriers, found.state, found.action, found.following, found.latent)
    for kind, epsilon in bound.margins.items():
        assert (errors[kind][~used] <= epsilon).mean() >= 0.98
    assert errors["obstacle"].max() > 0.25 * bound.margins["obstacle"]  # no bound without bounds


def test_the_margin_is_the_largest_gradient_times_the_error_of_the_step() -> None:
    bound = recorded_bound(MODEL, SETTINGS, drawn(1200, (0.01, 0.002, 0.02, 0.05)), np.ones(1200, bool), 0.99)
    made_of = bound.constants
    assert set(bound.margins) == {"obstacle", "field", "speed"}
    for kind, margin in bound.margins.items():
        assert margin == pytest.approx(made_of[f"gradient.{kind}"] * made_of["step"])
    assert made_of["gradient.speed"] == made_of["scale.speed"] == pytest.approx(0.05, rel=0.05)
    assert made_of["step"] == pytest.approx(1.0, abs=0.05)


def test_the_longest_footprint_counts() -> None:
    found = drawn(1200, (0.01, 0.002, 0.02, 0.05))
    used = np.ones(1200, bool)
    alone = recorded_bound(MODEL, SETTINGS, found, used, 0.99)
    found.footprints = {FOOTPRINT, (0.08, 1.4, 0.12)}
    both = recorded_bound(MODEL, SETTINGS, found, used, 0.99)
    assert both.margins["obstacle"] > 1.1 * alone.margins["obstacle"]
    assert both.margins["speed"] == alone.margins["speed"]


def test_the_scales_are_those_of_the_first_of_ten_blocks() -> None:
    found = drawn(1200, (0.01, 0.002, 0.02, 0.05))
    bound = recorded_bound(MODEL, SETTINGS, found, np.ones(1200, bool), 0.99)
    errors = np.abs(own_errors(MODEL, found))
    aside = np.concatenate([np.arange(100), np.arange(1000, 1100)])
    scale = np.quantile(errors[aside], 0.99, axis=0)
    reported = [bound.constants[f"scale.{name}"] for name in MODEL.system.state_names]
    assert reported == pytest.approx(scale.tolist(), rel=1e-12)


def test_too_few_transitions_are_refused_and_a_robot_without_such_barriers_has_no_such_margin() -> None:
    pendulum = load_model("pendulum")
    assert recorded_bound(pendulum, SETTINGS, drawn(3, (0.0,) * 4), np.ones(3, bool), 0.99).margins == {}
    with pytest.raises(InputError, match="record more"):
        recorded_bound(MODEL, SETTINGS, drawn(150, (0.01, 0.01, 0.01, 0.01)), np.ones(150, bool), 0.99)


def test_the_filters_node_uses_the_margin_that_the_settings_choose() -> None:
    calibration = MarginCalibration({"obstacle": 0.02, "field": 0.03}, 0.99, 1000, "2026-11-21", fingerprint(MODEL))
    calibration = dataclasses.replace(calibration, theorem={"obstacle": 0.05, "field": 0.06})
    for margin, wanted in (("conformal", 0.03), ("theorem", 0.06), (0.07, 0.07)):
        node = SafetyFilterNode(MODEL, FilterSettings.for_robot("car", margin=margin), calibration)
        state = state_at(0)
        assert asked(node, state, latent_at(state)).margin == wanted, "the widest of all kinds"
    with pytest.raises(InputError, match="theorem"):
        SafetyFilterNode(MODEL, FilterSettings.for_robot("car", margin="theorem"))
