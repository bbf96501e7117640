"""Training of the point robot in small, and the story of a hidden effect."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.networks import load_weights
from safedpa.records.write import write_columns
from safedpa_lab.experiments.point_story import PointStory, point_story, point_story_markdown
from safedpa_lab.point.hidden import HIDDEN, point_logs
from safedpa_services.command_line import safedpa
from safedpa_sim.point.latent_policy import LatentPolicy
from safedpa_sim.point.observation import entries_seen
from safedpa_sim.point.policy_task import PointPractice
from safedpa_sim.training.configuration import load_configuration

PUNISHED = ("rma", "rma_p_0_1", "rma_p_0_3", "rma_p_1", "rma_p_3")


@pytest.mark.long
def test_every_phase_in_small(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["train", "point", "--small", "--out", str(tmp_path), "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert list(records) == ["1a", "1b", "2", "fix_45", "fix_135", "fix_225", "fix_315", "mix", *PUNISHED, "17"]
    assert min(records["1a"]["explained"]) > 0.5
    assert records["fix_45"]["loss"] < records["mix"]["loss"]
    weights = load_weights(tmp_path / "point_learned.safetensors")
    assert all(weights.has(name) for name in ("mu", "f", "g", "phi", "policy"))
    assert len(records["1b"]["imitation_errors"]) == 2
    assert LatentPolicy(weights).act(np.zeros((3, entries_seen(2)))).shape == (3, 2)
    assert all(load_weights(tmp_path / f"point_{name}.safetensors").has("policy") for name in PUNISHED)


@pytest.mark.long
def test_robots_that_practise_behind_the_stand_in_never_enter_a_hazard() -> None:
    configuration = load_configuration("point_small")
    weights = _plain()
    contacts = []
    for sheltered in (True, False):
        robots = PointPractice(configuration, weights, 24, 0, sheltered=sheltered, calm=True)
        chosen, began = np.tile(np.array([1.0, 0.1], np.float32), (24, 1)), 0
        for _ in range(80):
            moved = robots.advance(chosen)
            began += int(moved.began.sum())
        contacts.append(began)
    assert contacts[0] == 0 < contacts[1]


def test_the_latent_in_view_is_that_of_the_wind() -> None:
    from safedpa.networks import LearnedNetworks

    weights = _plain()
    robots = PointPractice(load_configuration("point_small"), weights, 5, 1)
    wind = robots.task.simulation.force.T / robots.task.simulation.body.mass
    assert robots.latent == pytest.approx(LearnedNetworks(weights).encode(wind), abs=1e-5)
    assert robots.observation().shape == (5, entries_seen(2))
    assert robots.observation(np.array([2])).shape == (1, entries_seen(2))


@pytest.mark.long
def test_force_and_drag_are_named_and_the_corrected_filter_is_safer() -> None:
    result = point_story(PointStory(robots=24, seconds=1.5, logs=2))
    case = result["cases"]["force and drag"]
    assert set(case["added"]) == {"constant_force", "viscous_drag"}
    assert case["values"]["constant_force.ax"]["value"] == pytest.approx(-0.809, abs=0.03)
    assert case["values"]["viscous_drag.coefficient"]["value"] == pytest.approx(1.927, abs=0.05)
    assert case["error"][-1] < 0.2 * case["error"][0]
    assert case["rows"]["diagnosed"]["safe"] > case["rows"]["shipped"]["safe"]
    assert case["rows"]["diagnosed"]["unsafe_steps"] < case["rows"]["shipped"]["unsafe_steps"]
    assert "added constant_force.ax" in point_story_markdown({**result, "date": "today"})


@pytest.mark.long
def test_the_commands_name_it_from_files(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = []
    for run in point_logs(HIDDEN["force and drag"], 0, 3, 15.0):
        names = ("t", *run.system.state_names, *run.system.action_names)
        table = dict(zip(names, np.column_stack([run.t, run.states, run.actions]).T, strict=True))
        paths.append(str(tmp_path / f"{run.name}.csv"))
        write_columns(table, tmp_path / f"{run.name}.csv", "csv")
    assert safedpa.run(["compare", "point", *paths, "--out", str(tmp_path), "--json"]) == 0
    capsys.readouterr()
    once, twice = tmp_path / "once.toml", tmp_path / "twice.toml"
    assert safedpa.run(["add", "point", "viscous_drag", *paths, "--out", str(once), "--json"]) == 0
    capsys.readouterr()
    drag = re.compile(r"^coefficient = (\S+)", re.MULTILINE)  # too little while the force is not there: fitted with it
    once.write_text(drag.sub(r"coefficient = { value = \1, free = true }", once.read_text()))
    assert safedpa.run(["add", str(once), "constant_force", *paths, "--out", str(twice), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < 0.1 * document["before"]
    found, truth = document["parameters"], HIDDEN["force and drag"].effects
    for name, number in (("viscous_drag", "coefficient"), ("constant_force", "ax"), ("constant_force", "ay")):
        assert found[f"{name}.{number}"]["value"] == pytest.approx(truth[name][number], rel=0.03)


def test_mistakes_are_named() -> None:
    with pytest.raises(InputError, match="--hidden: got 'ghost'"):
        PointStory(hidden=("ghost",))
    with pytest.raises(InputError, match="--robots: got 0"):
        PointStory(robots=0)


def _plain():
    """The shipped weights without what is not asked of them here."""
    from safedpa_lab.point.weights import weights_named

    return weights_named("learned")
