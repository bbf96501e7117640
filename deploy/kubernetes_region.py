"""Writes a region of the fleet for Kubernetes: what ``docker-compose.yml`` starts, in Kubernetes' words.

    python deploy/kubernetes_region.py --namespace west --certificates keys --robots 4 | kubectl apply -f -

Images, commands, health checks, limits and rights are read from the compose file, so that what is tried there is what
runs here; docs/fleet-beyond-one-host.md says what is different. ``--certificates`` is a folder of ``safedpa
certificates``: each role's three files become a Secret that its pod alone mounts; without it the Secrets have to be
there. ``--robots`` simulates so many; real robots reach the router by a load balancer, from the networks that
``--robots-from`` names.
"""

from __future__ import annotations

import argparse
import base64
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from ipaddress import ip_network
from pathlib import Path
from typing import Any

import yaml

Document = dict[str, Any]

COMPOSE = Path(__file__).resolve().parents[1] / "docker-compose.yml"
AUTHORITY, ROUTER, ROBOT, HEALTH = "authority", "router", "robot", "healthcheck"
PORT = 7447
USER = 10001
"""Of the images."""
_ALL_SHARES = 4096
"""Of a container of the loop: it gets whole cores, and stands on the router's node, since each hop between nodes costs
latency of every tick."""
_KEY_MODE = 0o440
_DISK = "10Gi"
_VARIABLE = re.compile(r"\$\{(\w+):-([^}]*)\}")


def region(namespace: str, robots: int = 0, certificates: Path | None = None, outside: Sequence[str] = ()) -> list[Any]:
    """All documents.

    Raises OSError for a certificate that is missing, ValueError for a network that is none, and for more robots than
    the router lets join.
    """
    compose = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    services = {name: each for name, each in compose.items() if name != AUTHORITY and "profiles" not in each}
    robot, names = services.pop(ROBOT), [f"robot-{number}" for number in range(1, robots + 1)]
    if not re.fullmatch(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?", namespace):
        raise ValueError(f"--namespace '{namespace}': wanted at most 63 small letters, digits and '-' within")
    if robots < 0 or not {*names} <= {*services[ROUTER]["command"]}:
        raise ValueError(f"--robots {robots}: wanted 0 to as many as {COMPOSE.name} lets its router accept")
    documents: list[Document] = [_namespace(namespace)]
    if certificates is not None:
        documents += [_secret(f"{_dns(role)}-key", certificates, (role,)) for role in (*services, HEALTH)]
    documents += _policies(outside)
    documents.append(_service(ROUTER, ROUTER, (PORT,), "ClusterIP"))
    if outside:
        documents.append(_service(f"{ROUTER}-outside", ROUTER, (PORT,), "LoadBalancer", outside))
    for name, service in services.items():
        documents += _claims(service)
        if ports := _ports(service):
            documents.append(_service(_dns(name), _dns(name), ports, "ClusterIP"))
        documents.append(_deployment(name, service))
    if names:
        if certificates is not None:
            documents.append(_secret("robot-keys", certificates, tuple(f"robot.{name}" for name in names)))
        documents += [_headless(ROBOT), _simulated(robot, names)]
    for document in documents[1:]:
        document["metadata"]["namespace"] = namespace
    return documents


def _namespace(name: str) -> Document:
    labels = {"pod-security.kubernetes.io/enforce": "restricted"}
    return {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name, "labels": labels}}


def _secret(name: str, folder: Path, roles: Sequence[str]) -> Document:
    files = [f"{AUTHORITY}.pem", *[f"{role}{end}" for role in roles for end in (".pem", ".key.pem")]]
    data = {file: base64.b64encode((folder / file).read_bytes()).decode() for file in files}
    return {"apiVersion": "v1", "kind": "Secret", "type": "Opaque", "metadata": {"name": name}, "data": data}


def _policies(outside: Sequence[str]) -> Iterator[Document]:
    """Nothing comes in or goes out but to the router, and what asks the name service."""
    router = {"podSelector": {"matchLabels": {"app": ROUTER}}}
    names = {"namespaceSelector": {}, "podSelector": {"matchLabels": {"k8s-app": "kube-dns"}}}
    bus, asked = [_port(PORT)], [_port(53, "UDP"), _port(53)]
    yield _policy("nothing-else", {}, ingress=[], egress=[])
    yield _policy("to-the-router", {}, egress=[{"to": [router], "ports": bus}, {"to": [names], "ports": asked}])
    sources = [{"podSelector": {}}, *({"ipBlock": {"cidr": str(ip_network(one))}} for one in outside)]
    yield _policy("into-the-router", router["podSelector"], ingress=[{"from": sources, "ports": bus}])


