"""Tools for deployment: addresses, keys, health checks, latencies, times of decisions, pinned packages."""

import json
import os
import re
import struct
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from tests.messages import health_of, stamp, state_of

from safedpa.bus import HEALTH, NO_ROBOT, ActionMessage, Bus, MemoryBroker, MemoryTransport
from safedpa.bus.messages.codec import encode
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.errors import InputError
from safedpa.records import McapRecorder
from safedpa_services.healthcheck.__main__ import HealthCheck

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "deploy"))

import container_latency
import fleet_budget
import zenoh_configuration
from authority import robot_role
from container_chain import account
from container_name import name_in, number_in, pointer_question
from robot import command

ROOT = Path(__file__).resolve().parents[2]


def _answer(name: str, *, repeated: bool) -> bytes:
    question = pointer_question("172.18.0.5")
    labels = b"".join(bytes([len(part)]) + part.encode() for part in name.split(".")) + b"\0"
    head = struct.pack(">6H", 1, 0x8180, 1, 1, 0, 0) + question[12:]
    owner = question[12:-4] if repeated else b"\xc0\x0c"
    return head + owner + struct.pack(">2HIH", 12, 1, 600, len(labels)) + labels


@pytest.mark.parametrize("repeated", [True, False], ids=["name written out", "pointer to the question"])
def test_a_name_is_read_from_either_form_of_answer(repeated: bool) -> None:
    assert name_in(_answer("fleet_robot_12.fleet_bus", repeated=repeated)) == "fleet_robot_12.fleet_bus"


def test_no_name_is_an_error() -> None:
    empty = struct.pack(">6H", 1, 0x8183, 1, 0, 0, 0) + pointer_question("172.18.0.5")[12:]
    with pytest.raises(OSError, match="knows no name"):
        name_in(empty)


@pytest.mark.parametrize("name", ["fleet_robot_3.fleet_bus", "fleet-robot-3", "fleet-robot-3.fleet_enrolment"])
def test_a_robots_container_has_a_robots_role(name: str) -> None:
    assert (robot_role(name), number_in(name)) == ("robot.robot-3", 3)


@pytest.mark.parametrize(
    "name", ["", "fleet_policy_1.fleet_bus", "robot", "fleet_robot_3x", "evil.fleet_robot_3", "fleet_robot_"]
)
def test_another_container_has_no_robots_role(name: str) -> None:
    with pytest.raises(ValueError, match="container"):
        robot_role(name)


def test_loads_are_taken_in_turn_and_scenes_differ() -> None:
    phrase = command({"SAFEDPA_LOAD": "none, box", "SAFEDPA_SEED": "5"}, "robot-4", ["--certificates", "/tmp/c"])
    assert phrase[phrase.index("--load") + 1] == "box"
    assert phrase[phrase.index("--seed") + 1] == "8"
    assert phrase[phrase.index("--role") + 1] == "robot.robot-4"
    assert "--role" not in command({}, "robot-1", [])


def test_an_authority_signs_what_its_owner_holds_the_key_of(tmp_path: Path) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    authority = Authority(tmp_path, "fleet")
    key = ec.generate_private_key(ec.SECP256R1())
    asked = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "safety_filter")])
    request = x509.CertificateSigningRequestBuilder().subject_name(asked).sign(key, hashes.SHA256())
    signed = authority.sign(request.public_bytes(serialization.Encoding.PEM), "robot.robot-3", 1.0)
    certificate = x509.load_pem_x509_certificate(signed)
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert [name.value for name in names] == ["robot.robot-3"]
    assert certificate.public_key() == key.public_key()
    with pytest.raises(InputError, match="signing request"):
        authority.sign(b"-----BEGIN NONSENSE-----", "robot.robot-3", 1.0)


