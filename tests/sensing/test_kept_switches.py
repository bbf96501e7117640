"""Orders to perception outlive its process, but for what opens a zone."""

from __future__ import annotations

from pathlib import Path

import pytest

from safedpa.bus import Request
from safedpa.perception.settings import parse_perception
from safedpa.perception.switches import Switches

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


def switches(path: Path | None, dock: str = "true", wet: str = "false", text: str = ZONES) -> Switches:
    """Of a process that has met a robot with two sources."""
    found = Switches(parse_perception(text.format(dock=dock, wet=wet)), path)
    found.in_force("r1", ("laser", "sonar"), 0)
    return found


def counted(one: Switches) -> str:
    return one.answer("r1", Request(do="status")).sentence.removeprefix("robot 'r1': ")


def order(one: Switches, *words: str) -> str:
    return one.answer("r1", Request(do="switch", switches=words)).sentence


def test_what_closes_and_which_sources_count_is_known_to_the_next_process(tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    said = order(switches(path), "source sonar=off", "zone dock=off", "zone wet=on")
    assert said.endswith("from its next tick after 0 on, until another order")
    after = switches(path)
    assert counted(after) == "source laser on, source sonar off, zone dock off, zone wet on"
    assert after.kept == {"r1": "source sonar off, zone dock off, zone wet on"}
    assert after.in_force("r2", ("laser", "sonar"), 0).off == frozenset(), "another robot's are its own"


def test_an_order_that_opens_a_zone_ends_with_the_process_as_the_answer_announces(tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    first = switches(path, dock="false", wet="true")
    said = order(first, "source sonar=off", "zone dock=on", "zone wet=off")
    assert said.endswith("until another order, zone dock, zone wet only until perception ends")
    assert counted(first) == "source laser on, source sonar off, zone dock on, zone wet off"
    assert counted(switches(path, dock="false", wet="true")) == (
        "source laser on, source sonar off, zone dock off, zone wet on"
    )


def test_a_revoked_order_is_not_stored_any_longer(tmp_path: Path) -> None:
    path = tmp_path / "senses.json"
    order(switches(path), "zone wet=on", "source sonar=off")
    order(switches(path), "zone wet=off", "source sonar=on")
    assert counted(switches(path)) == "source laser on, source sonar on, zone dock on, zone wet off"


def test_a_stored_order_does_not_open_a_zone_whose_meaning_changed_in_a_new_file(tmp_path: Path) -> None:
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
    found = Switches(parse_perception(""), tmp_path / "missing" / "senses.json")
    found.in_force("r1", ("laser",), 0)
    said = order(found, "source laser=off")
    assert "until another order or perception's end: " in said
    assert "cannot be written (No such file or directory)" in said
    assert found.in_force("r1", ("laser",), 1).off == {"laser"}, "it holds all the same"
    assert switches(tmp_path / "senses.json").lost != "", "a folder is no file of orders"
