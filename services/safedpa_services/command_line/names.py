"""Names on the command line: the nearest one where a name is wrong, and all of them for the Tab key."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import click
from click.shell_completion import CompletionItem

from safedpa.errors import did_you_mean

__all__ = ["SuggestingChoice", "complete_effects", "complete_models", "complete_robots"]


class SuggestingChoice(click.Choice[Any]):
    """One of a few words; a wrong one is answered with the nearest."""

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        """The line that stands behind the option's name."""
        del ctx
        return f"got '{value}'; {did_you_mean(str(value), [str(choice) for choice in self.choices])}"


def complete_models(context: click.Context, item: click.Parameter, begun: str) -> list[CompletionItem]:
    """Names of models that ship, and whatever file the shell finds."""
    del context, item
    from safedpa.dynamics.model_file import shipped_models

    return [*_matching(shipped_models(), begun), CompletionItem(begun, type="file")]


def complete_effects(context: click.Context, item: click.Parameter, begun: str) -> list[CompletionItem]:
    """Names of effects: of the robot of the model that stands before, where it can be read; else of all."""
    del item
    from safedpa.dynamics import load_model
    from safedpa.effects import effects_of, robots
    from safedpa.errors import InputError

    known = robots()
    with contextlib.suppress(KeyError, TypeError, InputError):
        known = (load_model(context.params["model"]).system.name,)
    return _matching({name for robot in known for name in effects_of(robot)}, begun)


def complete_robots(context: click.Context, item: click.Parameter, begun: str) -> list[CompletionItem]:
    """Names of robots that ship."""
    del context, item
    from safedpa.robot import robots

    return _matching(robots(), begun)


def _matching(names: Iterable[str], begun: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in sorted(names) if name.startswith(begun)]
