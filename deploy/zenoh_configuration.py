"""Writes the configuration file with which eclipse/zenoh stands in for our own router.

    python deploy/zenoh_configuration.py --certificates DIR --robot robot-1 --robot robot-2 > zenoh.json5

Access control, size limits, TLS and lease are those of ``python -m safedpa_services.router``. DIR is named in the file
as ``--mounted``, where the container will find authority.pem, router.pem and router.key.pem.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from safedpa.bus import ZenohSettings
from safedpa.bus.security.access_control import ROUTER, access_control, size_limits
from safedpa.bus.security.certificates import Certificates


def document(fleet: str, robots: list[str], certificates: Certificates, listen: str, mounted: str) -> str:
    """The file's text. Raises BusError or InputError for what the router would refuse as well."""
    access, limits = access_control(fleet, robots), tuple(size_limits(fleet))
    settings = ZenohSettings("router", (listen,), (), certificates, access, limits)
    nested: dict[str, object] = {}
    for path, value in settings.configuration().items():
        *folders, name = path.split("/")
        place = nested
        for folder in folders:
            place = place.setdefault(folder, {})  # type: ignore[assignment]
        place[name] = value
    return json.dumps(nested, indent=2).replace(str(certificates.folder), mounted)


def main() -> None:
    """Writes the file to standard output."""
    parser = argparse.ArgumentParser(prog="zenoh_configuration")
    parser.add_argument("--fleet", default="fleet")
    parser.add_argument("--robot", action="append", default=[], metavar="NAME")
    parser.add_argument("--certificates", type=Path, required=True, metavar="DIR")
    parser.add_argument("--listen", default="tls/0.0.0.0:7447")
    parser.add_argument("--mounted", default="/certificates")
    options = parser.parse_args()
    certificates = Certificates(options.certificates, ROUTER)
    text = document(options.fleet, options.robot, certificates, options.listen, options.mounted)
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
