"""``safedpa experiment``: what the product shows, measured."""

from __future__ import annotations

import importlib

import click

from safedpa.errors import did_you_mean

__all__ = ["EXPERIMENTS", "command"]

EXPERIMENTS = (
    "adversary", "all", "bad-data", "car", "car-curves", "controllers", "demo", "diagnosis-pictures",
    "differential-drive", "faults", "fleet-diagnosis", "hidden-effects", "hostile", "live", "long-logs", "margins",
    "meeting", "pendulum", "pendulum-story", "point", "point-heat-map", "point-learning", "point-relinearised",
    "point-story", "real-logs", "ros", "safety", "safety-pays", "sensing", "sensing-curves", "sensing-margins",
    "theory", "tuning",
)  # fmt: skip
"""One file each in the folder ``experiments``, with options of its own; imported when it is called."""


class _Experiments(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return list(EXPERIMENTS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        del ctx
        if cmd_name not in EXPERIMENTS:
            raise click.UsageError(f"experiment '{cmd_name}': {did_you_mean(cmd_name, EXPERIMENTS)}")
        module = f"safedpa_lab.commands.experiments.{cmd_name.replace('-', '_')}"
        found: click.Command = importlib.import_module(module).command
        return found


@click.command(name="experiment", cls=_Experiments)
def command() -> None:
    """Run an experiment: what the product shows, measured."""
