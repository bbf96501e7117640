"""``safedpa reject``: rejects an effect that the diagnosis proposes for a robot."""

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
    """Reject an EFFECT proposed for a driving ROBOT.

    The model does not change.
    """
    ask_for_change("reject", robot, effect, options)
