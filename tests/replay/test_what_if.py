"""The same recorded states under another model, eta or margin; and driven again."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from tests.replay.conftest import built

from safedpa.bus import ReceivedMessage
from safedpa.bus.messages.service_info import setup_message
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, parse_perception
from safedpa.records import McapRecorder
from safedpa.replay.tape import RobotTape, read_tape
from safedpa.replay.what_if import WhatIfChange, summary_of, what_if
from safedpa.safety.defaults import margin_for
from safedpa_sim.closed_loop import drive
from safedpa_sim.recorded_drive import drive_again
from safedpa_sim.robots.__main__ import robot_parser
from safedpa_sim.robots.robot_factory import make_robot

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="module")
def box() -> RobotTape:
    return read_tape([GOLDEN / "car_box.mcap"])


def test_the_same_settings_decide_the_same(box: RobotTape) -> None:
    model = load_model("car")
    margin = margin_for(model)
    for change in (WhatIfChange(), WhatIfChange(model=model), WhatIfChange(model=model, margin=margin)):
        decisions = what_if(box, change)
        assert len(decisions) == 120
        assert not any(decision.differs for decision in decisions)
        summary = summary_of(decisions)
        assert summary.status_then == summary.status_now
        assert summary.smallest_h_then == summary.smallest_h_other


def test_a_wider_margin_and_a_smaller_eta_correct_earlier(box: RobotTape) -> None:
    then = summary_of(what_if(box, WhatIfChange()))
    wider, slower = summary_of(what_if(box, WhatIfChange(margin=0.2))), summary_of(what_if(box, WhatIfChange(eta=0.05)))
    for summary in (wider, slower):
        assert summary.status_now.get("passed", 0) < then.status_then["passed"]
        assert summary.smallest_h_now == then.smallest_h_now, "the states are the recorded ones"


def test_another_model_gets_latents_of_its_own(box: RobotTape) -> None:
    decisions = what_if(box, WhatIfChange(model=load_model("car_learned")))
    assert {decision.now.model for decision in decisions} != {decision.then.model for decision in decisions}
    assert "fallback" not in {decision.now.status for decision in decisions}
    assert any(decision.now.h_next != decision.then.h_next for decision in decisions)


def test_stale_inputs_stay_stale_under_another_margin() -> None:
    tape = read_tape([GOLDEN / "car_killed.mcap"])
    summary = summary_of(what_if(tape, WhatIfChange(margin=0.0)))
    assert summary.status_now["fallback"] == summary.status_then["fallback"] > 0


def test_a_number_is_the_margin_of_another_model_too(box: RobotTape) -> None:
    learned = load_model("car_learned")
    wide, narrow = (summary_of(what_if(box, WhatIfChange(model=learned, margin=margin))) for margin in (0.2, 0.0))
    assert wide.status_now.get("passed", 0) < narrow.status_now["passed"]


def test_only_the_stretch_asked_for_is_counted(box: RobotTape) -> None:
    assert summary_of(what_if(box, WhatIfChange(eta=0.1), (1.0, 1.999))).ticks == 20
    with pytest.raises(InputError, match="without any verdict"):
        summary_of(what_if(box, WhatIfChange(eta=0.1), (900.0, 901.0)))


def test_a_model_of_another_robot_and_a_margin_of_another_model_are_refused(box: RobotTape) -> None:
    with pytest.raises(InputError, match="2 states and 1 actions"):
        what_if(box, WhatIfChange(model=load_model("pendulum")))
    with pytest.raises(InputError, match="calibrated for model"):
        what_if(box, WhatIfChange(margin=margin_for(load_model("car_learned"))))


def test_the_same_drive_again_is_the_same_drive(box: RobotTape) -> None:
    driven = drive_again(box, WhatIfChange())
    assert driven["apart_from_tick"] is None
    assert all(then == now for then, now in driven["compared"].values())


def recorded(path: Path, *phrase: str, zones: str = "") -> RobotTape:
    """The tape of three seconds of a car that was started with these options, as its processes record them."""
    options = robot_parser().parse_args(["--lockstep", "--rate=20", "--seed=3", *phrase])
    services = ("adaptation", "policy", "safety_filter")
    made = {service: built(service, "car", None) for service in services}
    if options.laser:
        setup = replace(setup_message("perception", {}), settings=zones)
        made = {"perception": (PerceptionNode(parse_perception(zones)), setup), **made}
    with McapRecorder(path) as recorder:
        for tick, _ in enumerate(
            drive(make_robot(options), [node for node, _ in made.values()], 60, hear=hears(recorder))
        ):
            assert tick < 60
    tape = read_tape([path])
    tape.setups |= {name: [(0, setup)] for name, (_, setup) in made.items()}
    tape.setups["robot"] = [(0, setup_message("robot", vars(options)))]
    return tape


def hears(recorder: McapRecorder) -> Callable[[ReceivedMessage], None]:
    return lambda item: recorder.write(item.key, item.payload, 10**18, 10**18)


ZONES = """
[[zones]]
name = "wet"
kind = "closed"
frame = "map"
polygon = [[-9.0, -9.0], [9.0, -9.0], [9.0, 0.5], [-9.0, 0.5]]
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("phrase", "zones"),
    [
        (["--laser"], ""),
        (["--laser", "--people=3"], ""),
        (["--laser"], ZONES),
        (["--load=box", "--change=hitch", "--change-after=1"], ""),
        (["--force=0.01", "--wind=3"], ""),
    ],
)
def test_a_drive_is_repeated_with_all_options_of_the_robot(tmp_path: Path, phrase: list[str], zones: str) -> None:
    driven = drive_again(recorded(tmp_path / "run.mcap", *phrase, zones=zones), WhatIfChange())
    assert driven["apart_from_tick"] is None
    assert driven["ticks"] == 60
    assert all(then == now for then, now in driven["compared"].values())
    for word in phrase:
        name, _, value = word.removeprefix("--").partition("=")
        assert f"{name.replace('-', '_')}={value or True}" in driven["robot"]


