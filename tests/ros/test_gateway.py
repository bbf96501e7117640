"""The gateway against another implementation of ROS 2 over Zenoh: odometry in, filtered commands out, and faults."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from safedpa.bus.transport import ports
from safedpa_lab.ros.foreign import HASHES
from safedpa_lab.ros.side import Loop, Side, robot_file, services
from safedpa_services.command_line.group import safedpa

TWIST = "geometry_msgs/msg/Twist"
_LONG = 600.0
"""s; of a drive that is ended by a word: nothing takes so long but on a busy machine."""


def file_of(side: Side, seed: int = 0, **tables: dict[str, str]) -> Path:
    return robot_file(side.folder / f"robot-{seed}.toml", side.endpoint, seed, tables)


def until(true: Callable[[], bool]) -> bool:
    """Returns whether a condition becomes true within 90 s."""
    end = time.monotonic() + 90.0
    while not true():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def is_on_the_bus(runs: Path, name: str) -> bool:
    """Returns whether a process of the run has reported that it is on the bus; its log exists long before."""
    return any("is on the bus" in log.read_text("utf-8") for log in runs.glob(f"*/{name}.log"))


pytestmark = [pytest.mark.slow, pytest.mark.processes]


@pytest.mark.long
@pytest.mark.parametrize("seed", [11])
def test_a_blind_policy_drives_through_the_filter_without_a_collision(side: Side, tmp_path: Path, seed: int) -> None:
    blind = side.car(8.0, seed, "--straight")
    blind.send("go")
    without = blind.reported()
    car = side.car(8.0, seed)
    with services(tmp_path) as loop:
        loop.start("ros_gateway", str(file_of(side, seed)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        found = car.reported()
        assert found["collisions"] == 0, loop.log("ros_gateway")
        assert found["moved"] > 1.0, loop.log("ros_gateway") + loop.log("safety_filter")
        assert found["commands"] > 100
    assert without["collisions"] > 0


def test_discover_lists_who_is_there(side: Side, capsys: pytest.CaptureFixture[str]) -> None:
    car = side.car(_LONG)
    car.send("go")
    assert safedpa.run(["ros", "discover", side.endpoint, "--json"]) == 0
    topics = json.loads(capsys.readouterr().out)["topics"]
    assert topics["/odom"]["publishers"] == ["/base"]
    assert topics["/drive"]["subscribers"] == ["/driver"]
    assert topics["/drive"]["hash"] == HASHES["ackermann_msgs/msg/AckermannDriveStamped"]
    assert topics["/drive_in"]["publishers"] == ["/policy"]
    assert safedpa.run(["ros", "discover", "tcp/127.0.0.1:9"]) == 1
    capsys.readouterr()
    assert safedpa.run(["ros", "discover", side.endpoint]) == 0
    assert "/odom   nav_msgs/msg/Odometry\n    from /base; to none" in capsys.readouterr().out


@pytest.mark.long
def test_the_car_brakes_and_reports_why_if_any_process_ends(side: Side, tmp_path: Path) -> None:
    car = side.car(_LONG, 11)
    with services(tmp_path) as loop:
        loop.start("ros_gateway", str(file_of(side, 11)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        loop.wait_for("ros_gateway", "the filter drives")
        loop.children["safety_filter"].send_signal(signal.SIGSTOP)
        loop.wait_for("ros_gateway", "the gateway brakes: no action of the filter arrived in time")
        loop.children["safety_filter"].send_signal(signal.SIGCONT)
        before = loop.log("ros_gateway").count("the filter drives")
        assert until(lambda: loop.log("ros_gateway").count("the filter drives") > before)  # as the filter does
        side.car(_LONG, 0, "--straight")  # another publisher on the driver's topic
        loop.wait_for("ros_gateway", "/policy publishes on /drive, too; remap it to another topic")
        time.sleep(3.0)  # for a busy machine to bring it to rest
        car.send("end")
        found = car.reported()
        assert found["collisions"] == 0
        assert abs(found["speed"]) < 0.05
        assert found["fastest"] > 0.3


@pytest.mark.long
@pytest.mark.parametrize("option", ["--freeze-after", "--policy-ends"])
def test_without_odometry_or_a_nominal_action_the_robot_stops(side: Side, tmp_path: Path, option: str) -> None:
    car = side.car(5.5, 11, option, "3.0")
    with services(tmp_path) as loop:
        loop.start("ros_gateway", str(file_of(side, 11)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        found = car.reported()
        if option == "--freeze-after":
            loop.wait_for("ros_gateway", "the gateway brakes: the odometry is ")
        assert found["moved"] > 0.3
        assert abs(found["speed"]) < 0.05
        assert found["driver_brakes"] < 60  # the commands to brake came from the gateway


@pytest.mark.long
def test_the_driver_brakes_after_the_gateway_was_killed_and_a_jumping_clock_has_no_effect(side: Side, tmp_path: Path):
    car = side.car(_LONG, 11, "--rewind-after", "1.0")
    with services(tmp_path) as loop:
        loop.start("ros_gateway", str(file_of(side, 11)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        loop.wait_for("ros_gateway", "the filter drives")
        time.sleep(2.0)
        # a busy machine may keep it braking now and then
        assert until(lambda: "the filter drives" in loop.log("ros_gateway").splitlines()[-1])
        loop.children["ros_gateway"].kill()
        time.sleep(3.0)
        car.send("end")
        found = car.reported()
        assert found["driver_brakes"] > 20
        assert abs(found["speed"]) < 0.05
        assert found["collisions"] == 0


@pytest.mark.long
def test_serve_starts_what_is_needed_and_ends_in_order(side: Side, tmp_path: Path) -> None:
    car = side.car(8.0, 11)
    command = [
        sys.executable,
        "-m",
        "safedpa_services",
        "serve",
        str(file_of(side, 11)),
        "--headless",
        "--no-diagnosis",
    ]
    log = (tmp_path / "serve.log").open("wb")
    served = subprocess.Popen([*command, "--out", str(tmp_path / "runs")], stdout=log, stderr=log)
    try:
        assert until(lambda: is_on_the_bus(tmp_path / "runs", "robot"))
        car.send("go")
        found = car.reported()
        served.send_signal(signal.SIGINT)
        notice = (tmp_path / "serve.log").read_text
        assert served.wait(60.0) == 0, notice()
    finally:
        served.kill()
        served.wait()
        log.close()
    assert found["collisions"] == 0, notice()
    assert found["moved"] > 1.0, notice()
    assert "the filter drives" in notice()
    (recording,) = (tmp_path / "runs").glob("*/recording.mcap")
    from safedpa.records import load_run
    from safedpa.robots.car.system import CAR

    run = load_run(recording, CAR)
    assert run.duration > 5.0


def test_a_robot_of_the_bus_needs_a_policy_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "robot.toml"
    path.write_text('format = 2\nrobot = "car"\nname = "r1"\n')
    assert safedpa.run(["serve", str(path), "--headless"]) == 2
    assert "got no policy; use --policy" in capsys.readouterr().err


@pytest.mark.long
def test_serve_without_ros_waits_for_a_robot_of_the_bus(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text('format = 2\nrobot = "car"\nname = "r1"\n')
    where = f"tcp/127.0.0.1:{ports.free_port()}"
    command = [sys.executable, "-m", "safedpa_services", "serve", str(path), "--headless", "--policy", "goal_seeker"]
    with (tmp_path / "serve.log").open("wb") as log:
        served = subprocess.Popen(
            [*command, "--listen", where, "--out", str(tmp_path), "--no-diagnosis"], stdout=log, stderr=log
        )
        try:
            for name in ("adaptation", "policy", "safety_filter"):
                assert until(lambda name=name: is_on_the_bus(tmp_path, name)), name
            robot = [sys.executable, "-m", "safedpa_sim.robots", "--name", "r1", "--seed", "3", "--seconds", "5"]
            done = subprocess.run(
                [*robot, "--connect", where], capture_output=True, text=True, check=False, timeout=120
            )
            served.send_signal(signal.SIGINT)
            assert served.wait(60.0) == 0
        finally:
            served.kill()
            served.wait()
    account = json.loads(done.stdout.splitlines()[-1])
    assert account["ticks"] == 100
    assert account["collisions"] == 0
    assert account["watchdog_ticks"] < 60


@pytest.mark.long
def test_the_gateway_reconnects_to_the_robots_router(side: Side, tmp_path: Path) -> None:
    car = side.car(_LONG, 11)
    with services(tmp_path) as loop:
        loop.start("ros_gateway", str(file_of(side, 11)))
        loop.wait_for("ros_gateway", "robot is on the bus")
        car.send("go")
        loop.wait_for("ros_gateway", "the filter drives")
        side.router.kill()
        loop.wait_for("ros_gateway", "the gateway brakes: the odometry is ")
        before = loop.log("ros_gateway").count("the filter drives")
        time.sleep(1.0)
        side.restart_router()
        assert until(lambda: loop.log("ros_gateway").count("the filter drives") > before)
        car.send("end")
        found = car.reported()
        assert found["driver_brakes"] > 20
        assert found["collisions"] == 0


@pytest.mark.long
def test_over_mutual_tls_the_gateway_is_robot_and_policy_and_brakes_for_a_publisher_without_a_token(side, tmp_path):
    folder = str(tmp_path / "certificates")
    assert safedpa.run(["certificates", folder, "--robot", "r1"]) == 0
    loop = Loop(tmp_path)
    loop.fleet, loop.endpoint = "fleet", f"tls/127.0.0.1:{ports.free_port()}"
    shown = ("--certificates", folder)
    try:
        loop.start("router", *shown, "--robot", "r1")
        loop.start("adaptation", *shown, "--role", "adaptation", "--model", "car")
        loop.start("safety_filter", *shown, "--role", "safety_filter", "--model", "car", "--settings", "car")
        car, stranger = side.car(_LONG, 11), side.speaker("/drive", "--without-token")
        loop.start("ros_gateway", str(file_of(side, 11)), *shown)
        for name in ("adaptation", "safety_filter", "ros_gateway"):
            loop.wait_for(name, "is on the bus")
        car.send("go")
        loop.wait_for("ros_gateway", "the filter drives")
        time.sleep(3.0)
        car.send("mark")
        stranger.send("go")
        loop.wait_for("ros_gateway", "an unannounced publisher")
        time.sleep(3.0)  # braking takes one second, on a busy machine more
        car.send("end")
        found = car.reported()
        assert "bus.denied" not in loop.log("router")
    finally:
        loop.end()
    assert found["moved"] > 0.3
    assert found["collisions"] == 0
    assert abs(found["speed"]) < 0.2
    assert any("an unannounced publisher" in notice for notice in found["mark"]["notice"])
