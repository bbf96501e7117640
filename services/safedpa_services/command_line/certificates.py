"""``safedpa certificates``: creates a certificate authority for a fleet, and a certificate for every role."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.options import PATH


@click.command()
@click.argument("folder", type=PATH, metavar="DIR")
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet")
@click.option("--robot", "robots", multiple=True, metavar="NAME", help="a robot of the fleet; repeatable")
@click.option("--host", "hosts", multiple=True, metavar="NAME", help="host name or IP address of a router; repeatable")
@click.option(
    "--router", "routers", multiple=True, metavar="NAME", help="further router, with the role router.NAME; repeatable"
)
@click.option("--days", type=float, default=90.0, show_default=True, help="validity of the certificates")
@click.option("--renew", is_flag=True, help="replace existing certificates")
@answers_json
def command(
    folder: Path,
    fleet: str,
    robots: tuple[str, ...],
    hosts: tuple[str, ...],
    routers: tuple[str, ...],
    days: float,
    renew: bool,
) -> None:
    """Create a certificate authority and certificates in DIR.

    Each role of the fleet gets a certificate with key.
    Existing certificates are kept, so you can add a robot later. Keep authority.key.pem, with which certificates are
    issued, away from robots and services: each of them needs only authority.pem and its own two files.
    """
    from safedpa.bus.security.access_control import ROUTER, check_names, role_of_robot, roles_of
    from safedpa.bus.security.certificate_authority import HOSTS, Authority, check_days

    check_names(fleet, robots)
    check_days(days)  # before the authority is made
    authority = Authority(folder, fleet)
    state = "created" if authority.is_new else "exists already"
    report_progress(
        f"{folder / 'authority.pem'}: {state}, for fleet '{fleet}'",
        facts={"folder": str(folder), "fleet": fleet, "made": [], "retained": []},
    )
    further = tuple(f"{ROUTER}.{name}" for name in routers)
    for role in (*roles_of(robots), *further):
        if (folder / f"{role}.pem").exists() and not renew:
            report_progress(f"{role}: exists already", facts={"retained": [role]})
            continue
        names = (*HOSTS, *hosts) if role.split(".")[0] == ROUTER and role != role_of_robot(ROUTER) else ()
        authority.issue(role, days, names)
        where = f", accepts connections as {', '.join(dict.fromkeys(names))}" if names else ""
        report_progress(f"{role}: created, valid for {days:g} days{where}", facts={"made": [role], "days": days})
