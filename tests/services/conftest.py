"""A clock that tests set, instead of the one of the standard library."""

import time

import pytest


class Clock:
    """A clock at ``begin + now`` [s], which advances with ``sleep`` and when a test sets ``now``."""

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
