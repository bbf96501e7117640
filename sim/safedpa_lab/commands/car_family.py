"""The options that every experiment with a family of the car's policies has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import click

__all__ = ["with_family"]

Command = TypeVar("Command", bound=Callable[..., object])


def with_family(command: Command) -> Command:
    """Adds --models and --family."""
    models = click.option(
        "--models",
        type=click.Path(path_type=Path),
        help="folder of the learned models; learned/car or learned/car_paper when left out, by the family",
    )
    family = click.option(
        "--family",
        default="best",
        show_default=True,
        help="policies: best, ours with all that helps them; paper, trained and calibrated without loads or filter",
    )
    return models(family(command))
