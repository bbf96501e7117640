"""The file of perception: its keys, its refusals, the orders that change it, and which are kept."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from safedpa.bus import SURROUNDINGS, Answer, Bus, MemoryBroker, MemoryTransport, Request, SurroundingsMessage
from safedpa.bus.messages.requests import SENSE
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings, SourceSettings, Zone, load_perception
from safedpa.perception.overrides import SensorOverrides
from safedpa.perception.settings import parse_perception
from safedpa_services.command_line import sense
from safedpa_services.command_line.group import safedpa
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "sensing-zones.md"
SQUARE = "polygon = [[0, 0], [1, 0], [1, 1], [0, 1]]"
DOCK = f'[[zones]]\nname = "dock"\nkind = "ignored"\nframe = "map"\n{SQUARE}\n'
WET = f'[[zones]]\nname = "wet"\nkind = "closed"\nframe = "map"\n{SQUARE}\n'


def test_a_complete_file_is_taken_as_written() -> None:
    text = f"""
        format = 1
        [perception]
        fastest = 2
        open_air = true
        min_points = 2
        most = 100
        [sources.front]
        use = false
        [sources."rear laser"]
        time_out = 0.3
        min_points = 4
        {DOCK.replace('"map"', '"robot"')}use = false
        speed = [0, 0.5]
        robots = ["r1", "r2"]
        {WET}
    """
    square = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
    assert parse_perception(text) == PerceptionSettings(
        fastest=2.0,
        open_air=True,
        min_points=2,
        most=100,
        sources={"front": SourceSettings(use=False), "rear laser": SourceSettings(time_out=0.3, min_points=4)},
        zones=(
            Zone("dock", "ignored", square, "robot", (0.0, 0.5), ("r1", "r2"), use=False),
            Zone("wet", "closed", square),
        ),
    )


def test_nothing_in_the_file_is_what_is_without_one() -> None:
    assert parse_perception("") == PerceptionSettings()


def test_the_file_on_the_page_is_one(tmp_path: Path) -> None:
    block = PAGE.read_text().split("```toml\n")[1].split("```")[0]
    (tmp_path / "perception.toml").write_text(block, encoding="utf-8")
    (tmp_path / "keepout.yaml").write_text(
        "image: keepout.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", encoding="utf-8"
    )
    (tmp_path / "keepout.pgm").write_bytes(b"P5\n2 1\n255\n\x00\xfe")
    settings, _ = load_perception(tmp_path / "perception.toml")
    assert [zone.name for zone in settings.zones if zone.cells] == ["walls"]
    assert {zone.kind for zone in settings.zones} == {"ignored", "closed"}
    assert settings.sources


def zone(**changed: str) -> str:
    lines = {"name": '"z"', "kind": '"ignored"', "frame": '"map"', "polygon": SQUARE.partition(" = ")[2], **changed}
    return "[[zones]]\n" + "".join(f"{key} = {value}\n" for key, value in lines.items() if value)


REFUSED = (  # a file, and what its refusal says
    ("format = 2", "format: got 2, wanted 1"),
    ("[perceptoin]", "perceptoin: unknown key; did you mean 'perception'?"),
    ("perception = 3", "[perception]: got 3, wanted a table"),
    ("[perception]\nfastst = 1", "[perception] fastst: unknown key; did you mean 'fastest'?"),
    ("[perception]\nzones = []", "[perception] zones: unknown key"),
    ("[perception]\nfastest = '2'", "[perception] fastest: got '2', wanted a finite number"),
    ("[perception]\nfastest = nan", "[perception] fastest: got nan, wanted a finite number"),
    ("[perception]\nfastest = true", "[perception] fastest: got True"),
    ("[perception]\nfastest = 99", "perception fastest: got 99.0, wanted 0 to 20"),
    ("[perception]\nopen_air = 1", "[perception] open_air: got 1, wanted true or false"),
    ("[perception]\nmost = 9.5", "[perception] most: got 9.5, wanted a whole number"),
    ("[perception]\nmin_points = 0", "perception min_points: got 0, wanted 1 to 20"),
    ("[perception]\nmin_points = 21", "perception min_points: got 21, wanted 1 to 20"),
    ("sources = 1", "sources: got 1, wanted a table"),
    ("[sources]\nlaser = 1", "[sources.laser]: got 1, wanted a table"),
    ("[sources.laser]\nuses = true", "[sources.laser] uses: unknown key; did you mean 'use'?"),
    ("[sources.laser]\nuse = 'no'", "[sources.laser] use: got 'no', wanted true or false"),
    ("[sources.laser]\ntime_out = 0", "time_out: got 0.0, wanted 0.05 to 10"),
    ("[sources.laser]\nmin_points = 1.5", "[sources.laser] min_points: got 1.5, wanted a whole number"),
    ("[sources.laser]\nmin_points = 30", "min_points: got 30, wanted 1 to 20"),
    ("zones = 1", "zones: got int, wanted a [[zones]] for each"),
    ("zones = [1]", "zones: got 1, wanted a table"),
    (zone(name=""), "zone: name: missing; docs/guides/sensing-zones.md has a whole file"),
    (zone(kind=""), "zone z: kind: missing"),
    (zone(frame=""), "zone z: frame: missing"),
    (zone(polygon=""), "zone z: polygon: missing"),
    (zone(polgon="1"), "zone z: polgon: unknown key; did you mean 'polygon'?"),
    (zone(name="3"), "zone 3: name: got 3, wanted a text"),
    (zone(name="'a=b'"), "zone name: got 'a=b', wanted 1 to 60 letters"),
    (zone(kind="'ignred'"), "zone z: kind: got 'ignred'; did you mean 'ignored'?"),
    (zone(frame="'mop'"), "zone z: frame: got 'mop'; did you mean 'map'?"),
    (zone(kind="'closed'", frame="'robot'"), 'never get out of; wanted frame = "map"'),
    (zone(polygon="3"), "zone z: polygon: got 3, wanted a list"),
    (zone(polygon="[[0, 0], [1, 0], [1]]"), "zone z: polygon: got [1], wanted [x, y] in m"),
    (zone(polygon="[[0, 0], [1, 0], [1, 'a']]"), "zone z: polygon: got 'a', wanted [x, y] in m"),
    (zone(polygon="[[0, 0], [1, 0], [1, inf]]"), "zone z: polygon: got inf, wanted [x, y] in m"),
    (zone(polygon="[[0, 0], [1, 0], [1, 1e9]]"), "zone z: polygon: got a vertex beyond 100000 m"),
    (zone(polygon="[[0, 0], [1, 0]]"), "zone z: polygon: got 2 vertices, wanted 3 to 64"),
    (zone(polygon=str([[k, k * k] for k in range(65)])), "zone z: polygon: got 65 vertices, wanted 3 to 64"),
    (zone(polygon="[[0, 0], [1, 1], [2, 2]]"), "zone z: polygon: got no area"),
    (zone(polygon="[[0, 0], [1, 1], [1, 0], [0, 1]]"), "zone z: polygon: edge 1 meets edge 3"),
    (zone(polygon="[[0, 0], [2, 0], [2, 2], [1, 0], [0, 2]]"), "zone z: polygon: edge 1 meets edge 3"),
    (
        zone(polygon="[[0, 0], [1, 0], [1, 0], [0, 1]]"),
        "zone z: polygon: got the vertex [1.0, 0.0] twice, wanted each once",
    ),
    (zone(polygon="[[0, 0], [2, 0], [1, 0], [0, 1]]"), "zone z: polygon: edge 1 meets edge 2"),
    (
        zone(polygon="[[1, 0], [1, 1], [0, 1], [0, 0], [-1, 0], [0, 0.0]]"),
        "zone z: polygon: got the vertex [0.0, 0.0] twice",
    ),
    (zone(speed="1"), "zone z: speed: got 1, wanted [lowest, highest] in m/s"),
    (zone(speed="[0, 1, 2]"), "zone z: speed: got [0, 1, 2]"),
    (zone(speed="[1, 0]"), "zone z: speed: got 1 to 0 m/s, wanted 0 or more, the lower first"),
    (zone(speed="[-1, 1]"), "zone z: speed: got -1 to 1 m/s"),
    (zone(robots="'r1'"), "zone z: robots: got 'r1', wanted a list"),
    (zone(robots="[1]"), "zone z: robots: got 1, wanted a text"),
    (zone(use="1"), "zone z: use: got 1, wanted true or false"),
    (zone() + zone(), "zone z: got two of this name"),
    ("".join(zone(name=f"'z{k}'") for k in range(65)), "perception zones: got 65, wanted 64 at most"),
    ("[perception", "not TOML"),
)


@pytest.mark.parametrize(("text", "notice"), REFUSED)
def test_what_is_wrong_is_named(text: str, notice: str, tmp_path: Path) -> None:
    path = tmp_path / "perception.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refusal:
        load_perception(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert notice in str(refusal.value)


def test_polygons_may_bend_inwards_either_way_round_and_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    for corners in ([[0, 0], [2, 0], [2, 2], [1, 1], [0, 2]], [[0, 2], [1, 1], [2, 2], [2, 0], [0, 0]]):
        assert len(parse_perception(zone(polygon=str(corners))).zones) == 1
    with pytest.raises(InputError, match=r"nothing\.toml: cannot be read"):
        load_perception(tmp_path / "nothing.toml")


@pytest.mark.parametrize(
    ("phrase", "notice"),
    [
        ("up --headless --seconds 1 --laser --perception bad.toml", "did you mean 'fastest'?"),
        ("up --headless --seconds 1 --laser --perception nothing.toml", "cannot be read"),
        ("up --headless --seconds 1 --perception good.toml", "without --laser"),
        ("serve robot.toml --headless --policy goal_seeker --perception good.toml", "has no [[scans]]"),
    ],
)
def test_a_wrong_file_is_refused_before_any_process_starts(phrase, notice, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text("[perception]\nfastst = 1")
    Path("good.toml").write_text(DOCK)
    Path("robot.toml").write_text('format = 2\nname = "r1"\nrobot = "car"\n')
    assert safedpa.run(phrase.split()) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if not line.startswith("{")]  # events of a second ago may come late
    assert len(lines) == 1
    assert notice in lines[0]
    assert not Path("runs").exists()


def node_that_met_a_car(text: str, name: str = "r1") -> tuple[PerceptionNode, CarRobot]:
    room = Scene(0, None, (-3.0, 4.0, -3.0, 3.0), (), (0.0, 0.0, 0.0))
    robot = CarRobot(room, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),)))
    node = PerceptionNode(parse_perception(text))
    for _ in range(10):
        stepped(node, robot, name)
    return node, robot


def stepped(node: PerceptionNode, robot: CarRobot, name: str = "r1") -> SurroundingsMessage:
    for scan in robot.scans():
        node.hear(name, scan)
    (message,) = node.step(name, robot.state_message(), {}).values()
    assert isinstance(message, SurroundingsMessage)
    robot.advance()
    return message


def switch(*switches: str) -> Request:
    return Request(do="switch", switches=switches, who="a test")


def test_an_order_takes_effect_at_the_next_tick_and_reports_the_previous_state(capfd: pytest.CaptureFixture[str]):
    name = "watched"  # of each kind and robot the log has one event a second
    node, robot = node_that_met_a_car(DOCK + WET, name)
    assert stepped(node, robot, name).problems == ()
    answer = node.switches.answer(name, switch("source laser=off", "zone dock=off"))
    assert answer.ok
    assert "source laser off (was on), zone dock off (was on), from its next tick after 10 on" in answer.sentence
    assert "no source is left, so the filter brakes" in answer.sentence
    assert "switched off" in stepped(node, robot, name).problems[0]
    reported = node.switches.answer(name, Request(do="status")).sentence
    assert reported == (
        "robot 'watched': source laser off, zone dock off, zone wet on; no source is left, so the filter brakes"
    )
    node.rescue(name, robot.state_message(), "a fault")
    node.forget(name)
    assert "switched off" in stepped(node, robot, name).problems[0], "neither a fault nor silence brings it back"
    again = node.switches.answer(name, switch("source laser=on"))
    assert again.sentence.endswith("on, until another order or the end of perception, which has no file for orders")
    assert "was off" in again.sentence
    assert [stepped(node, robot, name).problems for _ in range(6)][-1] == ()
    events = [json.loads(line) for line in capfd.readouterr().err.splitlines() if line.startswith("{")]
    kinds = [(event["kind"], event["tick"]) for event in events if event["robot"] == name]
    assert ("perception.ignores", 0) in kinds
    assert ("perception.switched", 11) in kinds
    assert ("perception.source_off", 11) in kinds


@pytest.mark.parametrize(
    ("switches", "notice"),
    [
        (("source lasr=off",), "source 'lasr': the robot has none of that name; did you mean 'laser'?"),
        (("zone dok=on",), "did you mean 'dock'?"),
        (("zone laser=on",), "known: dock"),
        (("source laser=of",), "'source laser=of': wanted"),
        (("source =on",), "'source =on': wanted"),
        (("laser=on",), "'laser=on': wanted"),
        ((), "got 0 switches"),
        (("zone dock=on",) * 65, "got 65 switches"),
        (("zone dock=on", "zone dock=off"), "got on and off in one order"),
        (("zone dock=off", "zone wet2=off"), "zone 'wet2'"),
    ],
)
def test_an_order_that_is_wrong_in_one_part_changes_nothing(switches: tuple[str, ...], notice: str) -> None:
    elsewhere = WET.replace('"wet"', '"wet2"') + 'robots = ["r2"]\n'
    node, robot = node_that_met_a_car(DOCK + elsewhere)
    before = node.switches.answer("r1", Request(do="status"))
    with pytest.raises(InputError) as refusal:
        node.switches.answer("r1", switch(*switches))
    assert notice in str(refusal.value)
    assert node.switches.answer("r1", Request(do="status")) == before
    assert stepped(node, robot).problems == ()


def test_a_robot_that_was_not_heard_and_a_word_that_is_none_are_refused() -> None:
    node, _ = node_that_met_a_car(DOCK)
    with pytest.raises(InputError, match="did you mean 'r1'"):
        node.switches.answer("r11", switch("zone dock=off"))
    with pytest.raises(InputError, match="wanted switch or status"):
        node.switches.answer("r1", Request(do="stop"))


def test_the_command_asks_over_the_bus(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    node, robot = node_that_met_a_car(DOCK)
    broker, heard = MemoryBroker(), []

    def remember(name: str, request: Request | None, answer: Answer) -> None:
        heard.append((name, request, answer.ok))

    bus = Bus(MemoryTransport(broker), "fleet")
    monkeypatch.setattr(sense, "bus_of", lambda options: Bus(MemoryTransport(broker), options["fleet"]))
    assert safedpa.run(["sense", "r1", "--zone", "dock=off"]) == 1
    assert "no perception answers" in capsys.readouterr().err
    bus.answer_requests(node.switches.answer, report_progress=remember, kinds=(SENSE,))
    assert safedpa.run(["sense", "r1", "--source", "laser=off", "--zone", "dock=off", "--who", "me"]) == 0
    assert "source laser off (was on), zone dock off (was on)" in capsys.readouterr().out
    assert heard == [("r1", Request(do="switch", switches=("source laser=off", "zone dock=off"), who="me"), True)]
    assert stepped(node, robot).problems
    assert safedpa.run(["sense", "r1", "--json"]) == 0
    assert "source laser off, zone dock off" in json.loads(capsys.readouterr().out)["sentence"]
    assert safedpa.run(["sense", "r1", "--zone", "dok=off"]) == 2
    assert "did you mean 'dock'" in capsys.readouterr().err


ZONES = """
[[zones]]
name = "dock"
kind = "ignored"
frame = "map"
polygon = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
use = {dock}

