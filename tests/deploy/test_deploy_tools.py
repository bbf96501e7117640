"""What stands beside the images: names from addresses, the authority's judgement, another router's configuration."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import pytest

from safedpa.bus import ActionMessage, StateMessage
from safedpa.bus.security.authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.bus.wire.codec import encode
from safedpa.errors import InputError
from safedpa.records import McapRecorder

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "deploy"))

import fleet_budget
import zenoh_configuration
from authority import robot_role
from container_name import name_in, number_in, pointer_question
from robot import command


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
    assert robot_role(name) == "robot.robot-3"
    assert number_in(name) == 3


@pytest.mark.parametrize(
    "name", ["", "fleet_policy_1.fleet_bus", "robot", "fleet_robot_3x", "evil.fleet_robot_3", "fleet_robot_"]
)
def test_another_container_has_no_robots_role(name: str) -> None:
    with pytest.raises(ValueError, match="container"):
        robot_role(name)


def test_loads_are_taken_in_turn_and_scenes_differ() -> None:
    words = command({"SAFEDPA_LOAD": "none, box", "SAFEDPA_SEED": "5"}, "robot-4", ["--certificates", "/tmp/c"])
    assert words[words.index("--load") + 1] == "box"
    assert words[words.index("--seed") + 1] == "8"
    assert words[words.index("--role") + 1] == "robot.robot-4"
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
            stamp = {"epoch": 1, "tick": tick, "robot_time": tick / 20.0, "publish_time": tick / 20.0}
            state = StateMessage(
                **stamp, values=(0.0,) * 6, applied=(0.0, 0.0), applied_by="filter", period=0.05, lockstep=False,
                goal=(1.0, 1.0), obstacles=(), field=(), footprint=(),
            )  # fmt: skip
            at = int(1e9 * tick / 20.0)
            for topic, message in (("state", state), ("action", ActionMessage(**stamp, values=(1.0, 0.0)))):
                payload = encode(message)
                sent += len(payload)
                recorder.write(f"safedpa/fleet/{robot}/{topic}", payload, at, at)
    recorder.close()
    flows = fleet_budget.flows_per_robot(path)
    assert flows["state"].messages == pytest.approx(20.0)
    assert sum(flow.octets for flow in flows.values()) == pytest.approx(sent / (2 * 41 / 20.0))
    assert fleet_budget.readers("action", fleet_budget.CENTRE) == 2
    total = fleet_budget.total(flows, {"state": 3, "action": 1}, 200.0)
    assert total.messages == pytest.approx(4 * 20.0)