def _policy(name: str, pods: Document, **rules: list[Document]) -> Document:
    spec = {"podSelector": pods, "policyTypes": [kind.capitalize() for kind in rules], **rules}
    return {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy", "metadata": {"name": name}, "spec": spec}


def _port(number: int, protocol: str = "TCP") -> Document:
    return {"protocol": protocol, "port": number}


def _service(name: str, pods: str, ports: Sequence[int], kind: str, outside: Sequence[str] = ()) -> Document:
    spec: Document = {"type": kind, "selector": {"app": pods}}
    spec["ports"] = [{"name": f"port-{port}", "port": port, "targetPort": port} for port in ports]
    if outside:
        spec |= {
            "loadBalancerSourceRanges": [str(ip_network(one)) for one in outside],
            "externalTrafficPolicy": "Local",
        }
    return {"apiVersion": "v1", "kind": "Service", "metadata": {"name": name}, "spec": spec}


def _headless(name: str) -> Document:
    spec = {"clusterIP": "None", "selector": {"app": name}}
    return {"apiVersion": "v1", "kind": "Service", "metadata": {"name": name}, "spec": spec}


def _claims(service: Mapping[str, Any]) -> Iterator[Document]:
    for source, _ in _mounts(service):
        if not source.endswith("-key"):
            spec = {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": _DISK}}}
            kind = {"apiVersion": "v1", "kind": "PersistentVolumeClaim", "metadata": {"name": source}}
            yield {**kind, "spec": spec}


def _deployment(name: str, service: Mapping[str, Any]) -> Document:
    """One pod and never two: two filters of one region must not run at once."""
    pod, container = _pod(service), _container(_dns(name), service)
    for source, place in _mounts(service):
        container["volumeMounts"].append({"name": source, "mountPath": place, "readOnly": source.endswith("-key")})
        pod["volumes"].append(_volume(source))
    if name != ROUTER and _of_the_loop(service):
        alongside = {"labelSelector": {"matchLabels": {"app": ROUTER}}, "topologyKey": "kubernetes.io/hostname"}
        pod["affinity"] = {"podAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": [alongside]}}
    spec = {
        "replicas": 1,
        "strategy": {"type": "Recreate"},
        **_template(_dns(name), {**pod, "containers": [container]}),
    }
    return {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": {"name": _dns(name)}, "spec": spec}


def _simulated(service: Mapping[str, Any], names: Sequence[str]) -> Document:
    """Robots with names that stay; each sees the part of the Secret that is its own."""
    pod, container = _pod(service), _container(ROBOT, service)
    place = container["args"][container["args"].index("--certificates") + 1]
    container["args"] = ["/certificates" if word == place else word for word in container["args"]]
    own = {"name": "SAFEDPA_NAME", "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}}
    container["env"].append(own)
    container["volumeMounts"] += [
        {"name": "robot-keys", "mountPath": "/certificates", "subPathExpr": "$(SAFEDPA_NAME)", "readOnly": True},
        {"name": f"{HEALTH}-key", "mountPath": f"/{HEALTH}", "readOnly": True},
    ]
    items = [
        {"key": key, "path": f"{name}/{key}"}
        for name in names
        for key in (f"{AUTHORITY}.pem", f"robot.{name}.pem", f"robot.{name}.key.pem")
    ]
    keys = {"name": "robot-keys", "secret": {"secretName": "robot-keys", "defaultMode": _KEY_MODE, "items": items}}
    pod["volumes"] += [keys, _volume(f"{HEALTH}-key")]
    spec = {"replicas": len(names), "serviceName": ROBOT, "ordinals": {"start": 1}, "podManagementPolicy": "Parallel"}
    spec |= _template(ROBOT, {**pod, "containers": [container]})
    return {"apiVersion": "apps/v1", "kind": "StatefulSet", "metadata": {"name": ROBOT}, "spec": spec}


def _template(name: str, pod: Document) -> Document:
    labels = {"app": name}
    return {"selector": {"matchLabels": labels}, "template": {"metadata": {"labels": labels}, "spec": pod}}


def _pod(service: Mapping[str, Any]) -> Document:
    rights = {"runAsNonRoot": True, "runAsUser": USER, "runAsGroup": USER, "fsGroup": USER}
    memory = {"medium": "Memory", "sizeLimit": _size(re.search(r"size=(\w+)", service["tmpfs"][0])[1])}  # type: ignore[index]
    return {
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": _seconds(service["stop_grace_period"]),
        "securityContext": {**rights, "seccompProfile": {"type": "RuntimeDefault"}},
        "volumes": [{"name": "tmp", "emptyDir": memory}],
    }


def _container(name: str, service: Mapping[str, Any]) -> Document:
    limits = {"cpu": str(service["cpus"]), "memory": _size(service["mem_limit"])}
    share = f"{round(1000 * float(service['cpus']) * service['cpu_shares'] / _ALL_SHARES)}m"
    asked = limits if _of_the_loop(service) else {**limits, "cpu": share}
    env = [{"name": key, "value": _resolved(value)} for key, value in service.get("environment", {}).items()]
    return {
        "name": name,
        "image": service["image"],
        "args": [_resolved(word) for word in service["command"]],
        "env": env,
        "ports": [{"containerPort": port} for port in _ports(service)],
        "volumeMounts": [{"name": "tmp", "mountPath": "/tmp"}],
        "resources": {"limits": limits, "requests": asked},
        "livenessProbe": _probe(service["healthcheck"]),
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": service["cap_drop"]},
            "readOnlyRootFilesystem": service["read_only"],
        },
    }


def _probe(check: Mapping[str, Any]) -> Document:
    kind, *phrase = check["test"]
    command = ["/bin/sh", "-c", *phrase] if kind == "CMD-SHELL" else phrase
    return {
        "exec": {"command": [_resolved(word) for word in command]},
        "initialDelaySeconds": _seconds(check["start_period"]),
        "periodSeconds": _seconds(check["interval"]),
        "timeoutSeconds": _seconds(check["timeout"]),
        "failureThreshold": check["retries"],
    }


def _volume(source: str) -> Document:
    if source.endswith("-key"):
        return {"name": source, "secret": {"secretName": source, "defaultMode": _KEY_MODE}}
    return {"name": source, "persistentVolumeClaim": {"claimName": source}}


def _of_the_loop(service: Mapping[str, Any]) -> bool:
    return bool(service["cpu_shares"] == _ALL_SHARES)


def _mounts(service: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Volume and place of each."""
    return [(entry.split(":")[0], entry.split(":")[1]) for entry in service["volumes"]]


def _ports(service: Mapping[str, Any]) -> list[int]:
    return [int(entry.rsplit(":", 1)[1]) for entry in service.get("ports", ())]


def _resolved(text: object) -> str:
    """As Compose reads it: with what the environment says, or what is taken where it says nothing."""
    found = _VARIABLE.sub(lambda match: os.environ.get(match[1]) or match[2], str(text))
    return found.replace("$$", "$")


def _dns(name: str) -> str:
    return name.replace("_", "-")


def _size(text: str) -> str:
    return f"{text[:-1]}{text[-1].upper()}i"


def _seconds(text: str) -> int:
    return int(text.removesuffix("s"))


def main() -> None:
    """Writes the documents to standard output."""
    parser = argparse.ArgumentParser(
        prog="kubernetes_region", description="a region of the fleet, for kubectl apply -f -"
    )
    parser.add_argument("--namespace", default="safedpa")
    parser.add_argument("--robots", type=int, default=0, metavar="N", help="simulated ones, robot-1 to robot-N")
    parser.add_argument("--certificates", type=Path, metavar="DIR", help="of safedpa certificates")
    parser.add_argument("--robots-from", action="append", default=[], metavar="CIDR", help="a network of real robots")
    options = parser.parse_args()
    try:
        documents = region(options.namespace, options.robots, options.certificates, options.robots_from)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    yaml.safe_dump_all(documents, sys.stdout, sort_keys=False)


if __name__ == "__main__":
    main()
