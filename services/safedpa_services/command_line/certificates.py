"""``safedpa certificates``: an authority of the fleet's own, and a certificate for every role."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa_services.command_line.json_answer import answers_json, report_progress


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@click.option("--fleet", default="fleet", show_default=True, help="name of the fleet")
@click.option("--robot", "robots", multiple=True, metavar="NAME", help="a robot of the fleet; repeatable")
@click.option("--host", "hosts", multiple=True, metavar="NAME", help="host name or address of a router; repeatable")
@click.option("--router", "routers", multiple=True, metavar="NAME", help="one more router, as router.NAME; repeatable")
@click.option("--days", type=float, default=90.0, show_default=True, help="how long the certificates are good")
@click.option("--renew", is_flag=True, help="make those again that are there already")
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
    """Make in DIR an authority for the fleet, and a certificate with key for each of its roles.

    Certificates that are there already stay, so that a robot can be added later. authority.key.pem is what makes
    certificates: keep it away from robots and services, each of which needs authority.pem and its own two files alone.
    """
    from safedpa.bus.security.access_control import ROUTER, check_names, role_of_robot, roles_of
    from safedpa.bus.security.certificate_authority import HOSTS, Authority, check_days

    check_names(fleet, robots)
    check_days(days)  # before the authority is made
    authority = Authority(folder, fleet)
    made = "made" if authority.is_new else "there already"
    report_progress(
        f"{folder / 'authority.pem'}: {made}, for fleet '{fleet}'",
        facts={"folder": str(folder), "fleet": fleet, "made": [], "retained": []},
    )
    further = tuple(f"{ROUTER}.{name}" for name in routers)
    for role in (*roles_of(robots), *further):
        if (folder / f"{role}.pem").exists() and not renew:
            report_progress(f"{role}: there already", facts={"retained": [role]})
            continue
        names = (*HOSTS, *hosts) if role.split(".")[0] == ROUTER and role != role_of_robot(ROUTER) else ()
        authority.issue(role, days, names)
        where = f", accepts connections as {', '.join(dict.fromkeys(names))}" if names else ""
        report_progress(f"{role}: made, good for {days:g} days{where}", facts={"made": [role], "days": days})
