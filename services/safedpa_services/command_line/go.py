"""``safedpa go``: lifts a stop order."""

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
    """Lift a stop order, so that robots drive again.

    Without --robot the order for the whole fleet is lifted; robots that were stopped individually stay stopped.
    """
    give_order("go", robot, options)
