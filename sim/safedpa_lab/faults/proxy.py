"""A TCP proxy in front of the router with one port per process: the network of a test, bent while everything runs.

Zenoh's bytes on a TCP connection, cut into its own units, so that whole messages can be lost and nothing else.

TCP loses nothing: a lost packet is a pause. What loses messages is a sender that drops under congestion, a radio link
that carries datagrams, a full queue. To stand for those, whole batches are taken out of the stream: a batch is what
Zenoh writes at once, two bytes of length (little-endian) and then one transport message. Messages of the control loop
are sent `express`, one a batch. Left out are only batches that carry data, questions or answers (a frame whose first
network message is a push, request or response, or a fragment of one); handshakes, signs of life and declarations of
subscribers arrive, as Zenoh sends them once per connection and relies on it.
Source: Zenoh protocol 1.x, `commons/zenoh-protocol` (identifiers in `transport/mod.rs` and `network/mod.rs`).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import threading
from collections.abc import Coroutine
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypeVar, final

from safedpa.errors import BusError


@dataclass(frozen=True)
class Conduct:
    """Both directions alike unless their names say otherwise; towards the router is *out*, from it is *in*."""

    delay: float = 0.0
    """s that every byte is late."""
    loss: float = 0.0
    """Probability with which a batch that carries data is taken out of the stream."""
    stalled_out: bool = False
    stalled_in: bool = False
    """Nothing is read or handed on; what was sent meanwhile arrives afterwards, as after a real partition."""
    bytes_per_second_in: float = 0.0
    """A reader that is no faster than this; 0: as fast as it comes."""
    pause_every: float = 0.0
    """s; in each such time the link is stationary for ``pause`` s, then hands on everything at once."""
    pause: float = 0.0
    cut: bool = False
    """Every connection is closed and every new one refused."""


PASS = Conduct()
STALLED = Conduct(stalled_out=True, stalled_in=True)
"""The network is gone: no byte arrives, and no one is informed."""
HALF_OPEN = Conduct(stalled_out=True)
"""What the process says is lost; it hears everything."""
CUT = Conduct(cut=True)


_LENGTH_BYTES = 2
_IDENTIFIER = 0x1F
_FRAME, _FRAGMENT = 0x05, 0x06
_MORE = 0x80
"""A continuation bit of a number, and the flag that extensions follow."""
_DATA = (0x1D, 0x1C, 0x1B)
"""push, request, response"""


@final
class Batches:
    """Cuts a stream of bytes into batches, each with its length in front."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, chunk: bytes) -> list[bytes]:
        """The batches that are complete now, in order."""
        self._rest += chunk
        whole = []
        while len(self._rest) >= _LENGTH_BYTES:
            end = _LENGTH_BYTES + int.from_bytes(self._rest[:_LENGTH_BYTES], "little")
            if len(self._rest) < end:
                break
            whole.append(self._rest[:end])
            self._rest = self._rest[end:]
        return whole


def carries_data(batch: bytes) -> bool:
    """Whether a batch carries what a publisher, an asker or an answerer said; False for what cannot be read."""
    body = batch[_LENGTH_BYTES:]
    if not body:
        return False
    kind = body[0] & _IDENTIFIER
    if kind == _FRAGMENT:
        return True
    if kind != _FRAME:
        return False
    try:
        position = _after_number(body, 1)  # behind the sequence number
        extended = bool(body[0] & _MORE)
        while extended:
            extended = bool(body[position] & _MORE)
            position = _after_extension(body, position)
        return body[position] & _IDENTIFIER in _DATA
    except IndexError:
        return False


def _after_number(body: bytes, position: int) -> int:
    while body[position] & _MORE:
        position += 1
    return position + 1


def _after_extension(body: bytes, position: int) -> int:
    """Two bits of its header say what follows: nothing, a number, or a number of bytes."""
    encoding = (body[position] >> 5) & 0x03
    if encoding == 0:
        return position + 1
    behind = _after_number(body, position + 1)
    if encoding == 1:
        return behind
    size = sum((byte & 0x7F) << (7 * index) for index, byte in enumerate(body[position + 1 : behind]))
    return behind + size


_Result = TypeVar("_Result")
_CHUNK_BYTES = 16 * 1024
_WAITING_CHUNKS = 4
"""On their way in one direction: a link that is stationary makes its sender wait, as a full pipe does."""
_SMALL_BUFFER = 4096
"""Of sockets: what a slow reader has not read waits at the sender, not in the kernel's megabytes."""
_PATIENCE_SECONDS = 5.0
_REAL_TIME_PRIORITY = 10


