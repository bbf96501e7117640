"""``python -m safedpa_services.router``: routes messages between the processes of a fleet, with access control."""

from __future__ import annotations

import argparse
from pathlib import Path

from safedpa.bus import Bus, ZenohSettings, ZenohTransport
from safedpa.bus.logging import log_event
from safedpa.bus.security.access_control import ROUTER, access_control, rate_limits, size_limits
from safedpa.bus.service.process import (
    RealtimePriority,
    StopSignal,
    add_credentials_option,
    identity_from_options,
    run_process,
)
from safedpa.errors import InputError
from safedpa_services.router.refusals import LOG_DIRECTIVES, Refusals, capture_zenoh_log
from safedpa_services.router.router import LoopWatchdog, Router, read_revocation_list

REVOKED = "revoked.txt"
"""File in the folder of certificates with the names of revoked certificates, one per line."""


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Routes until ``stop``; returns the exit code."""
    settings = _settings(options)
    refusals = Refusals()
    capture_zenoh_log(LOG_DIRECTIVES, refusals.hear)
    transport = ZenohTransport(settings)
    refusals.name_of = transport.name_of
    with Bus(transport, options.fleet) as bus:
        log_event(
            "router.open",
            f"routes fleet '{options.fleet}' on {', '.join(settings.listen)}"
            f"{', plain text without access control' if options.plain else ''}",
            level="warning" if options.plain else "info",
            service=ROUTER,
            robots=", ".join(options.robot),
        )
        revoked = None if options.certificates is None else options.certificates / REVOKED
        standby = "safety_filter" if options.standby else ""
        Router(bus, refusals, transport.members, transport.cut_off, revoked, standby).run(stop, LoopWatchdog())
    return 0


def _settings(options: argparse.Namespace) -> ZenohSettings:
    listen, connect = tuple(options.listen), tuple(options.connect)
    if not listen:
        raise InputError("--listen: got none, wanted an endpoint such as tls/0.0.0.0:7447")
    limits = tuple(size_limits(options.fleet))
    rates = tuple(rate_limits(options.fleet, options.robot))
    if options.plain:
        if options.certificates is not None or options.card is not None:
            raise InputError("--plain: got it together with --certificates, wanted one of them")
        return ZenohSettings("router", listen, connect, limits=limits, rates=rates)
    if options.certificates is None and options.card is None:
        raise InputError("--certificates: got none, wanted the folder of 'safedpa certificates' (or --plain)")
    certificates = identity_from_options(options)
    access = access_control(options.fleet, options.robot, dict(map(_link, options.link)))
    revoked = frozenset[str]() if options.certificates is None else read_revocation_list(options.certificates / REVOKED)
    access["policies"] = [policy for policy in access["policies"] if not revoked & {*policy["subjects"]}]
    return ZenohSettings("router", listen, connect, certificates, access, limits, rates)


def _link(text: str) -> tuple[str, tuple[str, ...]]:
    """Parses ``router.west=r1,r2``: name of a router's certificate, and the robots whose messages it may forward."""
    name, _, robots = text.partition("=")
    return name, tuple(robots.split(",")) if robots else ()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="safedpa-router")
    parser.add_argument("--fleet", default="fleet", help="name of the fleet")
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help="such as tls/0.0.0.0:7447")
    parser.add_argument(
        "--connect", action="append", default=[], metavar="ENDPOINT", help="another router of the fleet"
    )
    parser.add_argument("--certificates", type=Path, metavar="DIR", help="folder from 'safedpa certificates'")
    parser.add_argument("--role", default=ROUTER, help="role whose certificate to use; default: router")
    add_credentials_option(parser)
    parser.add_argument(
        "--robot", action="append", default=[], metavar="NAME", help="a robot that may join; repeatable"
    )
    parser.add_argument(
        "--link",
        action="append",
        default=[],
        metavar="router.NAME[=ROBOT,...]",
        help="another router that may connect, and the robots whose messages it may forward; default: all",
    )
    parser.add_argument(
        "--standby", action="store_true", help="a second safety filter may wait with the same certificate"
    )
    parser.add_argument("--plain", action="store_true", help="no certificates: every client may do everything")
    return parser


if __name__ == "__main__":
    run_process(work, _parser(), RealtimePriority.ROUTER)
