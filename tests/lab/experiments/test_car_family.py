"""The car experiment with learned models: families of methods, predictions with the history encoder, latents."""

import json
from dataclasses import replace
from itertools import product
from math import hypot
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.lab.experiments.conftest import crude_weights, save_crude

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.car import episodes as car_cells
from safedpa_lab.experiments.car import experiment
from safedpa_lab.experiments.car.drives import FIRST_SEEDS, Drive, DriveOrder, recorded_drive
from safedpa_lab.experiments.car.episodes import Cell, run_group
from safedpa_lab.experiments.car.experiment import CarExperiment
from safedpa_lab.experiments.car.latent import latent_result
from safedpa_lab.experiments.car.margin import coverage_of, margin_of, step_errors
from safedpa_lab.experiments.car.methods import (
    FAMILIES,
    METHODS,
    BlindFilterNode,
    FixedLatentNode,
    chosen_methods,
    named_model,
)
from safedpa_lab.experiments.car.predictor import (
    error_ratios,
    errors_of_model,
    increment_scale,
    latents_along,
    predictor_of,
)
from safedpa_lab.experiments.car.report import markdown_of
from safedpa_services.command_line.group import safedpa
from safedpa_sim.robots import LOADS, CarWorld
from safedpa_sim.robots.car.loads import footprint
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.environments import car_task

PAPER = FAMILIES["paper"]


def weights_of(latents: int, name: str = "car_paper", **practice: Any) -> Weights:
    """Crude ones that claim to be trained with a configuration, with some of its ``practice`` changed."""
    configuration = load_configuration(name)
    configuration = replace(configuration, practice=replace(configuration.practice, **practice))
    crude = crude_weights(latents)
    described = replace(crude.description, trained_on={"configuration": configuration.as_table()})
    return crude.with_tensors({"observation_body": np.array(footprint(None))} if latents else {}, described)


