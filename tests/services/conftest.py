"""A clock that tests move, in place of the one of the standard library."""

import time

import pytest


class Clock:
    """``now`` [s], counted from ``begin``, goes on while something sleeps, and when a test says so."""

    begin = 1000.0

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.begin + self.now

    def sleep(self, seconds):
        assert seconds >= 0.0
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    """Replaces ``time.monotonic`` and ``time.sleep``."""
    made = Clock()
    monkeypatch.setattr(time, "monotonic", made)
    monkeypatch.setattr(time, "sleep", made.sleep)
    return made
