"""Which columns and which clock a proposed map names."""

from pathlib import Path

import numpy as np
import pytest
from tests.records.test_joined_topics import Log, at

import safedpa
from safedpa.errors import RunError
from safedpa.records import load_run
from safedpa.records.column_map.column_map import DerivedColumn, SourceColumn
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.column_map.form import guess_columns, map_text
from safedpa.records.column_map.propose import propose_map, propose_sources
from safedpa.robots.car.system import CAR
from safedpa.robots.differential_drive.system import DIFFERENTIAL_DRIVE
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.systems import System
from safedpa_lab.log_faults.drive import Topics, drive_of
from safedpa_lab.log_faults.write import topic_map, write_topics


@pytest.mark.parametrize(
    ("system", "names", "wanted"),
    [
        (CAR, ["pos_east_mm", "servo_deg_right", "wheelspeed_kmh"], {
            "x": ("pos_east_mm", "mm", False), "steer": ("servo_deg_right", "deg", True),
            "speed": ("wheelspeed_kmh", "km/h", False),
        }),
        (CAR, ["cmd_speed", "vehicleSpeed [m/s]"], {
            "speed": ("vehicleSpeed [m/s]", "m/s", False), "target_speed": ("cmd_speed", None, False),
        }),
        (PENDULUM, ["sec", "phi_deg", "omega_deg_s", "motor_torque_Nm"], {
            "t": ("sec", None, False), "angle": ("phi_deg", "deg", False), "rate": ("omega_deg_s", "deg/s", False),
            "torque": ("motor_torque_Nm", "N m", False),
        }),
        (DIFFERENTIAL_DRIVE, ["gyro_z_dps", "cmd_turn_rate"], {
            "turn_rate": ("gyro_z_dps", "deg/s", False), "target_turn_rate": ("cmd_turn_rate", None, False),
        }),
    ],
)  # fmt: skip
def test_columns_are_recognised_with_their_unit_and_direction(system: System, names: list[str], wanted: dict) -> None:
    lines = {line.target: line for line in guess_columns(system, names)}
    for target, (source, unit, flip) in wanted.items():
        assert (lines[target].source, lines[target].unit or None, lines[target].flip) == (source, unit, flip)


def test_a_measured_speed_is_preferred_to_a_derived_one() -> None:
    names = ["t", "x", "y", "yaw", "wheel_speed", "target_speed", "steer"]
    for given, kind in ((names, SourceColumn), ([name for name in names if name != "wheel_speed"], DerivedColumn)):
        assert isinstance(parse_column_map(map_text(CAR, guess_columns(CAR, given))).columns["speed"], kind)


def test_a_twist_gives_the_commands_of_a_differential_drive() -> None:
    measured = ["/odom:twist.twist.linear.x", "/odom:twist.twist.angular.z"]
    wanted = ("speed", "turn_rate", "target_speed", "target_turn_rate")
    for commands in (
        ["/cmd_vel:linear.x", "/cmd_vel:angular.z"],
        ["/cmd_vel:twist.linear.x", "/cmd_vel:twist.angular.z"],
    ):
        assert list(propose_sources(wanted, [*commands, *measured]).values()) == [*measured, *commands]
        assert set(propose_sources(wanted, commands)) == {"target_speed", "target_turn_rate"}


@pytest.mark.parametrize(("late", "clock"), [((0.0, 0.0), "header"), ((5.0, 0.0), "receipt"), ((None, 0.0), "receipt")])
def test_the_clock_that_works_is_proposed(late: tuple[float | None, float], clock: str) -> None:
    topics = {"joint": at([0, 1, 2], late=late[0]), "motor": at([0, 1, 2], late=late[1])}
    for series in topics.values():
        series.values.update({path: np.zeros(3) for path in ("position[0]", "effort[0]")})
    log = Log(**topics)
    known = {
        name: type(topic)(name, topic.type, 3, 0, 1, {"header.stamp": "time", path: "float64"})
        for (name, topic), path in zip(log.topics().items(), ("position[0]", "effort[0]"), strict=True)
    }
    log.topics = lambda: known  # type: ignore[method-assign]
    text = propose_map(log, PENDULUM)
    assert f't = {{ topic = "joint", clock = "{clock}" }}' in text


def test_a_map_for_twist_also_reads_a_stamped_one(tmp_path: Path) -> None:
    drive = drive_of(1)
    log = Topics.of(drive, 1000.0)
    write_topics(log, drive, tmp_path / "a.mcap")
    log.field = "linear.x"
    run = load_run(tmp_path / "a.mcap", CAR, parse_column_map(topic_map(log, "mcap")))
    np.testing.assert_allclose(run.actions, drive.values[:, 5:], atol=1e-12)
    wrong = topic_map(log, "mcap").replace('"linear.x"', '"linear.w"')
    with pytest.raises(RunError, match=r"topic '/cmd': .*linear.w"):
        load_run(tmp_path / "a.mcap", CAR, parse_column_map(wrong))


def test_a_map_is_proposed_for_a_system_without_a_robot(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,speed,throttle\n" + "".join(f"{0.1 * row},{0.2 * row},0.5\n" for row in range(20)))
    found = safedpa.columns(log, "cart", effects=Path(__file__).parents[2] / "docs" / "examples" / "cart.py")
    assert list(found.column_map.columns) == ["t", "speed", "throttle"]
