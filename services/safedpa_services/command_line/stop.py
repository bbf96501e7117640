"""``safedpa stop``: robots brake and stand until ``safedpa go``."""

from __future__ import annotations

from typing import Any

import click

from safedpa_services.command_line.bus_options import listening_options, who_option
from safedpa_services.command_line.stop_orders import give_order


@click.command()
@listening_options
@click.option("--robot", default="", help="this robot alone; default: the whole fleet")
@who_option
def command(robot: str, **options: Any) -> None:
    """Stop a robot or the whole fleet: the safety filter hands on no nominal action of the policy any more and brakes.

    A car stands, a pendulum is kept within its corridor. The order holds until 'safedpa go'; whether it also holds over
    a restart of the filter stands in the answer.
    """
    give_order("stop", robot, options)