def test_the_configuration_for_another_router_is_one_that_zenoh_reads(tmp_path: Path) -> None:
    import zenoh

    Authority(tmp_path, "fleet").issue("router", 1.0, HOSTS)
    certificates = Certificates(tmp_path, "router")
    text = zenoh_configuration.document("fleet", ["robot-1"], certificates, "tls/0.0.0.0:7447", "/certificates")
    (tmp_path / "zenoh.json5").write_text(text, encoding="utf-8")
    read = zenoh.Config.from_file(str(tmp_path / "zenoh.json5"))
    assert json.loads(read.get_json("access_control/default_permission")) == "deny"
    assert json.loads(read.get_json("access_control/enabled")) is True
    assert json.loads(read.get_json("transport/link/tls/listen_certificate")) == "/certificates/router.pem"


@pytest.mark.long
def test_the_budget_counts_what_was_recorded(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    recorder = McapRecorder(path)
    sent = 0
    for tick in range(41):
        for robot in ("r1", "r2"):
            state, at = state_of(*[0.0] * 6, **stamp(tick)), int(1e9 * tick / 20.0)
            for topic, message in (("state", state), ("action", ActionMessage(**stamp(tick), values=(1.0, 0.0)))):
                payload = encode(message)
                sent += len(payload)
                recorder.write(f"safedpa/fleet/{robot}/{topic}", payload, at, at)
    recorder.close()
    flows = fleet_budget.flows_per_robot(path)
    assert flows["state"].messages == pytest.approx(20.0)
    assert sum(flow.octets for flow in flows.values()) == pytest.approx(sent / (2 * 41 / 20.0))
    assert fleet_budget.readers("action", fleet_budget.CENTRE) == 2
    assert fleet_budget.total(flows, {"state": 3, "action": 1}, 200.0).messages == pytest.approx(4 * 20.0)


ACCOUNT = {"ticks": 100, "watchdog_ticks": 2, "collisions": 0, "latency_us": {"p50": 900.0, "p99": 3000.0}}


def test_percentiles_and_what_is_late() -> None:
    times = [1000.0 * number for number in range(1, 100)]
    found = account(times, 100, 20.0)
    assert (found["p50"], found["p99"], found["p999"]) == (50_000.0, 99_000.0, 99_000.0)
    assert found["late_share"] == pytest.approx(0.5), "49 that took longer than 50 ms, and one that never came"


def test_the_summary_is_the_last_one_in_the_log_else_the_last_line_is_reported() -> None:
    lines = ['{"event": "robot.ready"}', json.dumps({**ACCOUNT, "ticks": 1}), "no json", json.dumps(ACCOUNT), "7"]
    assert container_latency.account_in(lines) == ACCOUNT
    with pytest.raises(RuntimeError, match="no account of its drive; its last words: one two"):
        container_latency.account_in(["none", "one", "two"])


def test_the_chain_runs_before_and_after_the_loop_with_the_limits_of_its_containers(monkeypatch):
    ran: list[list[str]] = []

    def run(phrase: Any, **_: Any) -> subprocess.CompletedProcess[str]:
        ran.append(list(phrase))
        notice = "container"
        if "send" in phrase:
            notice = json.dumps({"p50": 800.0, "p99": 1500.0, "p999": 2000.0, "late_share": 0.0})
        elif "logs" in phrase:
            notice = json.dumps(ACCOUNT)
        return subprocess.CompletedProcess(phrase, 0, notice, "")

    monkeypatch.setattr(container_latency.subprocess, "run", run)
    monkeypatch.setattr(container_latency.time, "sleep", lambda _: None)
    monkeypatch.setattr(container_latency.os, "environ", dict(container_latency.os.environ))
    found = container_latency.measured(600.0, 20.0)
    assert (found["ratio_p99"], found["watchdog_ticks"]) == (2.0, 2)
    what = [
        "send" if "send" in phrase else "robot" if phrase[-1] == "robot" and "up" in phrase else "" for phrase in ran
    ]
    assert [each for each in what if each] == ["send", "robot", "send"]
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
    sent = next(phrase for phrase in ran if "send" in phrase)
    for option, key in (("--cpus", "cpus"), ("--cpu-shares", "cpu_shares"), ("--memory", "mem_limit")):
        assert sent[sent.index(option) + 1] == str(services["adaptation"][key])
    assert sent[-2:] == ["60", "20"]
    relays = [phrase[-2:] for phrase in ran if "relay" in phrase]
    assert relays[:3] == [
        ["bare/state", "bare/latent"],
        ["bare/latent", "bare/nominal"],
        ["bare/nominal", "bare/action"],
    ]
    assert ran[-1][-3:] == ["--remove-orphans", "--timeout", "3"]


def test_an_error_of_the_engine_is_one_line(monkeypatch, capsys):
    def run(phrase: Any, **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(phrase, 1, "", "Traceback\n  line\nno engine answers\n")

    monkeypatch.setattr(container_latency.subprocess, "run", run)
    monkeypatch.setattr(container_latency.os, "environ", dict(container_latency.os.environ))
    monkeypatch.setattr(sys, "argv", ["container_latency", "--seconds", "1"])
    with pytest.raises(SystemExit) as end:
        container_latency.main()
    assert end.value.code == 1
    notice = capsys.readouterr().err
    assert notice.startswith("container_latency: ")
    assert notice.endswith("no engine answers\n")
    assert notice.count("\n") == 1


@pytest.mark.parametrize(("seconds", "rate"), [(float("nan"), 20.0), (-1.0, 20.0), (0.0, 20.0), (5.0, 0.0), (5.0, 2e3)])
def test_impossible_times_are_refused_before_anything_is_started(seconds, rate, monkeypatch):
    monkeypatch.setattr(container_latency.subprocess, "run", lambda *_, **__: pytest.fail("started"))
    with pytest.raises(ValueError, match="wanted one tick at least"):
        container_latency.measured(seconds, rate)


def test_without_messages_there_is_no_percentile() -> None:
    with pytest.raises(TimeoutError, match="none of 100"):
        account([], 100, 20.0)
    nothing = {**ACCOUNT, "latency_us": {"p50": None, "p99": None}}
    with pytest.raises(RuntimeError, match="no action reached the robot in 100 ticks"):
        container_latency.account_in([json.dumps(nothing)])


def reported(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "deploy" / "filter_by_status.py"), *arguments]
    environment = {**os.environ, "SAFEDPA_COMPILE": "0"}  # actions are counted in Python alone
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=environment)