@pytest.fixture(scope="module")
def paper_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All models that the family asks for."""
    folder = tmp_path_factory.mktemp("paper")
    for name in ("car_learned", "car_simulated", "car_rma_p", "car_ppo"):
        save_crude(folder, name, weights_of(2))
    for name in ("car_fix", "car_mix"):
        save_crude(folder, name, weights_of(0))
    return folder


def test_every_method_of_the_paper_s_world_is_driven_by_its_own_models(paper_folder: Path) -> None:
    present, missing = chosen_methods((), paper_folder, PAPER)
    assert [item.name for item in present] == ["safedpa", "safedpa_untuned", "rma", "rma_p", "ppo", "fix", "mix"]
    assert missing == []
    assert METHODS["ppo"].filter_model is METHODS["rma"].filter_model is METHODS["rma_p"].filter_model is None
    assert not METHODS["ppo"].adaptive


def test_no_shipped_model_replaces_a_missing_one(tmp_path: Path) -> None:
    present, missing = chosen_methods((), tmp_path, PAPER)
    assert present == []
    assert "car_learned.toml is not in" in missing[0]
    with pytest.raises(InputError, match="'safedpa train car --configuration car_paper --out"):
        chosen_methods(("safedpa",), tmp_path, PAPER)
    with pytest.raises(InputError, match="not in"):
        chosen_methods(("physics",), tmp_path, PAPER)


@pytest.mark.parametrize(
    ("weights", "reported"),
    [
        (weights_of(2, "car"), "was trained with towed_load.deceleration, towed_load.mass_ratio in its environment"),
        (weights_of(2, shelter=True), "was trained with practice.shelter = true"),
        (weights_of(2, loads=True), "was trained with practice.loads = true"),
        (weights_of(2, footprint=True), "was trained with practice.footprint = true"),
        (crude_weights(2), "was trained with no one knows what in its environment"),
    ],
)
def test_a_model_of_another_world_is_refused(weights: Weights, reported: str, tmp_path: Path) -> None:
    save_crude(tmp_path, "car_simulated", weights)
    with pytest.raises(InputError) as caught:
        chosen_methods(("rma",), tmp_path, PAPER)
    assert reported in str(caught.value)
    assert chosen_methods(("rma",), tmp_path)[0] == [METHODS["rma"]]


def test_a_policy_that_sees_the_footprint_is_refused_and_so_is_physics(paper_folder: Path, tmp_path: Path) -> None:
    good = weights_of(2)
    tensors = {name: part for name, part in good.tensors.items() if name != "observation_body"}
    save_crude(tmp_path, "car_simulated", Weights(tensors, good.description))
    assert PAPER.refuses(named_model("car_simulated", tmp_path).base) == "holds a policy that sees the footprint"
    assert "no learned one" in PAPER.refuses(load_model("car").base)
    assert PAPER.refuses(named_model("car_learned", paper_folder).base) == ""


def test_margins_are_calibrated_without_a_load_and_on_as_many_drives(paper_folder, monkeypatch) -> None:
    asked: dict[str, list[DriveOrder]] = {}

    class AskedError(Exception):
        pass

    def recorded(_workers: Any, orders: list[DriveOrder], _advance: Any) -> Any:
        asked.setdefault(name, []).extend(orders)
        if len(asked[name]) > len(orders):
            raise AskedError
        return []

    monkeypatch.setattr("safedpa_lab.experiments.car.margin.recorded", recorded)
    for name in FAMILIES:
        with pytest.raises(AskedError):
            experiment.car_experiment(CarExperiment(paper_folder, methods=("safedpa",), family=name, processes=1))
    assert len(asked["paper"]) == len(asked["best"])
    assert {order.load for order in asked["best"]} == {"none", "box", "chair", "large_chair"}
    assert {order.load for order in asked["paper"]} == {"none"}
    for orders in asked.values():
        first, second = FIRST_SEEDS["margin"], FIRST_SEEDS["fresh"]
        assert all(first <= order.seed < FIRST_SEEDS["errors"] for order in orders)
        assert {order.seed < second for order in orders} == {True, False}


def test_seeds_of_episodes_calibration_and_development_are_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes below those of recorded drives; policies are chosen on scenes of another kind, with seeds beyond all."""
    with pytest.raises(InputError, match="wanted seeds from 0 and below 5000"):
        CarExperiment(Path(), first_seed=4990, episodes=20, family="paper")

    def driving(_configuration: Any, _weights: Any, _cars: int, seed: int, **_: Any) -> Any:
        raise LookupError(seed)

    monkeypatch.setattr(car_task, "DrivingTask", driving)
    with pytest.raises(LookupError) as evaluated:
        car_task.evaluate(None, None)  # type: ignore[arg-type]
    assert max(FIRST_SEEDS.values()) + 1000 < evaluated.value.args[0]


def test_only_what_was_measured_without_a_load_differs_in_the_filter_s_settings() -> None:
    today, paper = FAMILIES["best"].settings("car"), PAPER.settings("car")
    assert (today, replace(paper, barriers=today.barriers)) == (settings_named("car"), today)
    changed = {name for name in paper.barriers if paper.barrier(name) != today.barrier(name)}
    assert changed == {"braking_deceleration", "braking_gain"}


def way_over_promise(world: CarWorld, braking: Braking) -> float:
    """Way to standstill along the path, from now on under the brake, over the way that ``braking`` promises."""
    x, y, _, speed = world.state
    promised, way = abs(braking.distance(speed)), 0.0
    for _ in range(80):
        world.advance(0.0, 0.0, 0.025)
        there_x, there_y, _, _ = world.state
        way += hypot(there_x - x, there_y - y)
        x, y = there_x, there_y
    return way / promised


def test_the_braking_numbers_hold_without_a_load_and_know_of_none() -> None:
    """Over steers, speeds, steady and still accelerating, from 0.2 m/s on; a large chair hitched later is more."""
    settings = PAPER.settings("car")
    braking = Braking(settings.barrier("braking_deceleration"), settings.barrier("braking_gain"))
    shares = []
    for steer, periods, speed in product((0.0, -0.34), (4, 8, 60), (0.3, 0.8, 1.4, 2.0, -0.6)):
        world = driven(speed, steer, periods)
        if abs(world.state[3]) > 0.2:
            shares.append(way_over_promise(world, braking))
    assert max(shares) < 1.0 / 1.125
    towing = driven(2.0, 0.0, 100)
    towing.hitch(LOADS["large_chair"])
    assert way_over_promise(towing, braking) > 1.0


