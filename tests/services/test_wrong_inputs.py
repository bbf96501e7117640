"""Wrong inputs on the command line: one line that says what to do, exit code 2, no input file changes."""

import hashlib
import shutil
from pathlib import Path

import pytest

from safedpa_services.command_line.group import START, safedpa

CAR = '[base]\nkind = "kinematic_bicycle"\ndrive = "speed_servo"\nwheelbase = 0.32\nacceleration_limit = 4.5\n'
FILES = {
    "drive.csv": "t,x,y,yaw,speed,target_speed,steer\n" + "".join(f"{k / 20},{k / 20},0,0,1,1,0\n" for k in range(200)),
    "foreign.csv": "time,px,py\n0,0,0\n1,1,1\n",
    "empty.csv": "",
    "text.csv": "t,x,y,yaw,speed,target_speed,steer\n0,a,0,0,1,1,0\n0.05,b,0,0,1,1,0\n",
    "bad.toml": "format = 1\nrobot = \n",
    "old.toml": 'format = 7\nrobot = "car"\n',
    "key.toml": f'format = 1\nrobot = "car"\n{CAR}speed_gian = 5.0\n',
    "effect.toml": f'format = 1\nrobot = "car"\n{CAR}speed_gain = 5.0\n[[effects]]\nname = "rolling_resistence"\n',
    "map.toml": 'format = 1\n[columns]\nx = "posx"\n',
    "unit.toml": 'format = 1\nrobot = "car"\n[columns]\nx = { from = "x", unit = "metre" }\n',
}

