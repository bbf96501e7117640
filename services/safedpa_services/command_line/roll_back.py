"""``safedpa roll-back``: restores the model that a robot had before its last change."""

from __future__ import annotations

from typing import Any

import click

from safedpa_services.command_line.change_requests import ask_for_change, bus_options


@click.command()
@click.argument("robot")
@bus_options
def command(robot: str, **options: Any) -> None:
    """Restore the previous model of a driving ROBOT.

    This is the model before the last accepted effect.
    """
    ask_for_change("roll_back", robot, "", options)
