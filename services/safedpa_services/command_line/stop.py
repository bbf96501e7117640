"""``safedpa stop``: makes robots brake and stay stationary until ``safedpa go``."""

from __future__ import annotations

from typing import Any

import click

from safedpa_services.command_line.bus_options import listening_options, who_option
from safedpa_services.command_line.stop_orders import give_order


@click.command()
@listening_options
@click.option("--robot", default="", help="only this robot; default: the whole fleet")
@who_option
def command(robot: str, **options: Any) -> None:
    """Stop a robot or the whole fleet.

    The safety filter ignores the policy and brakes. A car stays stationary, a pendulum is kept within its corridor. The
    order holds until 'safedpa go'. The answer says whether it also survives a restart of the filter.
    """
    give_order("stop", robot, options)