EXPERIMENTS = ("differential-drive", "meeting", "sensing", "sensing-curves", "sensing-margins", "long-logs")
EXPERIMENTS += ("safety-pays", "ros", "fleet-diagnosis", "point-story", "pendulum-story")
WRONG = (  # a command line, and what of the cure the line must hold
    ("diagnos car drive.csv", "did you mean 'diagnose'?"),
    ("experiment saftey", "did you mean 'safety'?"),
    ("bench everything", "'safedpa bench --help'"),
    ("compare cra drive.csv", "did you mean 'car'?"),
    ("compare kye.toml drive.csv", "did you mean 'key.toml'?"),
    ("compare key.toml drive.csv", "did you mean 'speed_gain'?"),
    ("compare effect.toml drive.csv", "did you mean 'rolling_resistance'?"),
    ("compare bad.toml drive.csv", "at line 2"),
    ("compare old.toml drive.csv", "wanted 1"),
    ("compare car drvie.csv", "did you mean 'drive.csv'?"),
    ("compare car empty.csv", "wanted a recording with a header and rows"),
    ("compare car foreign.csv", "name a column map"),
    ("compare car text.csv", "correct or remove the line"),
    ("compare car drive.csv --columns dart_car_colums", "did you mean 'dart_car_columns'?"),
    ("compare car drive.csv --columns map.toml", "such as 'car' in quotes"),
    ("compare car drive.csv --columns unit.toml", "unknown unit 'metre'"),
    ("compare car drive.csv --horizon -1", "such as 1"),
    ("compare car drive.csv --horizon soon", "'safedpa compare --help'"),
    ("compare car drive.csv --horizn 1", "Did you mean '--horizon'?"),
    ("compare car", "'safedpa compare --help'"),
    ("compare car drive.csv --out drive.csv", "choose another path with --out"),
    ("compare pendulum drive.csv", "name a column map"),
    ("compare car drive.csv --effects nothing.py", "wanted one that defines effects"),
    ("diagnose car", "wanted recordings of a robot"),
    ("diagnose car drive.csv --jobs 2", "--fleet"),
    ("add car rolling_resistence drive.csv --out m.toml", "did you mean 'rolling_resistance'?"),
    ("add car viscous_friction drive.csv --out m.toml", "belongs to robot 'pendulum'"),
    ("add car rolling_resistance drive.csv", "'safedpa add --help'"),
    ("add car rolling_resistance drive.csv --out nowhere/m.toml", "choose another path with --out"),
    ("predict car drive.csv --horizon 1 --out drive.csv", "or use --force"),
    ("effects --robot cra", "did you mean 'car'?"),
    ("demo --headless", "add --yes"),
    ("demo --picture nowhere/p.png", "create it"),
    ("workbench --session drive.csv", "wanted the session.json"),
    ("workbench --session nothing.json", "wanted the session.json"),
    ("up --robot cra", "did you mean 'car'?"),
    ("up --load chiar", "did you mean 'chair'?"),
    ("up --change headwnd", "did you mean 'headwind'?"),
    ("up --controller plannner", "did you mean 'planner'?"),
    ("up --wind 4", "--robot: pendulum"),
    ("up --robot pendulum --wind 40", "wanted 0 to 15 m/s"),
    ("up --robot pendulum --load chair", "--robot: car"),
    ("up --wind 4", "--wind: got one for a car"),
    ("up --task swing", "--task: got one for a car"),
    ("up --force 0.004", "--force: got one for a car, which has none"),
    ("up --robot pendulum --load box", "--load: got one for a pendulum"),
    ("up --robot pendulum --change hitch", "--change: got one for a pendulum"),
    ("up --robot pendulum --laser", "--laser: got sensors for the robot 'pendulum'"),
    ("up --robot pendulum --wind -1", "--wind: got -1.0"),
    ("up --robot pendulum --wind-direction 999", "--wind-direction: got 999.0"),
    ("up --robot pendulum --payload 11", "--payload: got 11.0, wanted 0 to 10 kg"),
    ("up --robot pendulum --dry-friction -1", "--dry-friction: got -1.0, wanted 0 to 10 N m"),
    ("up --robot pendulum --model car", "wanted a pendulum with torque"),
    ("up --robot pendulum --controller planner", "known: learned, random"),
    ("up --robot pendulum --rate 0", "--rate: got 0.0"),
    ("up --robot point --wind 3", "--wind: got one for a point"),
    ("up --robot point --load box", "--load: got one for a point"),
    ("up --robot point --force 0.02", "--force: got 0.02, wanted 0 to 0.0149 N"),
    ("up --robot point --task swing", "--task: got one for a point"),
    ("up --people 2", "without --laser"),
    ("up --laser --people 99", "wanted 0 to 12"),
    ("up --change-after -1", "--change-after: got -1.0"),
    ("up --robots 0", "--robots: got 0, wanted 1 to 8"),
    ("up --robots 9", "--robots: got 9, wanted 1 to 8"),
    ("up --robots 2 --secure", "--robots: got more than 1 with --secure"),
    ("up --rate 0", "wanted 1 to 500"),
    ("up --rate 501", "wanted 1 to 500"),
    ("up --model car_learned --rate 19", "--rate: got 19 ticks per second, wanted those of the model's training, 20"),
    ("up --model car_learned --rate 40", "--rate: got 40 ticks per second, wanted those of the model's training, 20"),
    ("up --model dart_car --change hitch", "--change: got 'hitch' for a car with throttle, steer, which has"),
    ("up --model dart_car --settings car", "--settings car: settings: got bounds of -0.6 to 2 1 for throttle"),
    ("up --model dart_car --controller planner", "controller 'planner' of a car"),
    ("up --model dart_car --robot pendulum", "wanted a pendulum with torque"),
    ("up --seconds -3", "wanted 0 (until Ctrl-C) or more"),
    ("up --model cra", "did you mean 'car'?"),
    ("up --model dfki_pendulum", "wanted a car with target_speed, steer or throttle, steer"),
    ("up --model dart_car --load chair", "--load: got 'chair' for a car with throttle, steer, which has none"),
    ("up --settings crar", "did you mean 'car'?"),
    ("up --margin carr", "did you mean 'car'?"),
    ("up --seed -1", "wanted 0 or more"),
    ("up --headless --listen nonsense", "wanted endpoints such as tcp/robot:7447"),
    ("status --connect nonsense", "wanted endpoints such as tcp/robot:7447"),
    ("stop --connect nonsense", "wanted endpoints such as tcp/robot:7447"),
    ("workbench --connect nonsense", "wanted endpoints such as tcp/robot:7447"),
    ("workbench car drive.csv --horizon nan", "such as 1"),
    ("workbench car nosuch.csv", "nosuch.csv: no such file; "),
    ("workbench cra drive.csv", "did you mean 'car'"),
    ("certificates keys --days nan", "wanted more than 0"),
    ("compare car run", "name the recording in it: run/recording.mcap"),
    ("up --name a/b", "use letters, digits"),
    ("up --secure --listen tcp/0.0.0.0:7447", "docs/guides/security.md"),
    ("calibrate nothing.mcap --out m.toml", "wanted a recording"),
    ("export drive.csv --format csv --out o.csv", "wanted a recording of the bus"),
    ("replay nothing.mcap", "no such file"),
    ("screenshot nothing.rrd --out p.png", "wanted a recording that the dashboard wrote"),
    ("export run/recording.mcap --format csv --out run/recording.mcap", "choose another path with --out"),
    ("export run/recording.mcap --format ros2 --out run/recording.mcap", "choose another path with --out"),
    ("calibrate run/recording.mcap --out run/recording.mcap", "choose another path with --out"),
    ("calibrate run/recording.mcap --out nowhere/m.toml", "choose another path with --out"),
    ("screenshot drive.csv --out p.png", "wanted one that the dashboard wrote"),
    ("experiment safety --seeds 1 --seconds nan", "wanted more than 0"),
    ("experiment controllers --seeds 1 --seconds inf", "wanted more than 0"),
    *((f"experiment {name} --seconds inf", "more than 0") for name in EXPERIMENTS),
    ("replay run --eta 0.1 --out drive.csv/ticks.csv", "drive.csv"),
    ("replay run --out run/again.mcap", "would count as a recording"),
    ("replay run/recording.mcap --out run/recording.mcap", "would count as a recording"),
    ("train cra", "did you mean 'car'?"),
    ("train pendulum --small", "available for car, point"),
    ("experiment faults --small --only kill", "leave --small out"),
    ("experiment bad-data text.csv --out bad", "wanted a number in every cell"),
    ("experiment bad-data empty.csv --out bad", "wanted the native ones of a car"),
    ("bench fleet --robots 0", "wanted 1 to 1000"),
    ("bench all --only filtr", "did you mean 'filter'?"),
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "run").mkdir()
    shutil.copy(Path(__file__).parents[1] / "replay" / "golden" / "car_box.mcap", tmp_path / "run" / "recording.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("line", "cure"), WRONG, ids=[line for line, _ in WRONG])
def test_a_wrong_input_is_answered_by_one_line_that_says_what_to_do(line, cure, folder, capsys):
    before = {path: hashlib.md5(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}
    assert safedpa.run(line.split()) == 2
    notice = capsys.readouterr()
    assert notice.out == ""
    assert notice.err.startswith("safedpa: ")
    assert notice.err.count("\n") == 1
    assert cure in notice.err
    left = {path: hashlib.md5(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}
    assert left == before


def test_without_arguments_it_says_what_to_do_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run([]) == 0
    notice = capsys.readouterr().out
    assert notice.strip() == START.strip()
    assert notice.index("safedpa up") < notice.index("safedpa diagnose")
    assert max(map(len, notice.splitlines())) <= 120


def test_the_options_of_up_are_grouped_under_headings_and_none_is_lost(capsys: pytest.CaptureFixture[str]) -> None:
    from safedpa_services.command_line.up import GROUPS, command

    assert safedpa.run(["up", "--help"]) == 0
    notice = capsys.readouterr().out
    assert [notice.index(f"{heading}:") for heading in GROUPS] == sorted(
        notice.index(f"{heading}:") for heading in GROUPS
    )
    for item in command.params:
        assert item.opts[0] in notice
    assert {name for names in GROUPS.values() for name in names} == {item.name for item in command.params}


@pytest.mark.parametrize(
    ("phrase", "begun", "wanted"),
    [
        (["comp"], "", {"compare"}),
        (["compare"], "dart", {"dart_car"}),
        (["add", "pendulum"], "viscous", {"viscous_friction"}),
        (["up", "--robot"], "p", {"pendulum", "point"}),
        (["up", "--model"], "car_l", {"car_learned"}),
    ],
)
def test_completion_knows_commands_models_effects_and_robots(phrase: list[str], begun: str, wanted: set[str]) -> None:
    from click.shell_completion import ShellComplete

    given, last = (phrase[:-1], phrase[-1]) if not begun else (phrase, begun)
    found = ShellComplete(safedpa, {}, "safedpa", "_SAFEDPA_COMPLETE").get_completions(given, last)
    assert wanted <= {item.value for item in found}
