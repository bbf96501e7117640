"""The web server of the workbench: one page for each browser tab, everything served from this machine."""

from __future__ import annotations

import contextlib
from importlib.resources import files
from pathlib import Path

import click
from nicegui import Client, app, ui

from safedpa_services.workbench.page import Page
from safedpa_services.workbench.recordings import Choice

__all__ = ["serve"]


def serve(choice: Choice, out: Path, host: str, port: int, *, browser: bool) -> None:
    """Serves the page until it is interrupted."""
    style = (files("safedpa_services.workbench") / "page.css").read_text(encoding="utf-8")

    @ui.page("/", title="safedpa workbench")
    async def index(client: Client) -> None:
        ui.add_css(style)
        page = Page(choice, out)
        client.on_delete(page.close)
        await client.connected()
        await page.begin()

    app.on_startup(lambda: click.echo(f"Workbench: http://{_named(host)}:{port}  (Ctrl-C ends it)"))
    with contextlib.suppress(KeyboardInterrupt):  # which is how a person ends it
        ui.run(
            host=host,
            port=port,
            title="safedpa workbench",
            reload=False,
            show=browser,
            show_welcome_message=False,
            tailwind=False,
            reconnect_timeout=10.0,
        )


def _named(host: str) -> str:
    return "127.0.0.1" if host in ("0.0.0.0", "") else host
