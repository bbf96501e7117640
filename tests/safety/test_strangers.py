"""Who is not the robot of these settings and barriers is refused, by every road, before anything is driven."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.calibration.from_recordings import calibration_from_recordings
from safedpa.calibration.from_runs import calibration_from_runs
from safedpa.dynamics import PhysicsModel, load_model, parse_model
from safedpa.dynamics.user_files import load_user_file
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of, car_barriers
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.robots.point.system import POINT
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import (
    AbstractBarrier,
    CorridorBarrier,
    FilterSettings,
    FunctionBarrier,
    HigherOrderBarrier,
    PendingActions,
    Plausible,
    RolloutBarrier,
    SafetyFilter,
    SpeedBarrier,
    Status,
    parse_settings,
    write_settings,
)
from safedpa.safety.barriers.stopping import Motion, StoppingBarrier
from safedpa.safety.defaults import settings_named
from safedpa.systems import System, Variable
from safedpa_services.command_line.group import safedpa

OWN = Path(__file__).parent / "strangers.py"
NAMES = ("car", "pendulum", "point")
MODELS = {"car": "car", "pendulum": "pendulum", "point": "point_wind"}
WRONG = [(model, settings) for model in NAMES for settings in NAMES if model != settings]
FOOTPRINT = (0.08, 0.4, 0.12)
KINDS = {"drone": "hover", "differential": "two_wheels"}
BOUNDS = {"action_low": (-1.0, -1.0), "action_high": (1.0, 1.0)}


@pytest.fixture(scope="module")
def strangers() -> dict[str, PhysicsModel]:
    load_user_file(OWN)
    return {
        name: parse_model(f'format = 1\nrobot = "{name}"\nperiod = 0.05\n\n[base]\nkind = "{kind}"\n')
        for name, kind in KINDS.items()
    }


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    written = {}
    for name, kind in KINDS.items():
        written[name] = tmp_path / f"{name}.toml"
        written[name].write_text(f'format = 1\nrobot = "{name}"\nperiod = 0.05\n\n[base]\nkind = "{kind}"\n')
    return written


def car_scene() -> list[AbstractBarrier]:
    return car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(2.0, 0.0, 0.3)], (-4.0, 4.0, -4.0, 4.0))


def test_settings_name_their_system_and_come_back_from_a_file() -> None:
    assert {name: settings_named(name).system for name in NAMES} == {name: name for name in NAMES}
    assert {name: FilterSettings.for_robot(name).system for name in NAMES} == {name: name for name in NAMES}
    assert FilterSettings(**BOUNDS).system == ""
    assert parse_settings('eta = 0.5\nsystem = "car"') == FilterSettings.for_robot("car", eta=0.5)
    assert parse_settings("action_low = [-1.0]\naction_high = [1.0]").system == ""
    settings = FilterSettings(system="drone", **BOUNDS)
    assert parse_settings(write_settings(settings)) == settings


def test_settings_without_bounds_are_refused_and_no_robot_lends_its_own(strangers: dict[str, PhysicsModel]) -> None:
    for given in ({}, {"system": "car"}, {"action_low": (0.0,)}):
        with pytest.raises(TypeError, match=r"missing .*'action_high'"):
            FilterSettings(**given)
    for text in ("eta = 0.5", 'system = "unknown"', 'action_low = [-1.0]\nsystem = ""'):
        with pytest.raises(InputError, match=r"action_(low|high): missing; wanted the bounds"):
            parse_settings(text)
    drone = strangers["drone"].system
    assert FilterSettings.for_robot(drone).action_high == tuple(each.high for each in drone.action)
    for wrong, phrase in (
        ({"system": 3}, "system: got 3, wanted the name"),
        ({"action_low": ()}, "action_high: got 1 numbers"),
    ):
        with pytest.raises(InputError, match=phrase):
            FilterSettings(**{"action_low": (-1.0,), "action_high": (1.0,), **wrong})


@pytest.mark.parametrize("name", NAMES)
def test_right_pairs_are_accepted_and_so_are_limits_that_are_the_models_own_but_none_beyond(name: str) -> None:
    model = load_model(MODELS[name])
    SafetyFilter.for_model(model, settings_named(name))
    SafetyFilterNode(model, settings_named(name))
    model = load_model(MODELS[name])
    bounds = {end: [getattr(each, end[7:]) for each in model.system.action] for end in ("action_low", "action_high")}
    SafetyFilter.for_model(model, FilterSettings(system="", **bounds))
    for place, variable in enumerate(model.system.action):
        for end, further in (("action_low", -1e-9), ("action_high", 1e-9)):
            beyond = {**bounds, end: [*bounds[end]]}
            beyond[end][place] += further
            with pytest.raises(InputError, match=rf"for {variable.name}, the system .* takes .*; wanted bounds within"):
                SafetyFilter.for_model(model, FilterSettings(system="", **beyond))


@pytest.mark.parametrize(("model", "settings"), WRONG)
@pytest.mark.parametrize("made", [SafetyFilter.for_model, SafetyFilterNode], ids=["library", "service"])
def test_wrong_pairs_are_refused(made: Any, model: str, settings: str) -> None:
    with pytest.raises(InputError, match=f"settings: made for the system '{settings}', the model is of '{model}'"):
        made(load_model(MODELS[model]), settings_named(settings))


@pytest.mark.parametrize(("model", "settings"), WRONG)
def test_wrong_pairs_are_refused_by_the_command(capsys: Any, model: str, settings: str) -> None:
    assert safedpa.run(["up", "--robot", model, "--settings", settings, "--headless"]) == 2
    notice = capsys.readouterr().err
    assert f"--settings {settings}: settings: made for the system '{settings}'" in notice
    assert notice.count("\n") == 1


@pytest.mark.parametrize(("model", "settings"), WRONG)
def test_wrong_pairs_are_not_calibrated(model: str, settings: str) -> None:
    with pytest.raises(InputError, match="made for the system"):
        calibration_from_recordings(load_model(MODELS[model]), settings_named(settings), [Path("none")], 0.9, "")
    if model != "point":
        with pytest.raises(InputError, match="made for the system"):
            calibration_from_runs(load_model(MODELS[model]), settings_named(settings), [], 0.9, "")


@pytest.mark.parametrize("name", KINDS)
def test_the_cars_settings_are_refused_around_a_stranger(strangers: dict[str, PhysicsModel], name: str) -> None:
    with pytest.raises(InputError, match=f"made for the system 'car', the model is of '{name}'"):
        SafetyFilter.for_model(strangers[name], FilterSettings.for_robot("car"))
    with pytest.raises(InputError, match=f"for the system '{name}', x, y"):
        SafetyFilterNode(strangers[name], FilterSettings.for_robot("car"))


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("system", ["", "own"])
def test_barriers_that_read_other_states_are_refused(strangers: dict[str, PhysicsModel], name: str, system: str):
    model, settings = strangers[name], FilterSettings(system=name if system else "", **BOUNDS)
    motion = Motion(np.zeros(2), 1.0, 1.0, 1.0)
    for barrier in (*car_scene(), CorridorBarrier(-1.0, 1.0, 0.2), StoppingBarrier(np.ones((1, 3)), motion)):
        with pytest.raises(InputError, match=rf"barrier '{barrier.kind}': reads the states .*, the model has x, y"):
            SafetyFilter.for_model(model, settings, [barrier])
    with pytest.raises(InputError, match="the service has barriers for x, y, yaw, speed with target_speed, steer"):
        SafetyFilterNode(model, settings)


def test_barriers_handed_in_with_a_decision_are_no_way_round(strangers: dict[str, PhysicsModel]) -> None:
    """A drone flying into an obstacle: its height was read as a heading, and its action was passed on."""
    safe = SafetyFilter.for_model(strangers["drone"], FilterSettings(**BOUNDS))
    state = [0.5, 0.0, 1.5, 2.0, 0.0, 0.0]
    for barriers in (car_scene(), tuple(car_scene())):
        verdict = safe.decide(state, [1.0, 0.0], barriers=barriers)
        assert verdict.status is Status.fallback
        assert "barrier 'obstacle': reads the states x, y, yaw, speed, the model has x, y, z, vx, vy, vz" in (
            verdict.reason
        )
        assert not verdict.known


def test_functions_without_names_are_recognised_by_the_number_of_entries() -> None:
    safe = SafetyFilter(lambda x: (x, np.zeros((len(x), 2))), car_scene(), FilterSettings(**BOUNDS))
    assert safe.decide(np.zeros(4), [0.0, 0.0]).status is not Status.fallback
    for entries in (3, 5, 6):
        verdict = safe.decide(np.zeros(entries), [0.0, 0.0])
        assert verdict.status is Status.fallback
        assert f"got a state of {entries} entries; wanted 4" in verdict.reason
    assert safe.decide(np.zeros(4), [0.0, 0.0]).status is not Status.fallback


def test_names_of_a_range_are_those_of_the_states_and_each_barrier_names_what_it_reads() -> None:
    wide = Plausible(np.full(5, -9.0), np.full(5, 9.0), ("x", "y", "yaw", "speed", "hitch"))
    safe = SafetyFilter(lambda x: (x, np.zeros((5, 2))), car_scene(), FilterSettings(**BOUNDS), state_range=wide)
    assert safe.decide(np.zeros(5), [0.0, 0.0]).status is not Status.fallback
    other = Plausible(np.full(4, -9.0), np.full(4, 9.0), ("x", "y", "speed", "yaw"))
    with pytest.raises(InputError, match="reads the states x, y, yaw, speed, the model has x, y, speed, yaw"):
        SafetyFilter(lambda x: (x, np.zeros((4, 2))), car_scene(), FilterSettings(**BOUNDS), state_range=other)
    assert [part.reads for part in car_scene()] == [CAR.state_names] * 3
    assert CorridorBarrier(-1.0, 1.0, 0.2).reads == PENDULUM.state_names
    assert StoppingBarrier(np.ones((1, 3)), Motion(np.zeros(2), 1.0, 1.0, 1.0)).reads == POINT.state_names
    assert SpeedBarrier(-1.0, 1.0, 2).reads == CorridorBarrier(-1.0, 1.0, 0.2, angle=2, rate=3).reads == ()
    assert FunctionBarrier(lambda x: 1.0).reads == ()
    assert FunctionBarrier(lambda x: 1.0, reads=["a", "b"]).reads == ("a", "b")
    with pytest.raises(InputError, match="reads: got 'ab'"):
        FunctionBarrier(lambda x: 1.0, reads="ab")


def test_default_settings_around_a_users_functions_are_refused() -> None:
    one = [FunctionBarrier(lambda x: 1.0 - x[0])]
    with pytest.raises(InputError, match=r"made for the system 'car' \(x, y, yaw, speed; target_speed, steer\), which"):
        SafetyFilter(lambda x: (x, np.eye(1)), one, FilterSettings.for_robot("car"))
    with pytest.raises(InputError, match="made for the system 'pendulum'"):
        SafetyFilter(lambda x: (x, np.eye(1)), None, settings_named("pendulum"))
    for reported in (
        {"barriers": car_scene()},
        {"barriers": one, "state_range": Plausible(CAR.state_low, CAR.state_high, CAR.state_names)},
    ):
        SafetyFilter(lambda x: (x, np.zeros((4, 2))), settings=FilterSettings.for_robot("car"), **reported)  # type: ignore[arg-type]
    SafetyFilter(lambda x: (x, np.eye(1)), one, FilterSettings(system="my cart", action_low=(0,), action_high=(1,)))


@pytest.mark.parametrize(
    ("changed", "phrase"),
    [
        ({"action_low": (-1.0,), "action_high": (1.0,), "system": "car"}, "got bounds of 1 actions, .* 'car' has 2"),
        ({"action_low": (-1.0,), "action_high": (1.0,)}, r"got bounds of 1 actions, .* \(target_speed, steer\)"),
        ({"action_high": (2.0, 0.7)}, r"got bounds of -0\.34 to 0\.7 rad for steer, .* takes -0\.6 to 0\.6"),
        ({"action_low": (-9.0, -0.3)}, r"got bounds of -9 to 2 m/s for target_speed"),
    ],
)
def test_limits_that_do_not_fit_the_model(changed: dict[str, Any], phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        SafetyFilter.for_model(load_model("car"), FilterSettings.for_robot("car", **{"system": "", **changed}))


def test_a_robot_without_an_action_cannot_be_filtered() -> None:
    class Falls:
        system = System("ball", (Variable("height", "m", 0.0, 9.0),), ())
        latent_names = ()

        def affine(self, state: Any) -> Any: ...

    with pytest.raises(InputError, match=r"the system 'ball' has 0 \(none\)"):
        SafetyFilter.for_model(Falls(), FilterSettings(action_low=(-1,), action_high=(1,)))  # type: ignore[arg-type]


def own(**changes: Any) -> SafetyFilter:
    """A filter of one action around functions of one's own."""
    settings = {"action_low": (-1.0,), "action_high": (1.0,), "epsilon": 0.0}
    barriers = changes.pop("barriers", [FunctionBarrier(lambda x: 1.0 - x[0], kind="cliff")])
    backup = changes.pop("backup", None)
    return SafetyFilter(lambda x: (x, np.eye(1)), barriers, FilterSettings(**{**settings, **changes}), backup=backup)


