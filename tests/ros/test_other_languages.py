"""JavaScript decodes our messages, and drives a robot of its own over the bus."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from tests.messages import verdict_of

from safedpa.bus.transport import ports
from safedpa.robots.car.adapters.ros import CarFace
from safedpa.ros.encoding import encode, type_store
from safedpa.ros.outgoing import diagnostics_of, odometry_of, path_marker, transform_of
from safedpa_lab.ros.side import Loop

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[2]
NODE, NPM = shutil.which("node"), shutil.which("npm")
PACKAGES = ("@foxglove/rosmsg2-serialization@3.1.0", "@foxglove/rosmsg@5.0.5")
HEAD = {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": "odom"}


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if NODE is None or NPM is None:
        pytest.skip("node or npm is missing")
    folder = tmp_path_factory.mktemp("npm")
    phrase = [
        NPM,
        "install",
        "--prefix",
        str(folder),
        "--silent",
        "--no-audit",
        "--no-fund",
        "--ignore-scripts",
        "--fetch-retries=1",
        "--fetch-timeout=10000",
        *PACKAGES,
    ]
    try:
        done = subprocess.run(phrase, capture_output=True, text=True, check=False, timeout=40)
    except subprocess.TimeoutExpired:
        pytest.skip("npm reaches no registry")
    if done.returncode:
        pytest.skip(f"npm cannot install {PACKAGES[0]}: {done.stderr[-200:]}")
    return folder


def within(wanted: Any, found: Any, path: str = "") -> list[str]:
    """Returns the parts of one value that are not in the other."""
    if isinstance(wanted, dict):
        return [line for key, value in wanted.items() for line in within(value, found[key], f"{path}.{key}")]
    if isinstance(wanted, list):
        assert len(wanted) == len(found), path
        return [line for k, value in enumerate(wanted) for line in within(value, found[k], f"{path}[{k}]")]
    same = found == pytest.approx(wanted, rel=1e-6) if isinstance(wanted, float) else found == wanted
    return [] if same else [f"{path}: {found!r}, wanted {wanted!r}"]


def messages() -> dict[str, dict[str, Any]]:
    verdict = verdict_of("corrected", sentence="Bäume", active=("obstacle 3",), h_now=0.25, margin=0.01)
    stamped = "ackermann_msgs/msg/AckermannDriveStamped"
    drive = {"header": HEAD, **CarFace().message(stamped, (1.25, -0.2), (0.0,) * 4)}
    twist = {"header": HEAD, **CarFace().message("geometry_msgs/msg/TwistStamped", (1.25, -0.2), (0.0,) * 4)}
    return {
        stamped: drive,
        "geometry_msgs/msg/TwistStamped": twist,
        "nav_msgs/msg/Odometry": odometry_of(HEAD, "base_link", 1.5, -2.25, 0.5, 0.75, 0.125),
        "tf2_msgs/msg/TFMessage": {"transforms": [transform_of(HEAD, "base_link", 1.5, -2.25, 0.5)] * 2},
        "diagnostic_msgs/msg/DiagnosticArray": diagnostics_of(HEAD, "r1", verdict),
        "visualization_msgs/msg/MarkerArray": {"markers": [path_marker(HEAD, [(0.0, 0.5), (1.0, 1.5)])]},
    }


@pytest.mark.long
def test_an_npm_package_decodes_every_message_that_is_sent(packages: Path) -> None:
    assert NODE is not None
    sent = messages()
    lines = []
    for name, values in sent.items():
        definition, _ = type_store().generate_msgdef(name, ros_version=2)
        lines.append(json.dumps({"definition": definition, "hex": encode(name, values).hex()}))
    phrase = [NODE, str(HERE / "decode.mjs"), str(packages)]
    done = subprocess.run(phrase, input="\n".join(lines), capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == len(sent)
    for (name, values), other in zip(sent.items(), found, strict=True):
        for header in (other.get("header"), *(one["header"] for one in other.get("transforms", ()))):
            if header is not None:  # the package calls nanoseconds so, as ROS 1 did
                header["stamp"]["nanosec"] = header["stamp"].pop("nsec", header["stamp"].get("nanosec"))
        for marker in other.get("markers", ()):
            stamp = marker["header"]["stamp"]
            stamp["nanosec"] = stamp.pop("nsec", stamp.get("nanosec"))
        assert within(json.loads(json.dumps(values)), other, name) == []


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_a_robot_in_javascript_is_driven_round_an_obstacle_and_brakes_without_answers(tmp_path: Path) -> None:
    if NODE is None:
        pytest.skip("node is missing")
    script = str(ROOT / "docs" / "examples" / "javascript_robot" / "robot.mjs")
    loop = Loop(tmp_path)
    try:
        loop.start("adaptation", "--model", "car")
        loop.start("policy", "--model", "car", "--controller", "goal_seeker")
        loop.start("safety_filter", "--model", "car", "--settings", "car")
        for name in loop.children:
            loop.wait_for(name, "is on the bus", 60.0)
        host, port = loop.endpoint.removeprefix("tcp/").split(":")
        phrase = [NODE, script, host, port, loop.fleet, "r1", "8"]
        done = subprocess.run(phrase, capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr
        driven = json.loads(done.stdout)
        assert driven["ticks"] == 160
        assert driven["braked"] < 120  # a busy machine may brake it for a while; it must not for most of the time
        assert driven["nearest"] > 0.0
        assert driven["x"] > -1.9
        loop.stop("safety_filter")
        done = subprocess.run([*phrase[:-1], "1"], capture_output=True, text=True, check=False, timeout=60)
        assert json.loads(done.stdout)["braked"] == 20
    finally:
        loop.end()
    no_one = subprocess.run(
        [NODE, script, "127.0.0.1", str(ports.free_port()), "f", "r1", "1"], capture_output=True, text=True, check=False
    )
    assert no_one.returncode != 0


def test_the_robot_in_cpp_compiles_where_its_headers_are() -> None:
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    for header in ("zenoh.hxx", "msgpack.hpp"):
        phrase = [compiler, "-std=c++17", "-DZENOHCXX_ZENOHC", "-x", "c++", "-fsyntax-only", "-"]
        done = subprocess.run(phrase, input=f"#include <{header}>\n", capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"the header {header} is not there")
    source = str(ROOT / "docs" / "examples" / "cpp_robot" / "robot.cpp")
    done = subprocess.run([compiler, "-std=c++17", "-DZENOHCXX_ZENOHC", "-fsyntax-only", source], check=False)
    assert done.returncode == 0
