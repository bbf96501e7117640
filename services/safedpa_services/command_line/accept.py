"""``safedpa accept``: adds a proposed effect to the model of a robot that drives."""

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
    """Add EFFECT, which the diagnosis proposes, to the model of the driving ROBOT.

    Adaptation, policy and safety filter take over the new model at one tick, or all stay on the old one.
    """
    ask_for_change("accept", robot, effect, options)
