"""Names on the command line: suggestions for misspelt names, and shell completion."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import click
from click.shell_completion import CompletionItem

from safedpa.errors import did_you_mean


class SuggestingChoice(click.Choice[Any]):
    """A choice that suggests the nearest value for an unknown one."""

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        """Returns the message that click prints after the option's name."""
        del ctx
        return f"got '{value}'; {did_you_mean(str(value), [str(choice) for choice in self.choices])}"


def complete_models(context: click.Context, item: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes names of shipped models, and files."""
    del context, item
    from safedpa.dynamics.model_file import shipped_models

    return [*_matching(shipped_models(), incomplete), CompletionItem(incomplete, type="file")]


def complete_effects(context: click.Context, item: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes names of effects: those of the robot of a model that was given before, else all."""
    del item
    from safedpa.dynamics import load_model
    from safedpa.effects import effects_of, robots
    from safedpa.errors import InputError

    known = robots()
    with contextlib.suppress(KeyError, TypeError, InputError):
        known = (load_model(context.params["model"]).system.name,)
    return _matching({name for robot in known for name in effects_of(robot)}, incomplete)


def complete_robots(context: click.Context, item: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes names of shipped robots."""
    del context, item
    from safedpa.systems.robots import robots

    return _matching(robots(), incomplete)


def _matching(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in sorted(names) if name.startswith(incomplete)]