@final
class _Link:
    """All connections of one process."""

    def __init__(self, router: tuple[str, int], seed: int) -> None:
        self.conduct = PASS
        self.changed = asyncio.Event()
        self.lost = 0
        """Batches that were taken out."""
        self._router, self._chance = router, random.Random(seed)
        self._writers: set[asyncio.StreamWriter] = set()

    def set(self, conduct: Conduct) -> None:
        """From now on, for the connections that are open as well."""
        self.conduct = conduct
        self.changed.set()
        self.changed = asyncio.Event()
        if conduct.cut:
            self.close()

    def close(self) -> None:
        """Ends every connection at once, without a farewell."""
        for writer in self._writers:
            writer.transport.abort()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, until either side ends it."""
        if self.conduct.cut:
            writer.transport.abort()
            return
        try:
            router_reader, router_writer = await asyncio.open_connection(sock=await self._connected())
        except OSError:
            writer.transport.abort()
            return
        ends = {writer, router_writer}
        self._writers |= ends
        for end in ends:
            end.transport.set_write_buffer_limits(0)
            end.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        pumps = [
            asyncio.create_task(self._pump(reader, router_writer, outwards=True)),
            asyncio.create_task(self._pump(router_reader, writer, outwards=False)),
        ]
        try:
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for pump in pumps:
                pump.cancel()
            for end in ends:
                end.transport.abort()
            self._writers -= ends

    async def _connected(self) -> socket.socket:
        end = socket.socket()
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SMALL_BUFFER)
        end.setblocking(False)
        try:
            await asyncio.get_running_loop().sock_connect(end, self._router)
        except OSError:
            end.close()
            raise
        return end

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, outwards: bool) -> None:
        """Reads on one side, hands on at the other, through a short queue; ends when one of them does."""
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_WAITING_CHUNKS)
        tasks = [
            asyncio.create_task(self._read(reader, waiting)),
            asyncio.create_task(self._write(waiting, writer, outwards=outwards)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()

    async def _read(self, reader: asyncio.StreamReader, waiting: asyncio.Queue[tuple[float, bytes]]) -> None:
        now = asyncio.get_running_loop().time
        batches = Batches()
        while chunk := await reader.read(_CHUNK_BYTES):
            retained = b"".join(batch for batch in batches.feed(chunk) if not self._loses(batch))
            if retained:
                await waiting.put((now(), retained))

    def _loses(self, batch: bytes) -> bool:
        lost = self.conduct.loss > 0.0 and carries_data(batch) and self._chance.random() < self.conduct.loss
        self.lost += lost
        return lost

    async def _write(
        self, waiting: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter, *, outwards: bool
    ) -> None:
        while True:
            arrived, chunk = await waiting.get()
            await self._hold(arrived, outwards=outwards)
            rate = 0.0 if outwards else self.conduct.bytes_per_second_in
            writer.write(chunk)
            with contextlib.suppress(ConnectionError):
                await writer.drain()
            if writer.is_closing():
                return
            if rate > 0.0:
                await asyncio.sleep(len(chunk) / rate)

    async def _hold(self, arrived: float, *, outwards: bool) -> None:
        """Returns when what arrived then may go on."""
        now = asyncio.get_running_loop().time
        while True:
            conduct, changed = self.conduct, self.changed
            if conduct.stalled_out if outwards else conduct.stalled_in:
                await changed.wait()
                continue
            free = arrived + conduct.delay
            if conduct.pause_every > 0.0 and now() % conduct.pause_every < conduct.pause:
                free = max(free, now() + conduct.pause - now() % conduct.pause_every)
            if free <= now():
                return
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), free - now())


class Proxy:
    """Opens one port of the loopback interface per name; each leads to the router at ``router`` (host, port).

    It runs on a thread of its own. Only plain TCP can lose messages: what is encrypted cannot be cut into batches. The
    chances of loss are drawn from ``seed``. Raises BusError when a port cannot be opened.
    """

    def __init__(self, router: tuple[str, int], names: tuple[str, ...], seed: int = 0) -> None:
        self.ports: dict[str, int] = {}
        """By name; a process connects to ``tcp/127.0.0.1:PORT``."""
        self._loop = asyncio.new_event_loop()
        self._links: dict[str, _Link] = {}
        self._servers: list[asyncio.Server] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        for index, name in enumerate(names):
            self._links[name] = self._done(self._open(name, router, seed + index))

    def endpoint(self, name: str) -> str:
        """Where the process of that name connects to."""
        return f"tcp/127.0.0.1:{self.ports[name]}"

    def set(self, name: str, conduct: Conduct) -> None:
        """Bends one link, for what is in flight already as well."""
        self._done(self._set(self._links[name], conduct))

    def lost(self, name: str) -> int:
        """Batches of this link that were taken out so far."""
        return self._links[name].lost

    def close(self) -> None:
        """Ends every connection."""
        self._done(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_PATIENCE_SECONDS)
        self._loop.close()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        with contextlib.suppress(OSError):  # this thread alone: a network is no process that waits for the processor
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_REAL_TIME_PRIORITY))
        self._loop.run_forever()

    def _done(self, work: Coroutine[Any, Any, _Result]) -> _Result:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(_PATIENCE_SECONDS)

    async def _open(self, name: str, router: tuple[str, int], seed: int) -> _Link:
        link = _Link(router, seed)
        try:
            server = await asyncio.start_server(link.serve, "127.0.0.1", 0)
        except OSError as error:
            raise BusError(f"proxy: no port for '{name}' ({error.strerror}); end some programs that listen") from error
        self._servers.append(server)
        self.ports[name] = server.sockets[0].getsockname()[1]
        return link

    async def _set(self, link: _Link, conduct: Conduct) -> None:
        link.set(conduct)

    async def _close(self) -> None:
        for server in self._servers:
            server.close()
        for link in self._links.values():
            link.close()
        tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
