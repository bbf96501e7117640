"""A tab of the page without a browser: its elements, clicks on its buttons, and what pops up."""

import asyncio
from html import unescape
from types import SimpleNamespace
from typing import Any

from nicegui import Client, core, ui
from nicegui.testing.user_interaction import UserInteraction


class Tab:
    """Use it as a context in which a page is built; lives in a running loop."""

    def __enter__(self):
        self._before, core.loop = core.loop, asyncio.get_running_loop()
        self.client = Client(ui.page("/"))
        self.client.__enter__()
        return self

    def __exit__(self, *raised):
        self.client.__exit__(*raised)
        core.loop = self._before

    def all(self, kind):
        """The elements of a kind, in the order in which they were made."""
        return [element for element in self.client.elements.values() if isinstance(element, kind)]

    @property
    def lines(self):
        """The texts that are visible."""
        shown = (element for element in self.all(ui.html) if element.visible and element.content)
        return [unescape(element.content) for element in shown]

    @property
    def popped_up(self):
        """The notifications so far, with their options."""
        return [options for _, kind, options in self.client.outbox.messages if kind == "notify"]

    def button(self, hint):
        """The button of that name for screen readers."""
        return next(button for button in self.all(ui.button) if button.props.get("aria-label") == hint)

    async def click(self, hint):
        """Clicks a button, and waits until all that it begins had its turn."""
        await self.trigger(self.button(hint), "click")

    async def trigger(self, element, event):
        """Has an element get an event of the browser."""
        user: Any = SimpleNamespace(client=self.client)
        UserInteraction(user, {element}, None).trigger(event)
        await turns()

    async def until(self, there):
        """Waits for what happens on its own."""
        for _ in range(6000):
            if there():
                return
            await asyncio.sleep(0.01)
        raise AssertionError("it did not come")


async def turns():
    """Lets tasks that were begun go on; none of them waits for anything outside."""
    for _ in range(20):
        await asyncio.sleep(0.0)
