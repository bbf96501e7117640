"""The library and its names and units, effects from a user's own file, and the command that lists them all."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from safedpa.dynamics import load_model, load_user_file_everywhere, parse_model
from safedpa.dynamics.user_files import EFFECTS_VARIABLE
from safedpa.effects import effect, effects_of, load_effects, robots
from safedpa.errors import InputError
from safedpa_services.command_line.group import safedpa

DOCS = Path(__file__).parents[2] / "docs"


def code_blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def test_lookup_error_suggests_the_nearest_name() -> None:
    with pytest.raises(InputError, match="'quadratic_darg' is not known for robot 'car': did you mean 'quadratic"):
        effect("car", "quadratic_darg")
    with pytest.raises(InputError, match="effect 'wind' belongs to robot 'pendulum', not to 'car'"):
        effect("car", "wind")
    assert robots() == ("car", "differential_drive", "pendulum", "point")


def test_the_documentation_s_own_effect_works(tmp_path: Path) -> None:
    path = tmp_path / "my_effects.py"
    path.write_text(code_blocks("reference/effects.md", "python")[0])
    assert len(path.read_text().splitlines()) <= 30
    loaded = load_effects(path)
    assert [item.name for item in loaded] == ["grass_resistance"]
    model_text = code_blocks("reference/effects.md", "toml")[0]
    model = parse_model(model_text)
    plain = parse_model(model_text[: model_text.index("[[effects]]")])
    state, action = np.array([0.0, 0.0, 0.0, 3.0]), np.array([3.0, 0.0])
    assert model.step(state, action)[3] == pytest.approx(3.0 - 0.05 * 0.6 * np.tanh(2.0), abs=3e-3)
    assert plain.step(state, action)[3] == 3.0
    assert model.latent_names == ("grass_resistance.deceleration",)
    neutral = model.step(state, action, np.zeros(1))
    np.testing.assert_array_equal(neutral, plain.step(state, action))


def test_the_documentation_s_model_file_is_one() -> None:
    assert parse_model(code_blocks("reference/model-files.md", "toml")[0]).latent_names == ("base.speed_gain",)


def test_the_documentation_s_python_runs() -> None:
    script = code_blocks("reference/model-files.md", "python")[0]
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert str(load_model("car").latent_names) == run.stdout.strip()


def test_the_documented_errors_are_those_raised() -> None:
    page = (DOCS / "reference" / "model-files.md").read_text(encoding="utf-8")
    files = ("dynamics/test_model_file.py", "effects/test_equations.py")
    tests = "".join([(Path(__file__).parents[1] / name).read_text(encoding="utf-8") for name in files])
    rows = re.findall(r"^\| [a-zA-Z ']+ \| `(.*?)` \|$", page, flags=re.MULTILINE)
    assert len(rows) >= 8
    for row in rows:
        assert re.split(r": did|\?| known:|, steer; choose|: \.\.\.", row)[0] in tests


def test_loading_again_replaces(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    text = code_blocks("reference/effects.md", "python")[0]
    path.write_text(text)
    load_effects(path)
    path.write_text(text.replace("0.5, meaning", "0.7, meaning"))
    os.utime(path, (1, 1))
    load_effects(path)
    assert effect("car", "grass_resistance").parameters[0].typical == 0.7


GRASS = code_blocks("reference/effects.md", "python")[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "got no effect, wanted a class derived from"),
        ("import nothing_of_this_name", "could not be run: ModuleNotFoundError"),
        ("def f(:", "could not be run: SyntaxError"),
        (GRASS.replace("grass_resistance", "quadratic_drag"), "effect 'quadratic_drag' of robot 'car' exists already"),
        (GRASS.replace("grass_resistance", "grass resistance"), "name: got 'grass resistance', wanted letters"),
        (GRASS.replace('robot = "car"', 'robot = "cart"'), "robot: got 'cart'; did you mean 'car'?"),
        (GRASS.replace("    source =", "    sauce ="), "attribute 'source' is missing; give it in the class"),
        (GRASS.replace("0.0, 3.0, 0.5", "0.0, 3.0, 5.0"), "ValueError: deceleration: typical 5.0 lies outside 0.0 to"),
        (GRASS.replace("0.0, 3.0, 0.5", "3.0, 0.0, 0.5"), "ValueError: deceleration: got bounds 3.0 to 0.0"),
        (GRASS.replace("0.0, 3.0, 0.5", "0.1, 3.0, 0.5"), "ValueError: deceleration: neutral 0.0 lies outside 0.1"),
        (re.sub(r"(?s)parameters = \(.*?\n    \)", "parameters = ()", GRASS), "parameters: got (), wanted"),
    ],
)
def test_own_file_that_is_wrong_says_so(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_effects(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
    assert "grass_resistance" not in effects_of("car")


def test_own_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="got no Python file"):
        load_effects(tmp_path / "none.py")


def listed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert safedpa.run(["effects", *arguments]) == 0
    return capsys.readouterr().out


def test_command_shows_every_effect_in_a_table_and_in_one_json_document(capsys, tmp_path):
    document = json.loads(listed(capsys, "--json"))
    assert document["format"] == 1
    names = {(entry["robot"], entry["name"]) for entry in document["effects"]}
    assert names == {(robot, name) for robot in robots() for name in effects_of(robot)}
    drag = next(entry for entry in document["effects"] if entry["name"] == "quadratic_drag")
    assert drag["parameters"][0]["unit"] == "1/m"
    assert set(drag) == {"robot", "name", "stage", "equation", "parameters", "needs", "signature", "source"}
    only = json.loads(listed(capsys, "--json", "--robot", "pendulum"))
    assert {entry["robot"] for entry in only["effects"]} == {"pendulum"}
    shown = listed(capsys)
    assert all(name in shown for _, name in names)
    (tmp_path / "mine.py").write_text(GRASS)
    more = json.loads(listed(capsys, "--json", "--effects", str(tmp_path / "mine.py")))
    assert len(more["effects"]) == len(document["effects"]) + 1


def test_command_refuses_an_unknown_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["effects", "--robot", "cat"]) == 2
    error = capsys.readouterr().err
    assert error == "safedpa: robot: got 'cat'; did you mean 'car'? known: car, differential_drive, pendulum, point\n"


def test_documentation_holds_the_library_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    page = (DOCS / "reference" / "effects.md").read_text(encoding="utf-8")
    between = page.split("<!-- generated: effects_library -->")[1].split("<!-- end -->")[0]
    assert between.strip() == listed(capsys, "--markdown").strip()


def test_a_file_for_every_process_is_named_to_them(tmp_path: Path) -> None:
    path = tmp_path / "for_every_process.py"
    path.write_text(GRASS)
    load_user_file_everywhere(path)
    assert str(path) in os.environ[EFFECTS_VARIABLE]


def test_what_a_test_names_to_every_process_stays_in_it() -> None:
    assert "for_every_process.py" not in os.environ.get(EFFECTS_VARIABLE, "")


CAR: dict[str, dict[str, str]] = {
    "quadratic_drag": {"coefficient": "1/m"}, "viscous_drag": {"coefficient": "1/s"},
    "rolling_resistance": {"deceleration": "m/s2"}, "constant_force": {"ax": "m/s2", "ay": "m/s2"},
    "payload": {"mass_ratio": "1"}, "towed_load": {"mass_ratio": "1", "deceleration": "m/s2"},
    "understeer": {"gradient": "s2/m"}, "steering_offset": {"angle": "rad"}, "steering_gain": {"gain": "1"},
    "steering_asymmetry": {"difference": "1"}, "steering_saturation": {"limit": "rad"},
    "steering_lag": {"time_constant": "s"}, "steering_delay": {"seconds": "s"}, "drive_lag": {"time_constant": "s"},
    "drive_delay": {"seconds": "s"}, "actuator_delay": {"seconds": "s"}, "turning_drag": {"coefficient": "1/m"},
    "speed_command_gain": {"gain": "1"}, "drive_dead_zone": {"width": "1"}, "back_emf": {"coefficient": "1/s"},
    "battery_sag": {"rate": "1/s"}, "crosswind_drift": {"vx": "m/s", "vy": "m/s"},
    "tyre_slip": {"compliance": "s2/m"}, "speed_sensor_scale": {"scale": "1"},
}  # fmt: skip
PENDULUM: dict[str, dict[str, str]] = {
    "viscous_friction": {"coefficient": "N m s/rad"}, "coulomb_friction": {"torque": "N m"},
    "stribeck_friction": {"torque": "N m", "fading_rate": "rad/s"}, "tip_mass": {"mass": "kg"},
    "torque_offset": {"offset": "N m"}, "torque_gain": {"gain": "1"}, "torque_lag": {"time_constant": "s"},
    "torque_delay": {"seconds": "s"}, "wind": {"speed": "m/s", "drag": "N s2/m2", "upward": "m/s"},
    "angle_offset": {"offset": "rad"}, "backlash": {"width": "N m"},
    "spring": {"stiffness": "N m/rad", "rest_angle": "rad"},
}  # fmt: skip
POINT: dict[str, dict[str, str]] = {
    "constant_force": {"ax": "m/s2", "ay": "m/s2"}, "viscous_drag": {"coefficient": "1/s"},
    "quadratic_drag": {"coefficient": "1/m"}, "payload": {"mass_ratio": "1"}, "actuator_gain": {"gain": "1"},
    "actuator_delay": {"seconds": "s"},
}  # fmt: skip
ROBOTS = {"car": CAR, "pendulum": PENDULUM, "point": POINT}


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_library_of_a_robot_has_these_effects_with_these_parameters_and_units(robot: str) -> None:
    found = {name: {p.name: p.unit for p in item.parameters} for name, item in effects_of(robot).items()}
    assert found == ROBOTS[robot]
