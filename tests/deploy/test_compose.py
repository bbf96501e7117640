"""docker-compose.yml: the bus is internal, and its commands and containers form a loop that drives."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from safedpa.bus import ACTION, STATE
from safedpa.bus.security.access_control import ROUTER, roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.transport.ports import free_port
from safedpa.records import read_messages
from safedpa_services.ros_gateway.__main__ import parser
from safedpa_services.ros_gateway.robot_file import load_robot_file

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "deploy"))


def _read(name: str) -> dict[str, Any]:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


COMPOSE = _read("docker-compose.yml")
PLAIN = _read("docker-compose.plain.yml")
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
from authority import issue_to_gateway  # noqa: E402  deploy/ is no package
from robot import command as robot_command  # noqa: E402

DOCKERFILE = (ROOT / "deploy" / "Dockerfile").read_text(encoding="utf-8")
LOOP = ("router", "safety_filter", "adaptation", "policy", "diagnosis", "recorder", "robot")
PAGES = ("dashboard", "metrics", "workbench")
SENSOR_INPUTS = ("perception",)
GATEWAYS = ("ros_gateway",)
WRITES = {"recorder": ["recordings:/recordings"], "diagnosis": ["versions:/versions"]}

each_service = pytest.mark.parametrize("name", sorted(SERVICES))
each_role = pytest.mark.parametrize("name", sorted({*LOOP, *PAGES, *SENSOR_INPUTS} - {"robot"}))


def test_the_whole_loop_is_there() -> None:
    assert set(SERVICES) == {*LOOP, *PAGES, *SENSOR_INPUTS, *GATEWAYS, "authority"}
    assert SERVICES["perception"]["profiles"] == ["laser"], "only where a robot has sensors"


@each_role
def test_a_container_holds_the_key_of_its_own_role_and_may_not_change_it(name: str) -> None:
    keys = [entry for entry in SERVICES[name]["volumes"] if "-key:" in entry]
    assert keys == [f"{name.replace('_', '-')}-key:/certificates:ro", "healthcheck-key:/healthcheck:ro"]
    assert _value(SERVICES[name]["command"], "--role") in (name, None if name == "router" else name)


def test_a_robot_is_given_no_key_it_makes_its_own() -> None:
    assert SERVICES["robot"]["volumes"] == ["healthcheck-key:/healthcheck:ro"]
    assert _value(SERVICES["robot"]["command"], "--certificates").startswith("/tmp/")
    assert [name for name in SERVICES if "enrolment" in SERVICES[name]["networks"]] == ["authority", "robot"]


def test_the_gateway_speaks_as_its_robot_alone_and_reaches_that_one_by_a_network_of_its_own() -> None:
    gateway, authority = SERVICES["ros_gateway"], SERVICES["authority"]["command"]
    name = "${SAFEDPA_ROS_NAME:-ros-1}"
    assert gateway["profiles"] == ["ros"]
    assert gateway["volumes"][:2] == ["ros-gateway-key:/certificates:ro", "healthcheck-key:/healthcheck:ro"]
    assert gateway["networks"] == ["bus", "robots"]
    assert [other for other in SERVICES if "robots" in SERVICES[other]["networks"]] == ["ros_gateway"]
    assert (_value(authority, "--gateway"), _value(authority, "--with-policy")) == (name, "${SAFEDPA_ROS_NOMINAL:-0}")
    assert name in SERVICES["router"]["command"]
    assert _value(gateway["healthcheck"]["test"], "--robot") == name
    for line in (gateway["volumes"][2], gateway["command"][0]):
        assert "/robot/robot.toml" in line
    asked = load_robot_file(ROOT / "deploy" / "ros" / "fleet_robot.toml")
    assert gateway["volumes"][2] == "${SAFEDPA_ROS_FILE:-./deploy/ros/fleet_robot.toml}:/robot/robot.toml:ro"
    assert f"${{SAFEDPA_ROS_NAME:-{asked.name}}}" == name, "the certificate is that of the robot in the file"
    assert not asked.nominal.topic, "the policy of the fleet has that certificate"
    parser().parse_args(gateway["command"])


def test_the_gateway_is_given_the_policy_s_key_only_where_its_robot_requests(tmp_path: Path) -> None:
    authority, folder = Authority(tmp_path / "authority", "fleet"), tmp_path / "ros_gateway"
    folder.mkdir()

    def held(robot: str, *, with_policy: bool) -> list[str]:
        issue_to_gateway(authority, folder, robot, 1.0, with_policy=with_policy)
        return sorted(path.name.removesuffix(".key.pem") for path in folder.glob("*.key.pem"))

    assert held("ros-1", with_policy=True) == ["policy", "robot.ros-1"]
    before = (folder / "robot.ros-1.pem").read_bytes()
    assert held("ros-1", with_policy=False) == ["robot.ros-1"]
    assert (folder / "robot.ros-1.pem").read_bytes() == before
    assert held("ros-2", with_policy=False) == ["robot.ros-2"], "the key of another robot is gone"
    assert not list((tmp_path / "authority").glob("robot*"))
    assert (folder / "authority.pem").exists()


def test_the_authority_gives_every_role_a_place_of_its_own() -> None:
    places = {entry.split(":")[1] for entry in SERVICES["authority"]["volumes"]} - {"/authority"}
    assert places == {f"/issued/{role}" for role in (*roles_of(()), *GATEWAYS)}
    assert [name for name in SERVICES if any("authority:/" in v for v in SERVICES[name]["volumes"])] == ["authority"]


@each_service
def test_nothing_uses_plain_text_and_the_bus_has_no_external_network(name: str) -> None:
    phrase = " ".join([*SERVICES[name]["command"], *map(str, SERVICES[name]["healthcheck"]["test"])])
    assert "tcp/" not in phrase
    assert "--plain" not in phrase
    assert COMPOSE["networks"]["bus"] == COMPOSE["networks"]["enrolment"] == {"internal": True}


def test_the_plain_file_changes_only_endpoints_and_certificates() -> None:
    assert set(PLAIN["services"]) == set(SERVICES) - {"authority"}
    for name, service in PLAIN["services"].items():
        assert set(service) <= {"command", "healthcheck"}
        retained = [word for word in service["command"] if not word.startswith("tcp/")]
        plain = [word for word in retained if word not in ("--mode", "client", "--plain")]
        assert plain == [word for word in SERVICES[name]["command"] if word in retained]


def test_the_centre_may_read_but_publishes_for_no_robot() -> None:
    linked = _read("deploy/linked-routers.yml")["services"]
    assert _value(linked["router"]["command"], "--link") == "router.centre=none"
    assert "none" not in linked["router"]["command"]
    assert _value(linked["centre"]["command"], "--role") == "router.centre"
    assert set(linked["centre"]["networks"]).isdisjoint(COMPOSE["networks"])
    phrase = " ".join(word for service in linked.values() for word in service["command"])
    assert "tcp/" not in phrase
    assert "--plain" not in phrase


def _value(phrase: list[str], option: str) -> Any:
    return phrase[phrase.index(option) + 1] if option in phrase else None


@each_service
def test_a_container_may_write_only_its_scratch_space_and_has_minimal_rights(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert [entry.split(":")[0] for entry in service["tmpfs"]] == ["/tmp"]
    writable = [entry for entry in service["volumes"] if not entry.endswith(":ro")]
    assert name == "authority" or writable == WRITES.get(name, [])
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert not {"privileged", "cap_add", "network_mode", "pid", "ipc", "user", "devices"} & set(service)


@each_service
def test_a_container_has_limits_is_restarted_and_is_checked(name: str) -> None:
    service = SERVICES[name]
    assert service["init"] is True
    assert service["restart"] == "always"
    assert {"mem_limit", "cpus", "pids_limit", "healthcheck"} <= set(service)


@each_service
def test_the_bus_is_not_published_and_the_dashboard_to_this_machine_alone(name: str) -> None:
    ports = SERVICES[name].get("ports", [])
    assert not [port for port in ports if "7447" in port]
    assert all(port.startswith("${SAFEDPA_ADDRESS:-127.0.0.1}:") for port in ports)
    assert bool(ports) is (name in PAGES)


@each_service
def test_the_image_is_one_that_the_dockerfile_builds(name: str) -> None:
    assert SERVICES[name]["build"]["target"] == name
    assert SERVICES[name]["image"].startswith(f"safedpa-{name.replace('_', '-')}:")
    assert f"AS {name}\n" in DOCKERFILE


def test_images_run_as_an_ordinary_user_and_come_from_a_named_version() -> None:
    base = re.search(r"^ARG BASE_IMAGE=(\S+)$", DOCKERFILE, re.MULTILINE)
    assert base is not None
    assert re.fullmatch(r"python:3\.11\.\d+-slim-bookworm", base[1])
    assert base[1] in COMPOSE["x-arguments"]["BASE_IMAGE"]
    runtime = DOCKERFILE.split("AS runtime\n")[1]
    assert re.search(r"^USER 10001:10001$", runtime, re.MULTILINE)
    assert "USER" not in runtime.split("USER 10001:10001")[1].replace("ROOT_USER_ACTION", "")


def test_no_shipped_image_is_based_on_the_build_stage() -> None:
    parents = {name: parent for parent, name in re.findall(r"^FROM (\S+) AS (\S+)$", DOCKERFILE, re.MULTILINE)}
    assert "compiler" in parents
    for service in SERVICES.values():
        stage = service["build"]["target"]
        while stage in parents:
            assert stage not in ("compiler", "installer"), "what makes an image stays behind"
            stage = parents[stage]


def test_what_is_installed_by_name_has_a_pinned_version() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in lines}
    joined = DOCKERFILE.replace("\\\n", " ")
    named = re.findall(r"--constraint \S+((?: +[a-z][a-z0-9-]*)+)", joined)
    assert {name for names in named for name in names.split()} <= pinned
    assert len(named) == 7


class OutsideContainers:
    """Runs the commands of the file on this machine, with other endpoints, ports and folders."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder = folder
        self._stack = stack
        bus = free_port()
        authority = Authority(folder, "fleet")
        for role in roles_of(("robot-1",)):
            authority.issue(role, 1.0, HOSTS if role == ROUTER else ())
        self._places = {
            r"tls/(router|0\.0\.0\.0|127\.0\.0\.1):7447": f"tls/127.0.0.1:{bus}",
            r"/certificates$|/tmp/certificates$|/healthcheck$|/certificates(?= )|/healthcheck(?= )": str(folder),
            r"^/recordings/": f"{folder}/", r"^/versions": f"{folder}/versions", r"\$\{SAFEDPA_RATE:-20\}": "20",
            r"\$\{SAFEDPA_ROS_NAME:-ros-1\}": "ros-1", r'"\$\$\(cat /tmp/name\)"': "robot-1",
        }  # fmt: skip
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self._environment = {**os.environ, "PATH": path, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1"}

    def _text(self, command: list[str]) -> list[str]:
        for pattern, place in self._places.items():
            command = [re.sub(pattern, place, word) for word in command]
        return command

    def start(self, name: str) -> subprocess.Popen[str]:
        """Starts the process of a service, which is killed at the end of the test."""
        phrase = self._text(SERVICES[name]["command"])
        module = [sys.executable, "-m", f"safedpa_services.{name}"]
        command = robot_command({"SAFEDPA_LOAD": "box"}, "robot-1", phrase) if name == "robot" else [*module, *phrase]
        with (self._folder / f"{name}.err").open("w") as errors:
            process = subprocess.Popen(command, env=self._environment, stdout=subprocess.PIPE, stderr=errors, text=True)
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        return process

    def health(self, name: str) -> tuple[int, str]:
        """Returns exit code and output of a service's health check."""
        kind, *phrase = SERVICES[name]["healthcheck"]["test"]
        command = ["sh", "-c", *phrase] if kind == "CMD-SHELL" else phrase
        done = subprocess.run(
            self._text(command), env=self._environment, capture_output=True, text=True, timeout=60, check=False
        )
        return done.returncode, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.processes
def test_the_commands_of_the_file_make_a_loop_that_is_healthy_and_drives(tmp_path: Path) -> None:
    with ExitStack() as stack:
        outside = OutsideContainers(tmp_path, stack)
        processes = {name: outside.start(name) for name in LOOP}
        patience = time.monotonic() + 180.0  # seven processes begin at once
        for name in LOOP:
            code, notice = outside.health(name)
            while code != 0 and processes[name].poll() is None and time.monotonic() < patience:
                code, notice = outside.health(name)
            assert code == 0, f"{name}: {notice} {(tmp_path / f'{name}.err').read_text(encoding='utf-8')}"
        processes["policy"].kill()
        processes["policy"].wait()
        assert outside.health("policy")[0] == 1, "healthy without a process"
        robot = processes["robot"]
        robot.send_signal(signal.SIGTERM)
        account = json.loads(robot.communicate(timeout=60)[0])
        processes["recorder"].send_signal(signal.SIGTERM)
        processes["recorder"].wait(60)
    assert (account["load"], account["collisions"]) == ("box", 0)
    kinds = {key.split("/")[3] for key, _, _ in read_messages(tmp_path / "recording.mcap")}
    assert {STATE.name, ACTION.name} <= kinds
