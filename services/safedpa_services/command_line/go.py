"""``safedpa go``: robots that an order stopped may drive again."""

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
    """Let a robot, or the whole fleet, drive again that was stopped by 'safedpa stop'.

    Without --robot the order to the whole fleet is lifted; robots that were stopped one by one stay where they are.
    """
    give_order("go", robot, options)