@pytest.mark.parametrize(
    "answer",
    [np.zeros(2), [[0.0]], 0.5, np.array([np.nan]), [np.inf], "1.0", ["1.0"], None, np.ma.array([0.1])],
    ids=str,
)
def test_a_backup_of_another_size(answer: Any) -> None:
    with pytest.raises(InputError, match="backup: got"):
        own(backup=lambda state: answer)
    with pytest.raises(InputError, match="backup: got ndarray, wanted a function"):
        own(backup=np.zeros(1))


def test_a_backup_that_needs_a_state_is_no_mistake() -> None:
    assert own(backup=lambda state: -0.5 * state).decide(np.array([0.4]), None).action == [-0.2]


@pytest.mark.parametrize(
    "barriers", [[], (), [ObstacleBarrier([], FOOTPRINT, braking_of(FilterSettings.for_robot("car")))]]
)
def test_a_filter_without_barriers(barriers: Any) -> None:
    with pytest.raises(InputError, match="barriers: got none, wanted at least one, or None"):
        own(barriers=barriers)
    with pytest.raises(InputError, match="barriers: got none"):
        SafetyFilter.for_model(load_model("car"), FilterSettings.for_robot("car"), barriers)


def test_barriers_that_come_with_every_decision() -> None:
    safe = own(barriers=None)
    assert "there is no barrier to keep" in safe.decide([0.0], [1.0]).reason
    assert safe.decide([0.0], [1.0], barriers=[FunctionBarrier(lambda x: 9.0 - x[0])]).status is Status.passed


