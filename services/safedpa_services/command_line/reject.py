"""``safedpa reject``: an effect that the diagnosis proposes for a robot is none."""

from __future__ import annotations

from typing import Any

import click

from safedpa_services.command_line.change_requests import ask_for_change, bus_options
from safedpa_services.command_line.names import complete_effects


@click.command()
@click.argument("robot")
@click.argument("effect", shell_complete=complete_effects)
@bus_options
def command(robot: str, effect: str, **options: Any) -> None:
    """Reject EFFECT, which the diagnosis proposes for the driving ROBOT; its model stays as it is."""
    ask_for_change("reject", robot, effect, options)
