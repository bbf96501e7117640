"""The web server of the workbench: one session for all browser tabs, with every file served from this machine."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
import traceback
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import click
from nicegui import Client, app, ui

from safedpa.bus import Bus
from safedpa.bus.service.process import StopSignal
from safedpa.limits import limit, readable
from safedpa_services.web.browser import show
from safedpa_services.web.guard import Guard
from safedpa_services.web.hosts import is_loopback
from safedpa_services.web.page_options import TOKEN_VARIABLE, PageServerOptions, keep_token
from safedpa_services.web.server import server_options
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench.live.links import AbstractLink, LiveLink, ReplayLink
from safedpa_services.workbench.live.page import LivePage
from safedpa_services.workbench.page import WorkbenchPage
from safedpa_services.workbench.panels.elements import apply_page_style
from safedpa_services.workbench.rerun_viewer import RerunViewerServer
from safedpa_services.workbench.session.controller import SessionController
from safedpa_services.workbench.tab import AbstractTab

_EXPOSED = "serves on {host}: other machines can request the page, and anyone with the token can change models"
_LISTEN_SECONDS = 0.1
_PROBE_SECONDS, _MAX_PROBES = 0.02, 500
_END_MESSAGE_SECONDS = 4.0
"""s that the server waits at the end of a drive, until the browsers have confirmed that they show the end."""
_RECONNECT_SECONDS = 30.0
"""s for which a page is kept after its connection was lost; a browser that is silent for 0.4 of it counts as lost.

A browser is silent on a busy machine or while a native dialog is open; reloading the page would lose typed text."""


def serve(
    controller: SessionController,
    serving: PageServerOptions,
    *,
    browser: bool,
    bus: Bus | Path | None = None,
    stop: StopSignal | None = None,
    announce: Callable[[str], None] = lambda where: click.echo(f"Workbench: {where}  (Ctrl-C ends it)"),
) -> None:
    """Serves the page until Ctrl-C or ``stop``; with a bus, or a recording of one, also the live page.

    Requests without the token are refused. Only recordings below the allowed folders can be opened.
    """
    style = (files("safedpa_services.workbench") / "page.css").read_text(encoding="utf-8")
    link = None if bus is None else (ReplayLink(bus) if isinstance(bus, Path) else LiveLink(bus))
    viewer_server, choice = RerunViewerServer(), controller.choice
    _redirect_tracebacks(controller.out / "workbench.log")
    own_model = [choice.model] if Path(choice.model).is_file() else []
    upload_store = FileStore.of((*choice.runs, *own_model), serving.folders)
    app.add_middleware(Guard, options=serving)
    if not os.environ.get(TOKEN_VARIABLE):
        keep_token(controller.out, serving.token)

    page = partial(WorkbenchPage, controller, viewer_server, upload_store, live=link is not None)
    _add_page("/", WorkbenchPage.title, style, page)
    app.on_shutdown(controller.close)
    if link is not None:
        _add_page("/live", LivePage.title, style, partial(LivePage, link))
        app.timer(_LISTEN_SECONDS, link.listen)
    where = serving.address("/" if link is None else "/live")
    if not is_loopback(serving.host):
        click.echo(f"Workbench: {_EXPOSED.format(host=serving.host)}", err=True)
    app.on_startup(lambda: _announce_when_ready(serving, where, announce, browser=browser))
    if stop is not None:
        # the web server's own signal handler would skip the end message
        app.on_startup(lambda: stop.listen_to_signals(app.shutdown))
        threading.Thread(target=_end_with, args=(stop, link), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):  # the regular way to stop the server
        ui.run(
            host=serving.host,
            port=serving.port,
            ssl_certfile=serving.certificate,
            ssl_keyfile=serving.key,
            ws_max_size=limit("socket_bytes"),
            **server_options(),
            title="safedpa workbench",
            reload=False,
            show=False,
            show_welcome_message=False,
            tailwind=False,
            reconnect_timeout=_RECONNECT_SECONDS,
        )


async def _announce_when_ready(
    serving: PageServerOptions, where: str, announce: Callable[[str], None], *, browser: bool
) -> None:
    """Announces the address once the server accepts connections: it starts to listen only after its startup hook."""
    host = "127.0.0.1" if serving.host in ("0.0.0.0", "", "::") else serving.host
    for _ in range(_MAX_PROBES):
        try:
            _, writer = await asyncio.open_connection(host, serving.port)
        except OSError:
            await asyncio.sleep(_PROBE_SECONDS)
            continue
        writer.close()
        break
    announce(where)
    if browser:
        show(where)


def _add_page(path: str, title: str, style: str, tab: Callable[[], AbstractTab]) -> None:
    """Serves a page; ``tab`` builds it for each browser tab."""

    @ui.page(path, title=title)
    async def shown(client: Client) -> None:
        apply_page_style(style)
        page = tab()
        client.on_delete(page.close)
        await client.connected()
        await page.begin()


def _end_with(stop: StopSignal, link: AbstractLink | None) -> None:
    stop.wait()
    if link is not None:
        link.ended, until = True, time.monotonic() + _END_MESSAGE_SECONDS
        while link.pages_to_notify and time.monotonic() < until:
            time.sleep(0.05)
    app.shutdown()


_MAX_MESSAGE_LENGTH = 300
_MAX_BYTES = 4_000_000
_DISCONNECTED = ("No response returned.",)
"""Errors of the web framework for a browser that disconnects before the response; they are not logged."""


def _redirect_tracebacks(path: Path) -> None:
    """Replaces each traceback in this process's log by one line, and writes the traceback to ``path``.

    The file is created at the first error and limited to 4 MB.
    """
    default_factory = logging.getLogRecordFactory()

    def record_factory(*arguments: Any, **options: Any) -> logging.LogRecord:
        record = default_factory(*arguments, **options)
        error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
        if error is None and isinstance(record.msg, BaseException):
            error = record.msg
        if error is None:
            return record
        record.browser_disconnected = str(error) in _DISCONNECTED or isinstance(error, ConnectionError)
        _append_traceback(path, error)
        notice = readable(f"{type(error).__name__}: {' '.join(str(error).split())}", _MAX_MESSAGE_LENGTH)
        record.msg, record.args = f"the page goes on after an error ({notice}); more in {path}", ()
        record.exc_info = record.exc_text = None
        return record

    logging.setLogRecordFactory(record_factory)
    logging.getLogger("uvicorn.error").addFilter(lambda record: not getattr(record, "browser_disconnected", False))


def _append_traceback(path: Path, error: BaseException) -> None:
    with contextlib.suppress(OSError):
        if path.exists() and path.stat().st_size > _MAX_BYTES:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(time.strftime("%Y-%m-%d %H:%M:%S\n") + "".join(traceback.format_exception(error)) + "\n")