@pytest.mark.long
def test_a_tree_compared_with_itself_decides_alike_and_every_status_is_counted() -> None:
    tree = str(ROOT / "shared")
    found = reported(f"before={tree}", f"after={tree}", "--scenes", "2", "--rounds", "1", "--seed", "7")
    assert found.returncode == 0, found.stderr
    lines = found.stdout.splitlines()
    assert [line.partition(" (")[0] for line in lines[:2]] == ["before", "after"]
    assert all("0 of 32 statuses differ, actions by 0.0e+00 at most" in line for line in lines[:2])
    counted = {line.split(",")[0]: int(line.split(",")[1].partition(":")[0]) for line in lines[2:]}
    assert sum(counted.values()) == 32
    assert {"passed", "corrected", "violated"} <= set(counted)
    looks = r"(\d+\.\d) actions looked at"
    found_of = {
        line.split(",")[0]: re.search(rf"before \d+ \(1\.00\), \d+ \(1\.00\), {looks}; after", line)
        for line in lines[2:]
    }
    actions = {status: float(match[1]) for status, match in found_of.items() if match}
    assert set(actions) == set(counted)
    assert actions["passed"] < actions["corrected"] < actions["violated"]


def test_a_tree_without_a_name_is_refused() -> None:
    found = reported("somewhere")
    assert found.returncode == 2
    assert "got somewhere, wanted NAME=FOLDER" in found.stderr


