"""The base class of the shipped robots: effects from the package next to them, filter settings from a named file."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from safedpa.robot import AbstractRobot

if TYPE_CHECKING:
    from safedpa.effects import AbstractEffect
    from safedpa.safety.settings import FilterSettings


class ShippedRobot(AbstractRobot):
    """A robot in a package ``safedpa.robots.NAME``."""

    effects_of_its_own = True

    def effects(self) -> Iterable[AbstractEffect]:  # noqa: D102
        from safedpa.effects.library import effects_in_package

        return effects_in_package(f"safedpa.robots.{self.name}.effects")

    def settings(self) -> FilterSettings:  # noqa: D102
        from safedpa.safety.defaults import settings_named

        return settings_named(self.settings_name)
