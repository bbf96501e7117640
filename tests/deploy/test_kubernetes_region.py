"""A region on Kubernetes equals the compose file: commands, keys, limits, rights, and one filter."""

import base64
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from safedpa.bus.security.access_control import roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "deploy"))

import robot as robot_start
from kubernetes_region import region, write_base

ROOT = Path(__file__).resolve().parents[2]
Document = dict[str, Any]

COMPOSE: dict[str, Document] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
LOOP = ("router", "safety_filter", "adaptation", "policy")
SHIPPED = sorted(name for name in {*COMPOSE} - {"authority", "robot"} if "profiles" not in COMPOSE[name])
each_service = pytest.mark.parametrize("name", SHIPPED)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    authority = Authority(folder, "fleet")
    for role in roles_of(("robot-1", "robot-2")):
        authority.issue(role, 1.0, HOSTS if role == "router" else ())
    return folder


@pytest.fixture(scope="module")
def documents(keys: Path) -> list[Document]:
    return region("west", 2, keys, ("10.20.0.0/16",))


def _of(documents: list[Document], kind: str) -> dict[str, Document]:
    return {each["metadata"]["name"]: each for each in documents if each["kind"] == kind}


def _pod(documents: list[Document], name: str) -> tuple[Document, Document]:
    """Returns a pod and its container."""
    kind = "StatefulSet" if name == "robot" else "Deployment"
    pod = _of(documents, kind)[name.replace("_", "-")]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    return pod, container


@each_service
def test_image_command_and_health_check_are_those_of_the_compose_file(documents: list[Document], name: str) -> None:
    _, container = _pod(documents, name)
    phrase = [word.replace("${SAFEDPA_ROS_NAME:-ros-1}", "ros-1") for word in COMPOSE[name]["command"]]
    more = ["--standby"] if name in ("router", "safety_filter") else []
    assert (container["image"], container["args"]) == (COMPOSE[name]["image"], phrase + more)
    assert container["livenessProbe"]["exec"]["command"] == COMPOSE[name]["healthcheck"]["test"][1:]
    assert container["livenessProbe"]["timeoutSeconds"] == 8


@each_service
def test_a_pod_mounts_the_keys_of_its_own_role_and_may_not_change_them(documents: list[Document], name: str) -> None:
    pod, container = _pod(documents, name)
    secrets = {each["name"]: each["secret"] for each in pod["volumes"] if "secret" in each}
    assert {each["secretName"] for each in secrets.values()} == {f"{name.replace('_', '-')}-key", "healthcheck-key"}
    assert all(each["defaultMode"] & 0o007 == 0 for each in secrets.values())
    places = {each["mountPath"]: each.get("readOnly", False) for each in container["volumeMounts"]}
    assert places.pop("/certificates")
    assert places.pop("/healthcheck")
    assert {*places} == {"/tmp", *{"recorder": {"/recordings"}, "diagnosis": {"/versions"}}.get(name, set())}


def test_a_secret_holds_what_a_process_needs_and_nothing_of_the_authority(keys, documents):
    secrets = _of(documents, "Secret")
    assert {*secrets} == {*[f"{name.replace('_', '-')}-key" for name in SHIPPED], "healthcheck-key", "robot-keys"}
    files = {"authority.pem", "safety_filter.pem", "safety_filter.key.pem"}
    assert {*secrets["safety-filter-key"]["data"]} == files
    for file, text in secrets["safety-filter-key"]["data"].items():
        assert base64.b64decode(text) == (keys / file).read_bytes()
    assert not any("authority.key.pem" in each["data"] for each in secrets.values())


