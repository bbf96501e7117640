"""What the docs say of topics and messages is what the code says."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import STATE, Bus, MemoryBroker, MemoryTransport, ReceivedMessage, StateMessage

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.long
def test_the_generated_parts_are_current() -> None:
    program = [sys.executable, DOCS / "generate.py", "--check"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_generated_part_is_used() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))
    for name in ("topics", "flow", "fields"):
        assert f"<!-- generated: {name} -->" in pages


class Car:
    """A driver as the page on the bus wants it; its power fails after five ticks."""

    def __init__(self) -> None:
        self.ticks, self.braked = 0, 0

    def measure(self) -> tuple[float, ...]:
        self.ticks += 1
        if self.ticks > 5:
            raise ConnectionError("the power failed")
        return (0.0, 0.0, 0.0, 1.0)

    def goal(self) -> tuple[float, ...]:
        return (1.0, 1.0)

    def obstacles(self) -> tuple[tuple[float, ...], ...]:
        return ()

    def brake(self) -> tuple[float, ...]:
        self.braked += 1
        return (0.0, 0.0)


def test_the_example_of_a_real_robot_runs_and_brakes_where_no_one_answers() -> None:
    found = re.search(r"```python\n(.*?)```", (DOCS / "reference" / "bus.md").read_text(encoding="utf-8"), re.DOTALL)
    assert found
    names: dict[str, Any] = {}
    exec(compile(found[1], "docs/reference/bus.md", "exec"), names)
    broker, car = MemoryBroker(), Car()
    names["ZenohTransport"] = lambda settings: MemoryTransport(broker)
    inbox = Bus(MemoryTransport(broker), "fleet").inbox((STATE,), keep_all=True)
    with pytest.raises(ConnectionError):
        names["run"](car)
    states = [item.message for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)]
    assert [state.tick for state in states] == [0, 1, 2, 3, 4]
    assert [state.applied_by for state in states if isinstance(state, StateMessage)] == ["none", *["watchdog"] * 4]
    assert car.braked == 5