def beat(bus: Bus, at: float, steps: int, **other: object) -> None:
    """Returns a heartbeat of the policy about robot r1, with changed fields."""
    robot = str(other.pop("robot", "r1"))
    message = health_of(**{"service": "policy", "tick": steps, "publish_time": at, "steps": steps, **other})
    bus.publish(HEALTH, robot, message, message.service)


READY = {"state": "ready", "robot": NO_ROBOT}
FAILING = {"state": "failing", "detail": "disk full"}
SILENT = "policy: no two heartbeats within 0 s"


@pytest.mark.parametrize(
    ("beats", "notice"),
    [
        ([(1.0, 10, {}), (1.25, 15, {})], ""), ([(1.0, 0, READY), (1.25, 0, READY)], ""), ([], SILENT),
        ([(1.0, 10, {}), (1.0, 10, {})], SILENT),
        ([(1.0, 10, {}), (1.25, 10, {})], "policy: alive, but made no step after step 10"),
        ([(1.0, 10, FAILING), (1.25, 15, FAILING)], "policy: failing, disk full"),
        ([(1.0, 10, {"pid": 7}), (1.25, 15, {"pid": 8})], SILENT),
        ([(1.0, 10, {"service": "adaptation"}), (1.25, 15, {"service": "adaptation"})], SILENT),
    ],
    ids=[
        "steps that grow", "waiting for a robot", "silence", "one heartbeat twice", "alive without steps", "failing",
        "two processes", "another service",
    ],
)  # fmt: skip
def test_only_progress_between_two_heartbeats_of_one_process_is_healthy(beats, notice):
    broker = MemoryBroker()
    check, bus = HealthCheck(Bus(MemoryTransport(broker), "fleet"), "policy"), Bus(MemoryTransport(broker), "fleet")
    for at, steps, other in beats:
        beat(bus, at, steps, **other)
    assert check.run(0.0) == notice


def test_another_robot_does_not_count() -> None:
    broker = MemoryBroker()
    bus = Bus(MemoryTransport(broker), "fleet")
    check = HealthCheck(Bus(MemoryTransport(broker), "fleet"), "policy", "r2")
    for robot, notice in (("r1", SILENT), ("r2", "")):
        beat(bus, 1.0, 10, robot=robot)
        beat(bus, 1.25, 15, robot=robot)
        assert check.run(0.0) == notice


@pytest.mark.processes
def test_as_a_process_it_ends_with_one_in_silence(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = [sys.executable, "-m", "safedpa_services.healthcheck", "policy", "--seconds", "0.2", "--listen", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (1, "policy: no two heartbeats within 0.2 s\n")


PROJECTS = ("pyproject.toml", "sim/pyproject.toml")


def _pinned(repository: Path) -> dict[str, str]:
    lines = (repository / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(re.findall(r"^([\w.-]+)==([\w.]+)$", "\n".join(lines), re.MULTILINE))


def test_every_pinned_package_takes_the_oldest_python(repository: Path) -> None:
    """A package that required 3.11.5 could not be installed on Debian 12, which has Python 3.11.2."""
    projects = [tomllib.loads((repository / name).read_text(encoding="utf-8")) for name in PROJECTS]
    (promised,) = {project["project"]["requires-python"] for project in projects}
    oldest = promised.removeprefix(">=") + ".0"
    assert re.fullmatch(r"3\.\d+\.0", oldest)
    looked_at, refused = 0, []
    for name, version in _pinned(repository).items():
        try:
            about = metadata(name)
        except PackageNotFoundError:  # of an extra that is not installed here
            continue
        if about["Version"].split("+")[0] != version:
            refused.append(f"{name} {about['Version']} is installed, and {version} pinned")
        wanted = about.get("Requires-Python") or ""
        looked_at += 1
        if not SpecifierSet(wanted).contains(oldest):
            refused.append(f"{name} {version} wants Python {wanted}, promised is {promised}")
    assert looked_at > 60
    assert refused == []
