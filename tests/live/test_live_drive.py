"""A whole live drive in small: the car in its world, the real services, the real search."""

import json
from itertools import pairwise
from pathlib import Path

import pytest
from click.testing import CliRunner

from safedpa.adaptation import AdaptationNode
from safedpa.bus import FINDING, MODEL, TAKEOVER, HealthMessage, ReceivedMessage
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.records.readers.mcap import read_messages
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand
from safedpa_lab.experiments.diagnosis.live import (
    CASES,
    LiveExperiment,
    drive_live,
    live_experiment,
    live_scene,
    record_drive,
)
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot

COMMAND = ExperimentCommand(EXPERIMENTS["live"])

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "bent.mcap"
    return record_drive("steering_offset", 2, 90.0, 26.0, path), path


@pytest.mark.long
def test_a_bent_linkage_is_found_named_accepted_and_corrected(bent):
    drive, _ = bent
    assert drive.changed == pytest.approx(26.0, abs=10.0)
    assert 0.0 < drive.raised - drive.changed <= 10.0
    assert drive.found - drive.changed <= 60.0
    assert drive.effect == CASES["steering_offset"]
    assert drive.numbers["angle"] == pytest.approx(0.08, abs=0.01)
    assert drive.fell - drive.taken <= 20.0
    assert drive.after < 0.4 * drive.before
    assert drive.collisions == 0
    assert drive.findings == 1


@pytest.mark.parametrize("period", [0.1, pytest.param(0.025, marks=pytest.mark.long)])
def test_the_same_holds_for_a_robot_of_another_rate_than_its_models(period):
    """Its margin is of its own steps; of the model's there are none in what it drove."""
    drive = drive_live("steering_offset", 1, 90.0, 26.0, period=period)
    assert drive.effect == CASES["steering_offset"]
    assert drive.numbers["angle"] == pytest.approx(0.08, abs=0.01)
    assert drive.taken is not None
    assert drive.after < 0.4 * drive.before
    assert drive.collisions == 0


@pytest.mark.long
def test_the_recording_holds_every_step_of_it(bent):
    drive, path = bent
    messages = [item for _, _, item in read_messages(path, [], (FINDING, MODEL, TAKEOVER))]
    steps = [item.step for item in messages if hasattr(item, "step")]
    stages = [item.stage for item in messages if hasattr(item, "stage")]
    taken = [item for item in messages if hasattr(item, "service")]
    assert steps[:2] == ["offer", "take"]
    assert list(dict.fromkeys(stages)) == ["learning", "watching", "raised", "searching", "candidates"]
    assert {(item.service, item.state) for item in taken} == {
        (service, state) for service in ("adaptation", "policy", "safety_filter") for state in ("ready", "taken")
    }
    report = json.loads(next(item.report for item in messages if getattr(item, "report", "")))
    assert report["added"][0] == drive.effect


@pytest.mark.long
def test_nothing_is_found_where_nothing_changes():
    result = live_experiment(LiveExperiment(cases=("nothing",), quiet_seeds=(3,), quiet_seconds=90.0))
    assert result["quiet"]["findings"] == 0
    assert result["quiet"]["collisions"] == 0
    assert result["quiet"]["hours"] == pytest.approx(0.025)
    assert 0.0 < result["quiet"]["stated_probability_at_most"] < 1e-3


def test_the_scene_has_passages_for_a_chair_that_is_not_there_yet():
    scene = live_scene(4)
    assert scene.load is None
    assert len(scene.fixed_goals) > 100


@pytest.mark.parametrize(
    ("options", "phrase"),
    [
        (["--drives", "0"], "--drives"),
        (["--after", "5"], "--after"),
        (["--record", "nowhere/at/all.mcap", "--case", "hitch"], "does not exist"),
        (["--record", "all.mcap"], "one case"),
    ],
)
def test_bad_options_are_refused_with_a_reason(options, phrase, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(COMMAND, options)
    assert done.exception is not None
    assert phrase in str(done.exception) + done.output


def test_services_in_one_process_use_the_robots_clock():
    """However long the machine takes for a tick: no service is taken for silent, and the drive repeats."""
    model = load_model("car_measured")
    nodes = [
        AdaptationNode(model),
        PolicyNode(model),
        SafetyFilterNode(model, settings_named("car"), margin_for(model)),
    ]
    beats: list[tuple[str, int]] = []

    def hear(item: ReceivedMessage) -> None:
        if isinstance(item.message, HealthMessage):
            beats.append((item.message.service, item.message.tick))

    for _ in drive(CarRobot(live_scene(1), 0.05), nodes, 41, hear=hear):
        pass
    ticks = [tick for service, tick in beats if service == "policy"]
    apart = [after - before for before, after in pairwise(ticks)]
    assert apart[0] <= 5  # robots take turns: the second heartbeat comes after a part of the time
    assert apart[1:] == [5] * 7
