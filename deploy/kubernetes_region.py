"""Writes a region of the fleet for Kubernetes: the services that ``docker-compose.yml`` starts, as Kubernetes objects.

    python deploy/kubernetes_region.py --namespace west --certificates keys --robots 4 | kubectl apply -f -

Images, commands, health checks, limits and rights are read from the compose file; the objects are those of
``kubernetes_region.yml.j2``. docs/guides/kubernetes.md describes the differences. ``--certificates`` is a folder of
``safedpa certificates``: each role's three files become a Secret that its pod alone mounts; without it the Secrets have
to exist. ``--robots`` simulates so many; real robots reach the router by a load balancer, from the networks that
``--robots-from`` names. ``--kustomize DIR`` writes a base for Kustomize instead of one document: a file per object.
"""

from __future__ import annotations

import argparse
import base64
import os
import re
import sys
from collections.abc import Mapping, Sequence
from ipaddress import ip_network
from pathlib import Path
from typing import Any

import jinja2
import yaml

Document = dict[str, Any]

COMPOSE = Path(__file__).resolve().parents[1] / "docker-compose.yml"
TEMPLATE = Path(__file__).with_suffix(".yml.j2")
AUTHORITY, ROUTER, ROBOT, HEALTH = "authority", "router", "robot", "healthcheck"
WITH_STANDBY = "safety_filter"
"""The service with a second pod that waits for the lease of the first."""
PORT = 7447
USER = 10001
"""Of the images."""
_ALL_SHARES = 4096
"""CPU shares of a container of the loop, which gets whole cores."""
_VERSION = re.findall(r'^version = "([^"]+)"', (COMPOSE.parent / "pyproject.toml").read_text(encoding="utf-8"), re.M)[0]
_ABOUT_BASE = """\
# A region of the fleet, written by deploy/kubernetes_region.py. In your overlay: resources: [../base], namespace: NAME,
# images: [{name: safedpa-router, newName: REGISTRY/safedpa-router, newTag: TAG}, ...], and the Secrets ROLE-key.
"""
_VARIABLE = re.compile(r"\$\{(\w+):-([^}]*)\}")


def region(namespace: str, robots: int = 0, certificates: Path | None = None, outside: Sequence[str] = ()) -> list[Any]:
    """Returns all documents.

    Raises OSError for a missing certificate, ValueError for an invalid network or namespace, and for more robots than
    the router lets join.
    """
    compose = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    services = {name: each for name, each in compose.items() if name != AUTHORITY and "profiles" not in each}
    robot, names = services.pop(ROBOT), [f"robot-{number}" for number in range(1, robots + 1)]
    if not re.fullmatch(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?", namespace):
        raise ValueError(f"--namespace '{namespace}': wanted at most 63 small letters, digits and '-' within")
    if robots < 0 or not {*names} <= {*services[ROUTER]["command"]}:
        raise ValueError(f"--robots {robots}: wanted 0 to as many as {COMPOSE.name} lets its router accept")
    secrets = {}
    if certificates is not None:
        secrets = {f"{_dns(role)}-key": _files(certificates, [role]) for role in (*services, HEALTH)}
        if names:
            secrets["robot-keys"] = _files(certificates, [f"robot.{name}" for name in names])
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    text = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        namespace=namespace,
        secrets=secrets,
        outside=[str(ip_network(one)) for one in outside],
        services=[_described(name, service) for name, service in services.items()],
        robot=_described(ROBOT, robot),
        names=names,
        labels=_labels,
        port=PORT,
        user=USER,
    )
    return list(yaml.safe_load_all(text))


def _labels(component: str) -> dict[str, str]:
    """Returns the labels that Kubernetes recommends."""
    return {
        "app.kubernetes.io/name": "safedpa",
        "app.kubernetes.io/component": component,
        "app.kubernetes.io/part-of": "safedpa",
        "app.kubernetes.io/version": _VERSION,
        "app.kubernetes.io/managed-by": "kubernetes_region.py",
    }


def write_base(documents: Sequence[Document], folder: Path) -> list[Path]:
    """Writes ``kustomization.yaml`` and a file per object; returns the files. Secrets are left out, with a comment.

    Raises OSError if the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for document in documents:
        if document["kind"] == "Secret":  # keys belong into no repository of manifests
            continue
        files.append(folder / f"{document['kind'].lower()}-{document['metadata']['name']}.yaml")
        files[-1].write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    base = {
        "apiVersion": "kustomize.config.k8s.io/v1beta1",
        "kind": "Kustomization",
        "resources": [file.name for file in files],
    }
    files.append(folder / "kustomization.yaml")
    files[-1].write_text(_ABOUT_BASE + yaml.safe_dump(base, sort_keys=False), encoding="utf-8")
    return files


def _files(folder: Path, roles: Sequence[str]) -> dict[str, str]:
    names = [f"{AUTHORITY}.pem", *[f"{role}{end}" for role in roles for end in (".pem", ".key.pem")]]
    return {name: base64.b64encode((folder / name).read_bytes()).decode() for name in names}


def _described(name: str, service: Mapping[str, Any]) -> Document:
    """Returns what the template needs of a service of the compose file."""
    mounts = [tuple(entry.split(":")[:2]) for entry in service["volumes"]]
    args = [_resolved(word) for word in service["command"]]
    if name == ROBOT:  # its keys are mounted elsewhere
        place = args[args.index("--certificates") + 1]
        args = ["/certificates" if word == place else word for word in args]
    if name in (ROUTER, WITH_STANDBY):
        args.append("--standby")
    ports = [int(entry.rsplit(":", 1)[1]) for entry in service.get("ports", ())]
    limits = {"cpu": str(service["cpus"]), "memory": _size(service["mem_limit"])}
    share = round(1000 * float(service["cpus"]) * service["cpu_shares"] / _ALL_SHARES)
    in_the_loop = service["cpu_shares"] == _ALL_SHARES
    memory = re.search(r"size=(\w+)", service["tmpfs"][0])
    assert memory is not None
    return {
        **service,
        "name": _dns(name),
        "args": args,
        "replicas": 2 if name == WITH_STANDBY else 1,
        "env": [{"name": key, "value": _resolved(value)} for key, value in service.get("environment", {}).items()],
        "open": ports or ([PORT] if name == ROUTER else []),
        "ports": [{"containerPort": port} for port in ports],
        "limits": limits,
        "requests": limits if in_the_loop else {**limits, "cpu": f"{share}m"},
        "is_of_the_loop": in_the_loop,
        "probe": _probe(service["healthcheck"]),
        "grace": _seconds(service["stop_grace_period"]),
        "tmp": _size(memory[1]),
        "mounts": mounts,
        "claims": [source for source, _ in mounts if not source.endswith("-key")],
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


def _resolved(text: object) -> str:
    """Resolves variables as Compose does: by the environment, otherwise by their default."""
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
    parser.add_argument("--kustomize", type=Path, metavar="DIR", help="write a base for Kustomize, without Secrets")
    options = parser.parse_args()
    try:
        documents = region(options.namespace, options.robots, options.certificates, options.robots_from)
        if options.kustomize is not None:
            write_base(documents, options.kustomize)
            return
    except (OSError, ValueError) as error:
        parser.error(str(error))
    yaml.safe_dump_all(documents, sys.stdout, sort_keys=False)


if __name__ == "__main__":
    main()