@pytest.mark.parametrize("barriers", [7, "abc", FunctionBarrier(lambda x: 1.0), [lambda x: 1.0], [None]])
def test_what_is_no_barrier(barriers: Any) -> None:
    with pytest.raises(InputError, match=r"barriers: got .*, wanted"):
        own(barriers=barriers)
    assert own().decide([0.0], [1.0], barriers=barriers).status is Status.fallback


def test_what_are_no_settings() -> None:
    for settings in (None, {"eta": 0.2}):
        with pytest.raises(InputError, match=r"settings: got .*, wanted FilterSettings"):
            SafetyFilter.for_model(load_model("car"), settings)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=r"settings: got .*, wanted FilterSettings"):
            SafetyFilter(lambda x: x, None, settings)  # type: ignore[arg-type]


def test_a_misspelt_kind_of_margin() -> None:
    with pytest.raises(InputError, match=r"epsilon\.clif: no barrier is of this kind.*did you mean 'cliff'\?"):
        own(epsilon={"clif": 0.1})
    obstacles = FilterSettings.for_robot("car", epsilon={"obstcle": 0.05})
    for barriers in (car_scene(), None):
        with pytest.raises(InputError, match=r"epsilon\.obstcle: .*did you mean 'obstacle'\?"):
            SafetyFilter.for_model(load_model("car"), obstacles, barriers)
    with pytest.raises(InputError, match=r"epsilon\.obstcle: .*did you mean 'obstacle'\?"):
        SafetyFilterNode(load_model("car"), obstacles)
    with pytest.raises(InputError, match=r"epsilon\.cliff"):
        SafetyFilterNode(load_model("car"), FilterSettings.for_robot("car", epsilon={"cliff": 0.05}))
    own(epsilon={"cliff": 0.1, "obstacle": 0.1, "default": 0.0})
    own(epsilon={"cliff": 0.1}, barriers=None)