def test_options_of_the_robot_are_taken_from_the_recording_and_those_of_its_process_are_not(box: RobotTape) -> None:
    phrase = ["--world=mass=2", "--name=other", "--fleet=other"]
    tape = replace(box, setups={**box.setups, "robot": [(0, setup_message("robot", options_with(*phrase)))]})
    with pytest.raises(InputError, match="--world: got mass=2 for a car, which has its own options"):
        drive_again(tape, WhatIfChange())
    tape.setups["robot"] = [(0, setup_message("robot", options_with(*phrase[1:])))]
    assert "other" not in drive_again(tape, WhatIfChange())["robot"]


def options_with(*phrase: str) -> dict[str, object]:
    return vars(robot_parser().parse_args(["--seed=3", *phrase]))


def test_a_closed_zone_makes_it_another_drive(tmp_path: Path) -> None:
    tape = recorded(tmp_path / "run.mcap", "--laser", zones=ZONES)
    tape.setups["perception"] = [(0, setup_message("perception", {}))]
    assert drive_again(tape, WhatIfChange())["apart_from_tick"] is not None
    tape.setups.pop("perception")
    with pytest.raises(InputError, match="no setup of perception in the recording"):
        drive_again(tape, WhatIfChange())


def test_under_another_eta_it_is_another_drive() -> None:
    tape = read_tape([GOLDEN / "pendulum.mcap"])
    driven = drive_again(tape, WhatIfChange(eta=0.2))
    assert driven["ticks"] == 100
    assert driven["apart_from_tick"] == 2, "the states until the first action are the same"
    (then, now), passed = driven["compared"]["verdicts corrected"], driven["compared"]["verdicts passed"]
    assert now > then > 0, "a smaller eta corrects earlier"
    assert passed == (100 - then, 100 - now)


def test_without_the_robot_s_options_it_cannot_be_driven_again(box: RobotTape) -> None:
    tape = read_tape([GOLDEN / "car_box.mcap"])
    tape.setups.pop("robot")
    with pytest.raises(InputError, match="options of robot 'r1' are not in the recording"):
        drive_again(tape, WhatIfChange())