def driven(speed: float, steer: float, periods: int) -> CarWorld:
    """The car without a load on an open field after so many periods of 0.05 s under that target speed and steer."""
    world = CarWorld((0.0, 0.0, 0.0), (-500.0, 500.0, -500.0, 500.0))
    for _ in range(periods):
        world.advance(speed, steer, 0.05)
    return world


@pytest.mark.long
@pytest.mark.slow
def test_the_table_of_the_paper_s_world_names_it(paper_folder, tmp_path, capsys) -> None:
    """Three methods on one scene with a box, by the command: margins, cells and page as for the other family."""
    phrase = ["experiment", "car", "--family", "paper", "--models", str(paper_folder), "--out", str(tmp_path)]
    phrase += ["--method", "safedpa", "--method", "rma", "--method", "ppo", "--load", "box", "--episodes", "1"]
    assert safedpa.run([*phrase, "--drives", "1", "--part", "table", "--processes", "1", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["family"]["name"] == "paper"
    assert reported["margin"]["calibrated_with"] == ["none"]
    cells = {cell["method"]: cell for cell in reported["cells"]}
    assert cells["safedpa"]["safe"]["hits"] == 1
    assert cells["rma"]["safe"]["hits"] == cells["ppo"]["safe"]["hits"] == 0, "it drives straight on"
    page = (tmp_path / "car.md").read_text()
    assert "trained in the paper's world" in page
    assert "calibrated with none" in page


@pytest.mark.long
@pytest.mark.slow
def test_in_the_second_table_every_filter_has_safedpa_s_own_margin(learned_folder, tmp_path, monkeypatch) -> None:
    """The physics model's own is another one; RMA has no filter and no place in that table."""
    used: dict[str, dict[str, float]] = {}
    run = car_cells.run_group

    def seen(group: Cell) -> Any:
        assert group.margin is not None
        used[group.method.name] = group.margin.epsilon
        return run(group)

    monkeypatch.setattr("safedpa_lab.experiments.car.drives.EARNEST", 1)
    monkeypatch.setattr("safedpa_lab.experiments.car.episodes.run_group", seen)
    asked = CarExperiment(
        learned_folder, tmp_path, episodes=2, equal_margin_episodes=1, methods=("safedpa", "physics", "rma"),
        loads=("none", "box"), parts=("equal-margin",), processes=1, drives=1,
    )  # fmt: skip
    reported = experiment.car_experiment(asked)
    table, models = reported["equal_margin"], reported["margin"]["models"]
    assert used == {"safedpa": table["epsilon"], "physics": table["epsilon"]}
    own = {name: models[name]["obstacle"]["conformal"]["epsilon"] for name in ("car_learned", "car")}
    assert table["epsilon"]["obstacle"] == own["car_learned"] != own["car"]
    assert [(cell["method"], cell["episodes"]) for cell in table["cells"]] == [("safedpa", 1)] * 2 + [
        ("physics", 1)
    ] * 2
    assert {row["place"] for row in table["advantages"]} == {"all", "none", "box"}
    assert "With SafeDPA's own margin for every filter" in markdown_of(reported)


SETTINGS = settings_named("car")


@pytest.fixture(scope="module")
def drive_with_box() -> Drive:
    return recorded_drive(DriveOrder(7001, "box", 120))


def outcomes(name, folder, seeds=(0,), ticks=150):
    return run_group(Cell(METHODS[name], "none", seeds, folder, SETTINGS, None, ticks=ticks))


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


def test_every_method_is_there_and_those_that_lack_something_say_what(learned_folder, tmp_path):
    present, missing = chosen_methods((), learned_folder)
    assert (present, missing) == ([method for method in METHODS.values() if method.usual], [])
    save_crude(tmp_path, "car_simulated", crude_weights(2, straight_on=False))
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
        notice = node.step("r1", message, {})[LATENT]
        assert notice.values == tuple(model.latent)


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
