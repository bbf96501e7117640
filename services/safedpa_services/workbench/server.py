"""The web server of the workbench: one bench for all browser tabs, everything served from this machine."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import time
import traceback
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import click
from nicegui import Client, app, ui

from safedpa.bus import Bus
from safedpa.bus.service.process import StopSignal
from safedpa.errors import InputError
from safedpa.limits import limit, readable
from safedpa_services.web.browser import show
from safedpa_services.web.guard import Guard
from safedpa_services.web.hosts import is_loopback
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench.bench import Bench
from safedpa_services.workbench.elements import apply_page_style
from safedpa_services.workbench.live_link import LiveLink
from safedpa_services.workbench.live_page import LivePage
from safedpa_services.workbench.page import WorkbenchPage
from safedpa_services.workbench.page_address import PageServerOptions
from safedpa_services.workbench.replay_link import ReplayLink
from safedpa_services.workbench.rerun_view import RerunViewerServer

__all__ = ["DEFAULT_PORT", "chosen_port", "serve"]

DEFAULT_PORT = 8080
_MOST_PORTS = 50
_OPEN = (
    "serves on {host}: every machine that reaches this one can ask for the page; who has the way in may change models"
)
_LISTEN_SECONDS = 0.1
_LOOK_SECONDS, _MOST_LOOKS = 0.02, 500
_LAST_WORD_SECONDS = 4.0
"""For the browsers to say that they show the end of the drive."""
_RECONNECT_SECONDS = 30.0
"""s for which a page that lost its connection is kept. A browser that is silent for 0.4 of it counts as lost: on a busy
machine, or while it asks something of a person, it may be, and a page that is loaded again loses what was typed."""


def serve(
    bench: Bench,
    serving: PageServerOptions,
    *,
    browser: bool,
    bus: Bus | Path | None = None,
    stop: StopSignal | None = None,
    announce: Callable[[str], None] = lambda where: click.echo(f"Workbench: {where}  (Ctrl-C ends it)"),
) -> None:
    """Serves the page until it is interrupted or ``stop``; with a bus, or a recording of one, the live page as well.

    Only who has the token comes in, and recordings are opened below the named folders alone.
    """
    style = (files("safedpa_services.workbench") / "page.css").read_text(encoding="utf-8")
    link = None if bus is None else (ReplayLink(bus) if isinstance(bus, Path) else LiveLink(bus))
    door, choice = RerunViewerServer(), bench.choice
    _keep_tracebacks_in(bench.out / "workbench.log")
    upload_store = FileStore.of(
        (*choice.runs, *([choice.model] if Path(choice.model).is_file() else [])), serving.folders
    )
    app.add_middleware(Guard, door=serving.door)

    @ui.page("/", title="safedpa workbench")
    async def recordings(client: Client) -> None:
        apply_page_style(style)
        page = WorkbenchPage(bench, door, upload_store, live=link is not None)
        client.on_delete(page.close)
        await client.connected()
        await page.begin()

    app.on_shutdown(bench.close)
    if link is not None:
        _serve_live(link, style)
    where = serving.address("/" if link is None else "/live")
    if not is_loopback(serving.host):
        click.echo(f"Workbench: {_OPEN.format(host=serving.host)}", err=True)
    app.on_startup(lambda: _reported_when_it_answers(serving, where, announce, browser=browser))
    if stop is not None:
        app.on_startup(lambda: stop.listen_to_signals(app.shutdown))  # the web server's own way out leaves no last word
        threading.Thread(target=_end_with, args=(stop, link), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):  # which is how a person ends it
        ui.run(
            host=serving.host,
            port=serving.port,
            ssl_certfile=serving.certificate,
            ssl_keyfile=serving.key,
            ws_max_size=limit("socket_bytes"),
            title="safedpa workbench",
            reload=False,
            show=False,
            show_welcome_message=False,
            tailwind=False,
            reconnect_timeout=_RECONNECT_SECONDS,
        )


async def _reported_when_it_answers(
    serving: PageServerOptions, where: str, announce: Callable[[str], None], *, browser: bool
) -> None:
    """The web server listens a moment after it has started up; an address that is told earlier is refused."""
    host = "127.0.0.1" if serving.host in ("0.0.0.0", "", "::") else serving.host
    for _ in range(_MOST_LOOKS):
        try:
            _, writer = await asyncio.open_connection(host, serving.port)
        except OSError:
            await asyncio.sleep(_LOOK_SECONDS)
            continue
        writer.close()
        break
    announce(where)
    if browser:
        show(where)


def _serve_live(link: LiveLink | ReplayLink, style: str) -> None:
    @ui.page("/live", title="safedpa workbench, live")
    async def live(client: Client) -> None:
        apply_page_style(style)
        page = LivePage(link)
        client.on_delete(page.close)
        await client.connected()
        await page.begin()

    app.timer(_LISTEN_SECONDS, link.listen)


def _end_with(stop: StopSignal, link: LiveLink | ReplayLink | None) -> None:
    stop.wait()
    if link is not None:
        link.ended, until = True, time.monotonic() + _LAST_WORD_SECONDS
        while link.untold and time.monotonic() < until:
            time.sleep(0.05)
    app.shutdown()


def chosen_port(host: str, port: int | None) -> int:
    """The port asked for, or the first free one from 8080 on; raises InputError when it is taken."""
    for number in [port] if port is not None else range(DEFAULT_PORT, DEFAULT_PORT + _MOST_PORTS):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, number))
            except OSError as error:
                if port is not None:
                    raise InputError(
                        f"--port {port}: cannot be served on ({error.strerror}); leave it out for the next free one"
                    ) from error
                continue
            return number
    raise InputError(f"--port: {DEFAULT_PORT} to {DEFAULT_PORT + _MOST_PORTS - 1} are all taken; name another one")


_LONGEST = 300
_MOST_BYTES = 4_000_000
_LEFT = ("No response returned.",)
"""What the web framework says where a browser hangs up before its answer: no one needs to hear of that."""


def _keep_tracebacks_in(path: Path) -> None:
    """From now on every log record of this process that has a traceback is one line, and the traceback is in ``path``.

    The file is made at the first one; what does not fit into 4 MB is not kept.
    """
    plain = logging.getLogRecordFactory()

    def made(*arguments: Any, **options: Any) -> logging.LogRecord:
        record = plain(*arguments, **options)
        error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
        if error is None and isinstance(record.msg, BaseException):
            error = record.msg
        if error is None:
            return record
        record.browser_left = str(error) in _LEFT or isinstance(error, ConnectionError)
        _keep(path, error)
        notice = readable(f"{type(error).__name__}: {' '.join(str(error).split())}", _LONGEST)
        record.msg, record.args = f"the page goes on after an error ({notice}); more in {path}", ()
        record.exc_info = record.exc_text = None
        return record

    logging.setLogRecordFactory(made)
    logging.getLogger("uvicorn.error").addFilter(lambda record: not getattr(record, "browser_left", False))


def _keep(path: Path, error: BaseException) -> None:
    with contextlib.suppress(OSError):
        if path.exists() and path.stat().st_size > _MOST_BYTES:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(time.strftime("%Y-%m-%d %H:%M:%S\n") + "".join(traceback.format_exception(error)) + "\n")
