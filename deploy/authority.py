"""The certificate authority of a fleet in containers: makes the services' certificates, signs those of the robots.

Each service finds its own key and no one else's in a volume of its own, ``/issued/ROLE``. A robot makes its key itself,
where it stays, and sends a request for a certificate over the network that it shares with this container alone. Who it
is, the request does not say: the engine's name service reports which container has the sender's address, and
``PROJECT_robot_3`` gets a certificate for ``robot.robot-3``. Without privileges no container takes another address.
Anyone who may start containers on this machine may also read every key; docs/guides/compose.md says what a real
deployment does.
"""

from __future__ import annotations

import argparse
import datetime
import re
import shutil
import socketserver
from pathlib import Path

from container_name import container_at

from safedpa.bus.logging import log_event
from safedpa.bus.security.access_control import ROUTER, check_names, roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.errors import SafedpaError

PORT = 7448
POLICY = "policy"
READY = Path("/tmp/ready")
LARGEST_REQUEST = 8192
_PATIENCE_SECONDS = 5.0


def issue_to_services(authority: Authority, issued: Path, days: float, routers: tuple[str, ...] = ()) -> None:
    """Gives every service its certificate, key, and the authority's certificate, unless it has good ones.

    ``routers`` are further routers, linked to the first one, with the role ``router.NAME`` under the host name NAME.
    """
    hosts = {ROUTER: HOSTS, **{f"{ROUTER}.{name}": (*HOSTS, name) for name in routers}}
    for role in dict.fromkeys((*roles_of(()), *hosts)):
        _issue_into(authority, issued / role, role, days, hosts.get(role, ()))


def issue_to_gateway(authority: Authority, folder: Path, robot: str, days: float, *, with_policy: bool) -> None:
    """Gives the gateway of a robot that speaks ROS 2 that robot's certificate, and the policy's with ``with_policy``.

    Removes the certificates of an earlier start for another robot, or for nominal actions that it may no longer send.
    """
    roles = (f"robot.{robot}", *((POLICY,) if with_policy else ()))
    for path in folder.glob("*.pem"):
        if path.name.removesuffix(".pem").removesuffix(".key") not in (*roles, "authority"):
            path.unlink()
    for role in roles:
        _issue_into(authority, folder, role, days)


def _issue_into(authority: Authority, folder: Path, role: str, days: float, hosts: tuple[str, ...] = ()) -> None:
    """Issues a certificate into an existing folder, unless there is a good one."""
    trusted = authority.folder / "authority.pem"
    if not folder.is_dir() or _is_good(folder / f"{role}.pem", trusted, days):
        return
    authority.issue(role, days, hosts)
    for name in (f"{role}.key.pem", f"{role}.pem"):
        shutil.move(authority.folder / name, folder / name)
    shutil.copy(trusted, folder / "authority.pem")
    log_event("authority.issued", f"a certificate for {role}, good for {days:g} days", service=role)


def _is_good(certificate: Path, authority: Path, days: float) -> bool:
    """Whether it is there, of this authority, and two thirds of its time are not over."""
    from cryptography import x509

    alongside = certificate.with_name("authority.pem")
    if not certificate.exists() or not alongside.exists() or alongside.read_bytes() != authority.read_bytes():
        return False
    ends = x509.load_pem_x509_certificate(certificate.read_bytes()).not_valid_after_utc
    return ends - datetime.datetime.now(datetime.UTC) > datetime.timedelta(days=days / 3.0)


class Enrolment(socketserver.StreamRequestHandler):
    """Answers one robot's request with its certificate, or with nothing."""

    timeout = _PATIENCE_SECONDS
    authority: Authority
    days: float

    def handle(self) -> None:
        """Reads the request, asks who sent it, signs."""
        address = str(self.client_address[0])
        try:
            role = robot_role(container_at(address))
            request = self.rfile.read(LARGEST_REQUEST)
            self.wfile.write(self.authority.sign(request, role, self.days))
        except (OSError, ValueError, SafedpaError) as error:
            log_event("authority.refused", f"a request from {address}: {error}", level="warning", address=address)
            return
        log_event("authority.issued", f"a certificate for {role}, good for {self.days:g} days", service=role)


def robot_role(container: str) -> str:
    """The role that a container of this name may have. Raises ValueError when it is no robot's."""
    found = re.search(r"[_-]robot[_-](\d+)$", container.split(".", maxsplit=1)[0])
    if found is None:
        raise ValueError(f"container '{container}' is no robot")
    return f"robot.robot-{int(found[1])}"


def main() -> None:
    """Makes what is missing, then serves for ever."""
    parser = argparse.ArgumentParser(prog="safedpa-authority")
    parser.add_argument("--fleet", default="fleet")
    parser.add_argument("--folder", type=Path, default=Path("/authority"), help="where its own key lies")
    parser.add_argument("--issued", type=Path, default=Path("/issued"), help="one folder a role")
    parser.add_argument("--days", type=float, default=90.0)
    parser.add_argument("--router", action="append", default=[], metavar="NAME", help="a further, linked router")
    parser.add_argument("--gateway", default="", metavar="ROBOT", help="a robot that speaks ROS 2, by a gateway")
    parser.add_argument("--with-policy", choices=("0", "1"), default="0", help="1: its own policy sends by the gateway")
    options = parser.parse_args()
    authority = Authority(options.folder, options.fleet)
    issue_to_services(authority, options.issued, options.days, tuple(options.router))
    if options.gateway:
        check_names(options.fleet, (options.gateway,))
        folder, with_policy = options.issued / "ros_gateway", options.with_policy == "1"
        issue_to_gateway(authority, folder, options.gateway, options.days, with_policy=with_policy)
    Enrolment.authority, Enrolment.days = authority, options.days
    socketserver.ThreadingTCPServer.allow_reuse_address = True
    with socketserver.ThreadingTCPServer(("0.0.0.0", PORT), Enrolment) as server:
        READY.touch()  # for the health check: who depends on certificates may start
        server.serve_forever()


if __name__ == "__main__":
    main()
