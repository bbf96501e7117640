"""How a link of the proxy treats what passes through it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CUT", "HALF_OPEN", "PASS", "STALLED", "Conduct", "bursts", "delayed", "losing", "slow"]


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


def delayed(seconds: float) -> Conduct:
    """Everything arrives ``seconds`` later, each way."""
    return Conduct(delay=seconds)


def losing(share: float) -> Conduct:
    """Every ``share``-th batch of data is lost at random, each way."""
    return Conduct(loss=share)


def slow(bytes_per_second: float) -> Conduct:
    """The process reads no faster than this."""
    return Conduct(bytes_per_second_in=bytes_per_second)


def bursts(pause: float, every: float) -> Conduct:
    """Packet loss as TCP shows it: the stream is stationary for ``pause`` s in each ``every`` s."""
    return Conduct(pause=pause, pause_every=every)
