"""``safedpa accept``: adds a proposed effect to the model of a driving robot."""

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
    """Add a proposed EFFECT to the model of a driving ROBOT.

    Adaptation, policy and safety filter switch to the new model at the same tick, or all keep the old one.
    """
    ask_for_change("accept", robot, effect, options)