@pytest.mark.parametrize("name", [*SHIPPED, "robot"])
def test_rights_are_those_that_the_strictest_namespace_asks_for(documents: list[Document], name: str) -> None:
    pod, container = _pod(documents, name)
    rights = container["securityContext"]
    assert not rights["allowPrivilegeEscalation"]
    assert rights["capabilities"] == {"drop": ["ALL"]}
    assert rights["readOnlyRootFilesystem"]
    assert pod["securityContext"]["runAsNonRoot"]
    assert pod["securityContext"]["runAsUser"] == 10001
    assert "USER 10001" in (ROOT / "deploy" / "Dockerfile").read_text(encoding="utf-8")
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert not pod["automountServiceAccountToken"]
    (namespace,) = _of(documents, "Namespace").values()
    assert namespace["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"


@each_service
def test_of_each_service_but_the_filter_there_is_one_and_the_loop_has_whole_cores_on_one_node(documents, name):
    deployment = _of(documents, "Deployment")[name.replace("_", "-")]["spec"]
    # A third filter, as a surge would start, has no certificate that the router lets join.
    two = (2, {"type": "RollingUpdate", "rollingUpdate": {"maxSurge": 0, "maxUnavailable": 1}})
    wanted = two if name == "safety_filter" else (1, {"type": "Recreate"})
    assert (deployment["replicas"], deployment["strategy"]) == wanted
    pod, container = _pod(documents, name)
    limits, asked = container["resources"]["limits"], container["resources"]["requests"]
    assert limits["memory"] == COMPOSE[name]["mem_limit"].replace("m", "Mi").replace("g", "Gi")
    assert (limits == asked) == (name in LOOP)
    alongside = [each["topologyKey"] for each in _alongside(pod)]
    assert alongside == (["kubernetes.io/hostname"] if name in LOOP[1:] else [])


def test_every_object_and_pod_has_the_recommended_labels(documents: list[Document]) -> None:
    templates = [each["spec"]["template"] for each in documents if "template" in each.get("spec", {})]
    for each in [*(each for each in documents if each["kind"] != "Secret"), *templates]:
        labels = {name.rpartition("/")[2]: value for name, value in each["metadata"]["labels"].items()}
        assert (labels["part-of"], labels["version"]) == ("safedpa", "0.1.0")
        assert labels["component"]


def test_the_base_for_kustomize_lists_every_object_but_the_keys(documents: list[Document], tmp_path: Path) -> None:
    files = write_base(documents, tmp_path / "base")
    assert {file.name for file in (tmp_path / "base").iterdir()} == {file.name for file in files}
    base = yaml.safe_load((tmp_path / "base" / "kustomization.yaml").read_text(encoding="utf-8"))
    held = [yaml.safe_load((tmp_path / "base" / name).read_text(encoding="utf-8")) for name in base["resources"]]
    assert held == [each for each in documents if each["kind"] != "Secret"]


def _alongside(pod: Document) -> list[Document]:
    found: list[Document] = (
        pod.get("affinity", {}).get("podAffinity", {}).get("requiredDuringSchedulingIgnoredDuringExecution", [])
    )
    assert all(each["labelSelector"]["matchLabels"] == {"app": "router"} for each in found)
    return found


def test_nothing_but_the_router_is_reached_and_from_outside_by_robots_alone(documents: list[Document]) -> None:
    policies = {name: each["spec"] for name, each in _of(documents, "NetworkPolicy").items()}
    nothing = policies.pop("nothing-else")
    assert nothing == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"], "ingress": [], "egress": []}
    out, into = policies.pop("to-the-router"), policies.pop("into-the-router")
    assert policies == {}
    assert [rule["ports"][0]["port"] for rule in out["egress"]] == [7447, 53]
    assert into["podSelector"] == {"matchLabels": {"app": "router"}}
    assert into["ingress"][0]["from"] == [{"podSelector": {}}, {"ipBlock": {"cidr": "10.20.0.0/16"}}]
    outside = [each["spec"] for each in _of(documents, "Service").values() if each["spec"].get("type") != "ClusterIP"]
    assert [each["loadBalancerSourceRanges"] for each in outside if "type" in each] == [["10.20.0.0/16"]]
    alone = _of(region("west"), "NetworkPolicy")["into-the-router"]["spec"]["ingress"][0]["from"]
    assert alone == [{"podSelector": {}}]


def test_every_command_reaches_the_router_by_a_name_that_its_certificate_has(documents: list[Document]) -> None:
    assert "router" in HOSTS
    assert _of(documents, "Service")["router"]["spec"]["ports"][0]["port"] == 7447
    for name in ("safety_filter", "robot", "recorder"):
        args = _pod(documents, name)[1]["args"]
        assert args[args.index("--connect") + 1] == "tls/router:7447"


def test_a_simulated_robot_sees_its_own_key_alone(documents: list[Document], keys: Path) -> None:
    spec = _of(documents, "StatefulSet")["robot"]["spec"]
    assert (spec["replicas"], spec["ordinals"]) == (2, {"start": 1})
    pod, container = _pod(documents, "robot")
    mount = next(each for each in container["volumeMounts"] if each["mountPath"] == "/certificates")
    assert (mount["subPathExpr"], mount["readOnly"]) == ("$(SAFEDPA_NAME)", True)
    items = next(each["secret"]["items"] for each in pod["volumes"] if each["name"] == "robot-keys")
    assert {(item["path"], item["key"]) for item in items} == {
        (f"{name}/{file}", file)
        for name in ("robot-1", "robot-2")
        for file in ("authority.pem", f"robot.{name}.pem", f"robot.{name}.key.pem")
    }
    assert {*_of(documents, "Secret")["robot-keys"]["data"]} == {item["key"] for item in items}
    assert container["args"][container["args"].index("--certificates") + 1] == "/certificates"
    assert (keys / "robot.robot-2.pem").exists()


def test_a_robot_that_has_its_certificate_does_not_ask_for_one(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "create_connection", lambda *_: pytest.fail("asked"))
    robot_start.enrol("robot.robot-1", keys)


@pytest.mark.parametrize(
    ("phrase", "notice"),
    [
        (["--robots", "17"], "--robots 17: wanted 0 to as many as docker-compose.yml lets its router accept"),
        (["--robots", "-1"], "--robots -1"), (["--namespace", "West_1"], "--namespace 'West_1'"),
        (["--namespace", ""], "--namespace ''"), (["--certificates", "nowhere"], "nowhere"),
        (["--robots-from", "10.20.0.1/16"], "10.20.0.1/16"),
    ],
)  # fmt: skip
def test_impossible_options_are_refused_in_one_line(phrase: list[str], notice: str) -> None:
    command = [sys.executable, str(ROOT / "deploy" / "kubernetes_region.py"), *phrase]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert notice in done.stderr
    assert "Traceback" not in done.stderr


def test_the_written_file_is_the_generated_one(keys: Path) -> None:
    command = [sys.executable, str(ROOT / "deploy" / "kubernetes_region.py"), "--robots", "2", "--namespace", "west"]
    done = subprocess.run([*command, "--certificates", str(keys)], capture_output=True, text=True, check=True)
    assert list(yaml.safe_load_all(done.stdout)) == region("west", 2, keys)
