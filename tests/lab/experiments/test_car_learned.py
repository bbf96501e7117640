"""The car experiment with learned models: nodes of every method, predictions with the history encoder, latents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.safety.shipped import settings_named
from safedpa_lab.experiments.car_blind import BlindFilterNode
from safedpa_lab.experiments.car_drives import Drive, DriveOrder, recorded_drive
from safedpa_lab.experiments.car_episodes import EpisodeGroup, run_group
from safedpa_lab.experiments.car_errors import error_ratios, errors_of_model, increment_scale
from safedpa_lab.experiments.car_latent import latent_result
from safedpa_lab.experiments.car_margin import coverage_of, latents_along, margin_of, step_errors
from safedpa_lab.experiments.car_methods import METHODS, FixedLatentNode, chosen_methods, named_model
from safedpa_lab.experiments.car_predict import predictor_of

SETTINGS = settings_named("car")


@pytest.fixture(scope="module")
def drive_with_box() -> Drive:
    return recorded_drive(DriveOrder(7001, "box", 120))


def outcomes(name, folder, seeds=(0,), ticks=150):
    return run_group(EpisodeGroup(METHODS[name], "none", seeds, folder, SETTINGS, None, ticks))


@pytest.mark.parametrize("name", ["safedpa", "fix", "mix"])
def test_a_filter_with_a_learned_model_keeps_a_blind_policy_from_contact(name, learned_folder):
    for outcome in outcomes(name, learned_folder):
        assert outcome.safe
        assert not outcome.success  # it drives straight on until the filter holds it
        assert outcome.changed > 50
        assert "fallback" not in outcome.statuses


@pytest.mark.parametrize("name", ["rma", "rma_p", "policy"])
def test_the_same_policy_without_a_filter_hits_something(name, learned_folder):
    for outcome in outcomes(name, learned_folder):
        assert not outcome.safe
        assert outcome.first_collision
        assert outcome.statuses.keys() == {"disabled"}


def test_an_episode_repeats_bit_for_bit(learned_folder):
    assert outcomes("safedpa", learned_folder, (3,), 60) == outcomes("safedpa", learned_folder, (3,), 60)


def test_every_method_is_there_and_those_that_lack_something_say_what(learned_folder, tmp_path, crude):
    present, missing = chosen_methods((), learned_folder)
    assert present == [method for method in METHODS.values() if method.usual]
    assert missing == []
    crude(tmp_path, "car_simulated", policy=False)
    present, missing = chosen_methods((), tmp_path)
    assert [method.name for method in present] == ["physics", "goal_seeker"]
    assert any("has no policy among its weights" in sentence for sentence in missing)


def test_a_filter_that_is_blind_takes_no_model_with_a_latent(learned_folder):
    with pytest.raises(InputError, match="wanted one without"):
        BlindFilterNode(named_model("car_learned", learned_folder), SETTINGS, None)


def test_without_adaptation_the_latent_stays(learned_folder, drive_with_box):
    model = named_model("car_simulated", learned_folder)
    node = FixedLatentNode(model)
    for message in drive_with_box.messages[::40]:
        said = node.step("r1", message, {})[LATENT]
        assert said.values == tuple(model.latent)


def test_latents_along_a_drive_are_those_of_the_node(drive_with_box):
    model = load_model("car")
    node, rows = AdaptationNode(model), latents_along(model, drive_with_box)
    for message, row in zip(drive_with_box.messages, rows, strict=True):
        assert node.step("r1", message, {})[LATENT].values == tuple(row)
        node.afterwards("r1")


def test_predictions_with_the_encoder_are_what_the_node_and_the_model_say(random_model, drive_with_box):
    latents = latents_along(random_model, drive_with_box)
    states, actions = drive_with_box.states, drive_with_box.actions
    one_step = predictor_of(random_model, drive_with_box).one_step()
    for tick in (1, 3, 49, 50, 51, 119):  # at the very first the node says what the file has
        expected = random_model.step(states[tick], actions[tick], latents[tick])
        np.testing.assert_allclose(one_step[tick], expected, atol=1e-5)


def test_in_a_rollout_the_latent_follows_the_prediction(random_model, drive_with_box):
    start, steps = 60, 5
    found = predictor_of(random_model, drive_with_box).rollouts([start], steps)[0]
    messages = list(drive_with_box.messages[: start + 1])
    for step in range(steps):
        latent = latents_along(random_model, Drive(tuple(messages), drive_with_box.loads[: len(messages)]))[-1]
        action = drive_with_box.actions[start + step]
        following = random_model.step(np.array(messages[-1].values), action, latent)
        np.testing.assert_allclose(found[step], following, atol=1e-4)
        messages.append(replaced(drive_with_box.messages[start + step + 1], following))


def test_a_model_that_is_right_has_no_error_and_a_wrong_one_has(learned_folder, drive_with_box):
    right = named_model("car_learned", learned_folder)
    wrong = named_model("car_simulated", learned_folder)
    ideal = driven_by(right, drive_with_box)
    scale = increment_scale([right], [ideal])
    errors = {"right": errors_of_model(right, [ideal], scale), "wrong": errors_of_model(wrong, [ideal], scale)}
    assert errors["right"]["box"]["one_second"]["number"] < 1e-5
    assert errors["right"]["mixed"] == errors["right"]["box"]
    exact = step_errors(right, [ideal], SETTINGS, scale)
    for kind, bound in exact.bound.items():  # both the error of h and the theory's bound of it
        assert max(bound.max(), np.abs(exact.h[kind]).max()) < 1e-4
    assert errors["wrong"]["mixed"]["one_step"]["per_state"]["speed"] > 0.1
    assert errors["wrong"]["mixed"]["one_step"]["per_state"]["across"] < 1e-6
    doubled = {"wrong": errors["wrong"], "half": errors_of_model(wrong, [ideal], 2 * scale)}
    assert error_ratios(doubled, "wrong", "half")["mixed"]["one_second"] == pytest.approx(2.0)


def test_a_margin_covers_what_it_was_calibrated_on(learned_folder):
    drives = [recorded_drive(DriveOrder(5000 + i, "none", 120, "physics")) for i in range(4)]
    model = named_model("car_learned", learned_folder)
    errors = step_errors(model, drives, SETTINGS, increment_scale([model], drives))
    margin = margin_of(model, errors, "2026-11-21")
    covered, steps = coverage_of(margin, errors), sum(len(drive.actions) for drive in drives)
    assert covered.keys() == {"obstacle", "field", "speed"}
    assert all(row["conformal"]["share"] >= 0.99 and row["steps"] == steps for row in covered.values())
    narrow = replace(margin, epsilon=dict.fromkeys(margin.epsilon, 0.0))
    for kind, row in coverage_of(narrow, errors).items():
        assert row["conformal"]["covered"] == (errors.h[kind] <= 0.0).sum() < steps
        assert row["largest_error"] >= margin.epsilon[kind] > 0.0
        assert (errors.bound[kind] >= errors.h[kind] - 1e-9).all()  # the theory's bound holds in every step
        assert row["theorem"]["epsilon"] >= margin.epsilon[kind]


@pytest.mark.long
def test_the_estimate_follows_what_is_hitched():
    model = load_model("car")
    fitting = [recorded_drive(DriveOrder(8000 + i, load, 160)) for i in range(6) for load in ("none", "large_chair")]
    heldout = [recorded_drive(DriveOrder(7000, load, 160)) for load in ("none", "large_chair")]
    change = recorded_drive(DriveOrder(9000, "none", 240, events=((60, "large_chair"), (150, "none"))))
    result = latent_result(model, fitting, heldout, [change], np.ones(4))
    assert result["accuracy"]["share"] > 0.9
    assert [(row["from"], row["to"], row["watched"]) for row in result["changes"]] == [
        ("none", "large_chair", 90),
        ("large_chair", "none", 91),
    ]
    assert all(row["latent_ticks"] is not None and row["latent_ticks"] < 50 for row in result["changes"])


def replaced(message, values):
    return replace(message, values=tuple(float(value) for value in values))


def driven_by(model, drive):
    """The same actions from the same start, in a world that is the model."""
    messages = [drive.messages[0]]
    for message, action in zip(drive.messages[1:], drive.actions, strict=True):
        messages.append(replaced(message, model.step(np.array(messages[-1].values), action, model.latent)))
    return Drive(tuple(messages), drive.loads)


@pytest.fixture
def random_model(random_car_weights):
    """A learned model whose encoder answers to what it sees."""
    weights: Weights = random_car_weights(3)
    small = {name: 0.1 * value for name, value in weights.tensors.items() if name.startswith(("f.2", "g.2"))}
    nominal = load_model("car")
    settings = {path: setting for path, setting in nominal.settings.items() if path.startswith("base.")}
    return PhysicsModel(LearnedBase(nominal.base, weights.with_tensors(small)), (), settings)