[[zones]]
name = "wet"
kind = "closed"
frame = "map"
polygon = [[2.0, 0.0], [3.0, 0.0], [3.0, 1.0]]
use = {wet}
"""


def switches(path: Path | None, dock: str = "true", wet: str = "false", text: str = ZONES) -> SensorOverrides:
    """Of a process that has met a robot with two sources."""
    found = SensorOverrides(parse_perception(text.format(dock=dock, wet=wet)), path)
    found.in_force("r1", ("laser", "sonar"), 0)
    return found


def counted(one: SensorOverrides) -> str:
    return one.answer("r1", Request(do="status")).sentence.removeprefix("robot 'r1': ")


def order(one: SensorOverrides, *phrase: str) -> str:
    return one.answer("r1", Request(do="switch", switches=phrase)).sentence


def test_what_closes_and_which_sources_count_is_known_to_the_next_process(tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    notice = order(switches(path), "source sonar=off", "zone dock=off", "zone wet=on")
    assert notice.endswith("from its next tick after 0 on, until another order")
    after = switches(path)
    assert counted(after) == "source laser on, source sonar off, zone dock off, zone wet on"
    assert after.retained == {"r1": "source sonar off, zone dock off, zone wet on"}
    assert after.in_force("r2", ("laser", "sonar"), 0).off == frozenset(), "another robot's are its own"


def test_an_order_that_opens_a_zone_ends_with_the_process_as_the_answer_announces(tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    first = switches(path, dock="false", wet="true")
    notice = order(first, "source sonar=off", "zone dock=on", "zone wet=off")
    assert notice.endswith("until another order, zone dock, zone wet only until perception ends")
    assert counted(first) == "source laser on, source sonar off, zone dock on, zone wet off"
    assert counted(switches(path, dock="false", wet="true")) == (
        "source laser on, source sonar off, zone dock off, zone wet on"
    )


def test_what_is_stored_opens_no_zone_of_another_meaning_and_no_revoked_order(tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    order(switches(path), "zone wet=on", "source sonar=off")
    order(switches(path), "zone wet=off", "source sonar=on")
    assert counted(switches(path)) == "source laser on, source sonar on, zone dock on, zone wet off"
    path = tmp_path / "senses.json"
    order(switches(path), "zone wet=on")
    other = switches(path, dock="false", wet="false", text=ZONES.replace("closed", "ignored"))
    assert counted(other) == "source laser on, source sonar on, zone dock off, zone wet off"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no json",
        "[]",
        '{"format": 2, "switches": {}}',
        '{"format": 1}',
        '{"format": 1, "switches": {"r1": []}}',
        '{"format": 1, "switches": {"r1": {"source laser": 1}}}',
        '{"format": 1, "switches": {"r1": {"laser": true}}}',
        "\ud800",
    ],
)
def test_an_unreadable_file_brakes_every_robot_until_an_order_names_the_sources(text: str, tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    found = switches(path)
    assert str(path) in found.lost
    assert found.in_force("r1", ("laser", "sonar"), 1).off == {"laser", "sonar"}
    assert counted(found).endswith("no source is left, so the filter brakes")
    order(found, "source laser=on")
    assert found.in_force("r1", ("laser", "sonar"), 2).off == {"sonar"}
    again = switches(path)
    assert again.lost == ""
    assert again.in_force("r1", ("laser", "sonar"), 1).off == {"sonar"}
    assert again.in_force("r2", ("laser",), 1).off == {"laser"}, "there is still no order about the others"


def test_a_failing_disk_is_reported(tmp_path: Path) -> None:
    (tmp_path / "senses.json").mkdir()
    found = SensorOverrides(parse_perception(""), tmp_path / "missing" / "senses.json")
    found.in_force("r1", ("laser",), 0)
    notice = order(found, "source laser=off")
    assert "until another order or the end of perception: " in notice
    assert "cannot be written (No such file or directory)" in notice
    assert found.in_force("r1", ("laser",), 1).off == {"laser"}, "it holds all the same"
    assert switches(tmp_path / "senses.json").lost != "", "a folder is no file of orders"


@pytest.mark.parametrize("repeats", [True, False])
def test_a_source_that_may_repeat_its_scans_is_never_frozen(repeats: bool) -> None:
    robot = CarRobot(Scene.random(3), sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),), ()))
    node = PerceptionNode(PerceptionSettings(sources={"laser": SourceSettings(repeats=repeats)}))
    first, problems = None, set()
    for _ in range(20):
        state = robot.state_message()
        for scan in robot.scans():
            first = first or scan
            node.hear("r", replace(scan, ranges=first.ranges))
        message = node.step("r", state, {})[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        problems |= {one for one in message.problems if "frozen" in one}
        robot.advance()
    assert bool(problems) is not repeats
