"""The fleet overview: counts, shares and alerts, and their presentation."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from safedpa.bus import MemoryTransport, RosterEntry, SurroundingsMessage
from safedpa.bus.monitor import fleet_alerts
from safedpa_services.command_line.status import document_of
from safedpa_services.command_line.status_table import render_status_table


def sentences(fleet: Any, level: str) -> list[str]:
    return [concern.sentence for concern in fleet_alerts(fleet.overview) if concern.level == level]


def drawn(fleet: Any, width: int, height: int = 0) -> list[str]:
    console = Console(width=width, height=height or 50, record=True, file=None, force_terminal=False)
    with console.capture() as captured:
        console.print(render_status_table(document_of(fleet.overview), width, height))
    return captured.get().splitlines()


def test_a_healthy_fleet_raises_no_concern(fleet: Any) -> None:
    fleet.drive(3)
    assert fleet_alerts(fleet.overview) == []
    document = document_of(fleet.overview)
    assert document["healthy"]
    assert [row["robot"] for row in document["robots"]] == ["r1", "r2", "r3"]
    assert {row["service"] for row in document["services"]} == {"adaptation", "policy", "safety_filter", "recorder"}
    row = document["robots"][0]
    assert row["rate"] == pytest.approx(20.0, rel=0.15)
    assert row["passed"] == 1.0
    assert (row["sense_to_act_p50"], row["sense_to_act_p99"]) == (0.0042, 0.0042)
    assert row["models"]["safety_filter"] == "0123456789ab"
    assert json.loads(json.dumps(document)) == document


@pytest.mark.parametrize(("promised", "coverage"), [(0.99, 0.95), (0.99, -1.0), (0.0, 0.0), (-1.0, -1.0)])
def test_the_row_of_a_robot(fleet: Any, promised: float, coverage: float) -> None:
    """A margin without a promised coverage, and a coverage without any step, are left empty."""
    state = {"lockstep": True, "goals_reached": 3, "collisions": 1}
    verdict = {"h_now": 0.25, "margin": 0.125, "promised": promised, "coverage": coverage, "status": "corrected"}
    fleet.drive(1, 1.0, r1={"state": state, "verdict": verdict})
    (row,) = document_of(fleet.overview)["robots"]
    reported = {
        "robot": "r1", "verdict": "corrected", "h": 0.25, "margin": 0.125, "wanted_rate": 20.0, "lockstep": True,
        "time": 0.95, "goals": 3, "collisions": 1, "late": 0.0, "diagnosis": "", "corrected": 1.0, "passed": 0.0,
        "promised": None if promised < 0.0 else promised, "coverage": None if coverage < 0.0 else coverage,
    }  # fmt: skip
    assert {name: row[name] for name in reported} == pytest.approx(reported)


def test_a_document_has_the_recorded_names(fleet: Any) -> None:
    """``status.json`` has them; programs of the users read them."""
    fleet.drive(1)
    fleet.overview.robots["r1"].state = dataclasses.replace(fleet.overview.robots["r1"].state, sources=("front",))
    document = document_of(fleet.overview)
    names = {
        "document": sorted(document),
        "robots": sorted(document["robots"][0]),
        "services": {row["service"]: sorted(row) for row in document["services"]},
    }
    assert names == json.loads(Path(__file__).with_name("status.json").read_text(encoding="utf-8"))


def test_texts_begin_below_the_title_of_their_column(fleet: Any) -> None:
    fleet.drive(2)
    lines = drawn(fleet, 220)
    title, row = next((line, below) for line, below in pairwise(lines) if line.startswith("robot"))
    for name, shown in (("robot", "r1"), ("health", "well"), ("verdict", "passed"), ("model", "0123456789ab")):
        assert row.index(shown) == title.index(name), name


def test_a_robot_that_was_asked_for_and_is_not_there_is_no_healthy_fleet(fleet: Any) -> None:
    fleet.overview.robot = "r9"  # what the services say was heard, and nothing of this robot
    fleet.beat("recorder")
    fleet.overview.listen(0.0)
    document = document_of(fleet.overview)
    assert not document["healthy"]
    assert [(row["robot"], row["sentence"]) for row in document["concerns"]] == [("r9", "sends nothing")]


def test_the_age_of_each_source_and_what_is_wrong_with_one_are_reported(fleet: Any) -> None:
    fleet.drive(2)
    robot = fleet.overview.robots["r1"]
    robot.state = dataclasses.replace(robot.state, sources=("front", "rear"))
    assert document_of(fleet.overview)["robots"][0]["sources"] == {"front": None, "rear": None}
    stamp = {"epoch": robot.state.epoch, "tick": robot.state.tick, "robot_time": 1.0, "publish_time": 0.0}
    seen = SurroundingsMessage(
        **stamp, points=(), movers=(), hidden=(), ages=(0.05, -1.0), problems=("nothing was heard of the source rear",)
    )
    robot.hear(seen, fleet.overview.clock())
    assert document_of(fleet.overview)["robots"][0]["sources"] == {"front": pytest.approx(0.175), "rear": None}
    assert "nothing was heard of the source rear" in sentences(fleet, "trouble")
    assert any("front 0.18 rear -" in line for line in drawn(fleet, 240))
    assert not any("switched" in notice for notice in sentences(fleet, "attention"))
    robot.hear(dataclasses.replace(seen, ordered="source rear off, by Ada"), fleet.overview.clock())
    assert "switched: source rear off, by Ada" in sentences(fleet, "attention")


@pytest.mark.parametrize(
    ("changes", "level", "reported"),
    [
        (
            {"verdict": {"status": "fallback", "sentence": "No decision: the nominal action is stale."}},
            "trouble",
            "the nominal action is stale",
        ),
        ({"state": {"applied_by": "watchdog"}}, "trouble", "100.0 % of the last ticks were late"),
        ({"verdict": {"status": "stopped", "sentence": "Ordered by Ada."}}, "attention", "Ordered by Ada."),
        ({"verdict": {"status": "relaxed"}}, "attention", "100.0 % of the last verdicts relaxed"),
        ({"state": {"collisions": 2}}, "attention", "2 collisions"),
    ],
)
def test_a_fault_of_a_robot_is_reported_and_the_worst_robot_comes_first(fleet, changes, level, reported):
    fleet.drive(2, r2=changes)
    assert any(reported in sentence for sentence in sentences(fleet, level)), sentences(fleet, level)
    assert document_of(fleet.overview)["healthy"] is (level != "trouble")
    assert document_of(fleet.overview)["robots"][0]["robot"] == "r2", "the worst comes first"


@pytest.mark.parametrize(
    ("commands", "nominal", "is_healthy"),
    [("ackermann_msgs/msg/AckermannDriveStamped", (1.0, 0.0), True), ("", (1.0, 0.0), False), ("twist", (), False)],
)
def test_a_ros_robot_with_a_policy_of_its_own_needs_no_policy_service(fleet, commands, nominal, is_healthy):
    """The gateway forwards its nominal actions; it is no policy and sends a heartbeat as the robot."""
    fleet.drive(1, silent=("policy",), r1={"verdict": {"nominal": nominal}})
    fleet.beat("robot", "r1", pid=2001, commands=commands)
    fleet.overview.listen(0.0)
    assert sentences(fleet, "trouble") == ([] if is_healthy else ["policy: no heartbeat"])
    assert document_of(fleet.overview)["healthy"] is is_healthy


def test_a_policy_on_the_roster_is_missing_however_good_the_nominal_actions_are(fleet):
    fleet.roster = (RosterEntry(kind="service", name="policy", silent_for=-1.0),)
    fleet.drive(1, silent=("policy",))
    fleet.beat("robot", "r1", pid=2001, commands="twist")
    fleet.overview.listen(0.0)
    assert any("policy" in sentence for sentence in sentences(fleet, "trouble"))


def test_missing_silent_failing_and_disagreeing_services(fleet: Any) -> None:
    fleet.drive(1, silent=("policy",))
    assert sentences(fleet, "trouble") == ["policy: no heartbeat"]
    fleet.beat("policy", "r1", model="ba9876543210")
    fleet.overview.listen(0.0)
    assert "services use different models" in sentences(fleet, "trouble")[0]
    fleet.beat("policy", "r1", state="failing", detail="no goal")
    fleet.overview.listen(0.0)
    assert sentences(fleet, "trouble")[0] == "policy: failing, no goal"


def test_a_fleet_without_a_recorder_is_worth_a_look(fleet: Any) -> None:
    fleet.drive(1, silent=("recorder",))
    assert sentences(fleet, "attention") == ["no recorder is running"]


def test_a_process_that_was_replaced_is_no_concern(fleet: Any) -> None:
    fleet.drive(1)
    fleet.beat("recorder", pid=1, acknowledged=1)
    fleet.overview.listen(0.0)
    fleet.now += 1.0
    fleet.drive(1)
    fleet.now += 0.6
    document = document_of(fleet.overview)
    assert [row["pid"] for row in document["services"] if row["service"] == "recorder"] == [1008]
    assert document["concerns"] == []


def test_findings_and_versions_are_worth_a_look(fleet: Any) -> None:
    fleet.drive(1)
    fleet.finding("r1", "watching", "nothing is missing")
    fleet.beat("recorder", software="1.2.4", acknowledged=1, free_bytes=50_000_000_000)
    fleet.overview.listen(0.0)
    assert sentences(fleet, "attention") == ["processes of different versions: 1.2.3, 1.2.4"]
    fleet.finding("r1", "raised", "speed: 0.22 m/s less than predicted")
    fleet.overview.listen(0.0)
    assert "raised: speed: 0.22 m/s less than predicted" in sentences(fleet, "attention")
    assert sentences(fleet, "trouble") == []


def test_bytes_that_are_no_message_are_counted(fleet: Any) -> None:
    MemoryTransport(fleet.broker).put("safedpa/test/r1/state", b"garbage", never_drop=False)
    fleet.overview.listen(0.0)
    assert fleet.overview.refused == 1
    assert fleet.overview.is_empty


@pytest.mark.parametrize("width", [80, 120, 200])
@pytest.mark.parametrize("robots", [1, 4, 40])
def test_the_picture_fits_every_terminal(fleet: Any, width: int, robots: int) -> None:
    fleet.drive(robots, 1.0, r1={"verdict": {"status": "fallback", "sentence": "No decision: " + "very long " * 30}})
    for height in (0, 24, 50):
        lines = drawn(fleet, width, height)
        assert max(map(len, lines)) <= width
        assert not height or len(lines) <= height
        assert lines[0].startswith("fleet test  not healthy")
        rows = [line for line in lines if line.startswith("r1 ")]
        assert rows, "the worst robot is always shown"
        assert "trouble" in rows[0]
        assert any("safety_filter" in line for line in lines)
    folded = [line for line in lines if "further robots" in line]
    assert bool(folded) is (robots == 40)


def test_the_same_concern_of_many_robots_is_one_line(fleet: Any) -> None:
    fleet.drive(6, 1.0, silent=("policy",))
    reported = [line for line in drawn(fleet, 120) if "policy: no heartbeat" in line]
    assert reported == ["r1, r2, r3, r4 and 2 more: policy: no heartbeat"]