def test_a_misspelt_kind_of_margin_in_a_decision() -> None:
    safe = own()
    verdict = safe.decide([0.0], [1.0], epsilon={"clif": 0.9})
    assert verdict.status is Status.fallback
    assert "margin epsilon for 'clif', a kind without barriers: did you mean 'cliff'?" in verdict.reason
    assert safe.decide([0.0], [0.5], epsilon={"cliff": 0.1, "obstacle": 0.1}).margin == 0.1
    later = own(barriers=None)
    scene = [FunctionBarrier(lambda x: 1.0 - x[0], kind="edge")]
    assert later.decide([0.0], [0.2], epsilon={"edge": 0.1}, barriers=scene).status is Status.corrected
    far = [FunctionBarrier(lambda x: 9.0 - x[0], kind="wall")]
    assert later.decide([0.0], [0.1], epsilon={"edge": 0.1}, barriers=far).status is Status.passed


@pytest.mark.long
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("settings", ["car", "own"])
def test_the_filters_own_process_refuses_a_stranger(files: dict[str, Path], tmp_path: Path, name: str, settings: str):
    chosen = tmp_path / "safety.toml"
    chosen.write_text(write_settings(FilterSettings(system=name, **BOUNDS)))
    options = ["--model", str(files[name]), "--settings", "car" if settings == "car" else str(chosen)]
    found = subprocess.run(
        [sys.executable, "-m", "safedpa_services.safety_filter", *options],
        env={**os.environ, "SAFEDPA_EFFECTS": str(OWN)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert found.returncode == 2
    notice = [line for line in found.stderr.splitlines() if not line.startswith("margin: none was")]
    assert len(notice) == 1
    assert f"for the system '{name}', x, y" in notice[0]


@pytest.mark.parametrize("name", KINDS)
def test_the_command_refuses_a_stranger(files, capsys, monkeypatch, name):
    monkeypatch.setenv("SAFEDPA_EFFECTS", str(OWN))  # the command sets it, for the processes that it starts
    assert safedpa.run(["up", "--headless", "--model", str(files[name]), "--effects", str(OWN), "--json"]) == 2
    notice = capsys.readouterr().err
    assert notice.count("\n") == 1
    assert f"a {name} with " in notice
    assert "(states x, y, " in notice


def test_a_base_cannot_borrow_a_shipped_name(tmp_path: Path) -> None:
    text = OWN.read_text().replace("DRONE = System(", "_made = lambda: System(").replace('name="drone"', 'name="car"')
    path = tmp_path / "borrowed.py"
    path.write_text(text.replace("system = DRONE", "system = _made()").replace('"hover"', '"borrowed_hover"'))
    with pytest.raises(InputError, match=r"its system 'car' has the states x, y, z.* of that name x, y, yaw"):
        load_user_file(path)


def test_a_users_car_with_the_same_states_and_actions_is_driven() -> None:
    """Anyone who has a car's states and actions may use a car's barriers, under a name of its own."""
    car = load_model("car")
    other = replace_system(car, replace(CAR, name="my_car"))
    with pytest.raises(InputError, match="made for the system 'car', the model is of 'my_car'"):
        SafetyFilter.for_model(other, FilterSettings.for_robot("car"))
    settings = replace(FilterSettings.for_robot("car"), system="my_car")
    assert SafetyFilter.for_model(other, settings, car_scene()).decide(np.zeros(4), [0.0, 0.0], car.latent).known


def replace_system(model: PhysicsModel, system: System) -> Any:
    class Renamed:
        def __getattr__(self, name: str) -> Any:
            return getattr(model, name)

    renamed = Renamed()
    renamed.system = system  # type: ignore[attr-defined]
    return renamed


def test_barriers_that_are_made_of_others_read_what_these_read(strangers: dict[str, PhysicsModel]) -> None:
    model, drone = load_model("car"), strangers["drone"]
    obstacles = ObstacleBarrier([(2.0, 0.0, 0.3)], FOOTPRINT, braking_of(FilterSettings.for_robot("car")))
    rollout = RolloutBarrier(model, (0.0, 0.0), obstacles, 5, latent=model.latent)
    assert rollout.reads == rollout.starting_at(np.zeros(4)).reads == CAR.state_names
    assert RolloutBarrier(drone, (0.0, 0.0), lambda x: 1.0 - x[0], 5).reads == drone.system.state_names
    late = PendingActions(model, 2, (0.0, 0.0))
    assert late.barrier(obstacles).reads == CAR.state_names
    assert PendingActions(lambda x: (x, np.eye(4)[:, :2]), 2, (0.0, 0.0)).barrier(obstacles).reads == ()
    assert HigherOrderBarrier([lambda x: x[0], lambda x: x[1]], [1.0], reads=("s", "v")).reads == ("s", "v")
    for wrong in (
        lambda: RolloutBarrier(drone, (0.0, 0.0), obstacles, 5),
        lambda: PendingActions(drone, 2, (0.0, 0.0)).barrier(obstacles),
        lambda: SafetyFilter.for_model(drone, FilterSettings(**BOUNDS), [rollout]),
    ):
        with pytest.raises(InputError, match="reads the states x, y, yaw, speed, the model has x, y, z"):
            wrong()


def test_a_filter_over_pending_actions_is_of_its_models_system() -> None:
    late = PendingActions(load_model("car"), 2, (0.0, 0.0))
    with pytest.raises(InputError, match="made for the system 'pendulum', the model is of 'car'"):
        SafetyFilter(late.prediction, None, settings_named("pendulum"))
    safe = SafetyFilter(late.prediction, [late.barrier(part) for part in car_scene()], FilterSettings.for_robot("car"))
    assert safe.decide(late.state(np.zeros(4)), [0.1, 0.0], load_model("car").latent).status is Status.passed
