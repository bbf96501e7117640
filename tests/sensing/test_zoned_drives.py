"""Drives behind the zones of Nav2's parameters, by other sources, and shares of goals on the same drives."""

from pathlib import Path

import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments.sensing.experiment import Drive, at_most_95, goal_shares, page_of, run_drive
from safedpa_lab.experiments.sensing.losses import CHANGES, losses_experiment
from safedpa_lab.experiments.sensing.losses import page_of as losses_page
from safedpa_lab.experiments.sensing.planar import PlanarDrive, planar_experiment, run_planar_drive
from safedpa_lab.experiments.sensing.planar import page_of as planar_page

ZONE = """
collision_monitor:
  ros__parameters:
    polygons: ["Zone"]
    Zone: {type: "circle", radius: %s, action_type: "stop", min_points: 1}
    observation_sources: ["scan"]
    scan: {type: "scan", topic: "/scan"}
"""


def monitor(folder: Path, text: str = ZONE % "9.0") -> Path:
    path = folder / "monitor.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("robot", ["differential_drive", pytest.param("omni", marks=pytest.mark.long)])
def test_a_stop_zone_as_large_as_the_field_stops_a_robot_and_its_differences_are_listed(robot, tmp_path: Path) -> None:
    path = monitor(tmp_path)
    found = run_planar_drive(PlanarDrive(robot, 1000, 0.5, 0, monitor=str(path)))
    assert found["way"] < 0.02
    assert found["zones_acted"] >= 9
    result = planar_experiment([1000], 0.1, 0, 1, [robot], (), [path])
    page = planar_page({**result, "experiment": "sensing-robots"})
    assert "laser, zones of monitor.yaml" in page
    assert "- monitor.yaml: scan: source_timeout 2 s becomes 1 s" in page


def test_a_zone_whose_shape_comes_from_a_topic_is_refused_and_so_is_a_robot_without_twist(tmp_path: Path) -> None:
    text = ZONE.replace('type: "circle", radius: %s', 'type: "polygon", polygon_sub_topic: "/shape"')
    with pytest.raises(InputError, match=r"Zone: got a shape from the topic /shape"):
        planar_experiment([1000], 0.1, 0, 1, ["differential_drive"], (), [monitor(tmp_path, text)])
    with pytest.raises(InputError, match=r"--monitor: got the robot 'drone'"):
        planar_experiment([1000], 0.1, 0, 1, ["drone"], (), [monitor(tmp_path)])


@pytest.mark.parametrize("source", ["depth", pytest.param("cloud", marks=pytest.mark.long)])
@pytest.mark.parametrize("guard", ["safedpa", pytest.param("monitor", marks=pytest.mark.long)])
def test_a_car_drives_by_another_source_alone_and_so_do_its_peers(source: str, guard: str) -> None:
    found = run_drive(Drive("pillars", 1001, 2.0, 1.5, guard, policy="way_seeker", source=source))
    assert found["way"] > 0.3
    assert not found["moving"]


def test_each_lost_assumption_is_a_row_next_to_perfect_knowledge(tmp_path: Path) -> None:
    names = ("as it is", "the laser looks over the load", "who stops is at rest after 2 s")
    changes, record = {name: CHANGES[name] for name in names}, tmp_path / "drives.jsonl"
    found = [losses_experiment([1001], 0.5, 1, 1, ["box"], record=record, changes=changes) for _ in range(2)]
    assert found[0] == found[1], "drives of a record are not repeated"
    assert [(row["load"], row["change"], row["drives"]) for row in found[0]["rows"]] == [
        ("box", one, 1) for one in names
    ]
    page = losses_page({**found[0], "experiment": "sensing-losses"})
    assert "| box | the laser looks over the load | 1 | 0 |" in page


def drives(guard: str, goals: dict[str, tuple[int, int]], moving: tuple[str, ...] = ()) -> list[dict[str, object]]:
    return [
        {"scene": "people", "load": load, "seed": seed, "guard": guard, "goals": goals[load][seed], "moving": moving}
        for load in goals
        for seed in (0, 1)
    ]


def test_goals_are_a_share_of_those_on_the_same_drives_by_load_and_for_all() -> None:
    found = drives("safedpa", {"none": (3, 4), "box": (1, 0)}) + drives("monitor", {"none": (5, 5), "box": (2, 0)})
    found += drives("nothing", {"none": (9, 9), "box": (9, 9)}, ("a wall",))
    shares = goal_shares(found)
    by_kind = {(one["load"], one["guard"]): one for one in shares}
    assert by_kind["none", "monitor"]["share"][0] == pytest.approx(0.7)
    assert by_kind["all", "monitor"]["share"][0] == pytest.approx(8 / 12)
    assert by_kind["all", "nothing"]["contacts"] == 4
    page = page_of({"seeds": [0, 1], "loads": ["none", "box"], "seconds": 5.0, "rows": [], "shares": shares})
    assert "most goals: nav2's collision monitor, its defaults (1.2 s, 6 points); this filter reaches 0.67" in page
    assert goal_shares(drives("monitor", {"none": (1, 1)})) == []


def test_the_one_sided_bound_covers_its_share() -> None:
    assert at_most_95(0, 100) == pytest.approx(1.0 - 0.05 ** (1 / 100))
    assert at_most_95(2, 2) == 1.0
