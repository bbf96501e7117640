"""Which faults there are, when a change is cut off, and what is read from recordings and of the robot's own files."""

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import STATE, VERDICT, WISH, ModelMessage, TakeoverMessage
from safedpa_lab.faults import recorded
from safedpa_lab.faults.model_changes import partitioned_changes
from safedpa_lab.faults.table import all_faults
from safedpa_lab.faults.world import World, WorldSettings

NAMES = [fault.name for fault in all_faults()]


def test_links_are_cut_and_half_open() -> None:
    assert {name for name in NAMES if name.startswith(("cut", "half-open"))} == {
        "cut policy", "cut safety_filter", "cut robot", "half-open adaptation", "half-open safety_filter",
        "half-open robot",
    }  # fmt: skip
    assert len({fault.sentence for fault in all_faults() if fault.kind in ("cut", "half-open")}) == 6


def test_every_loop_hangs_and_three_interpreters_are_gripped() -> None:
    assert {name for name in NAMES if name.startswith("grip")} == {"grip policy", "grip safety_filter", "grip recorder"}
    hung = {name.removeprefix("hang ") for name in NAMES if name.startswith("hang ")}
    assert hung >= {"adaptation", "policy", "safety_filter", "recorder", "diagnosis"}


def model(step: str) -> ModelMessage:
    return ModelMessage(
        epoch=1, tick=1, robot_time=0.0, publish_time=0.0, step=step, change=1, fingerprint="f", replaces="e"
    )


def takeover(service: str, state: str) -> TakeoverMessage:
    return TakeoverMessage(
        epoch=1, tick=1, robot_time=0.0, publish_time=0.0, service=service, change=1, fingerprint="f", state=state
    )


OTHERS = [model("offer"), takeover("adaptation", "ready"), takeover("policy", "taken"), model("drop")]


@pytest.mark.parametrize(
    ("fault", "heard", "came"),
    [
        ("change-take policy", [*OTHERS, model("take")], True),
        ("change-take policy", [model("take"), *OTHERS], True),
        ("change-take policy", OTHERS, False),
        ("change-take policy", [], False),
        ("change-ready policy", [*OTHERS, takeover("policy", "ready")], True),
        ("change-ready policy", [takeover("policy", "ready"), *OTHERS], True),
        ("change-ready policy", OTHERS, False),
        ("change-ready diagnosis", OTHERS, True),  # of the diagnosis: as soon as any service is ready
        ("change-ready diagnosis", [model("offer"), takeover("policy", "refused")], False),
        ("change-asked policy", [], None),  # the network is cut before the change is requested
    ],
)
@pytest.mark.parametrize("before", [[], [model("take"), takeover("policy", "ready"), takeover("diagnosis", "ready")]])
def test_a_service_is_cut_off_at_its_moment_of_a_change(
    fault: str, heard: list[Any], came: bool | None, before: list[Any]
) -> None:
    """Messages from before the fault do not count."""
    said = [(0.0, message) for message in before]
    steps: list[Any] = []

    def until(condition: Any, _: float) -> bool:
        found = condition()
        steps.append(found)
        said.extend((1.0, message) for message in heard if len(steps) == 1)
        return bool(found)

    world: Any = SimpleNamespace(
        observer=SimpleNamespace(said=said), until=until, request=lambda *_: None,
        bend=lambda _conduct, name: steps.append(name),
    )  # fmt: skip
    (wanted,) = [one for one in partitioned_changes() if one.name == fault]
    wanted.strike(world)
    target = fault.split()[1]
    assert steps == ([target, False] if came is None else [False, came, target])


def test_all_messages_are_counted_and_stamps_are_those_of_one_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files; other robots and other topics count among the messages alone."""

    def message(tick: int, epoch: int = 1) -> Any:
        return SimpleNamespace(epoch=epoch, tick=tick)

    state, verdict, wish = STATE.name, VERDICT.name, WISH.name
    files = {
        "a": [(f"f/v/r1/{state}/x", message(1)), (f"f/v/r1/{verdict}/x", message(1)),
              (f"f/v/r2/{state}/x", message(7))],
        "b": [(f"f/v/r1/{state}/x", message(2)), (f"f/v/r1/{wish}/x", message(2)),
              (f"f/v/r1/{state}/x", message(1, 2)), (f"f/v/r1/{verdict}/x", message(1))],
    }  # fmt: skip
    monkeypatch.setattr(
        recorded, "read_messages", lambda file, _: iter([(key, 0, one) for key, one in files[file.name]])
    )
    found = recorded.read_recorded([Path("a"), Path("b")], "r1")
    assert found.messages == 7
    assert found.states == {(1, 1), (1, 2), (2, 1)}
    assert found.verdicts == {(1, 1)}
    assert found.lost([(1, 1), (1, 3), (1, 3), (2, 2)], [(1, 1), (1, 2)]) == (2, 1)
    assert recorded.read_recorded([], "r1").messages == 0


def test_a_robot_of_the_campaign_writes_its_own_trace_and_connects_through_the_proxy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On its own disk: from these files every fault is judged."""
    monkeypatch.setattr(shutil, "which", lambda _: None)  # no file system is mounted
    world = World(tmp_path, WorldSettings(seed=7, load="box"))
    robot = world.members["robot"]
    world.close()
    given = dict(pairwise(robot.arguments))
    assert robot.module == "safedpa_sim.robots"
    assert (given["--trace"], given["--summary"]) == (str(world.trace), str(tmp_path / "robot.json"))
    assert (given["--load"], given["--seed"], given["--connect"]) == ("box", "7", world.proxy.endpoint("robot"))
    assert "--realtime" in robot.arguments
