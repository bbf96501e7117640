"""Which faults there are, what is read of recordings, and what a long run reports about its processes."""

import os
import shutil
import threading
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.messages import STAMP

from safedpa.bus import NOMINAL, STATE, VERDICT, ModelMessage, TakeoverMessage
from safedpa.errors import InputError
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand
from safedpa_lab.faults import episode
from safedpa_lab.faults.endurance import Resources, Retained, Sample, retained_by
from safedpa_lab.faults.experiment import all_faults, faults_for, markdown_of
from safedpa_lab.faults.model_changes import partitioned_changes
from safedpa_lab.faults.world import Member, World, WorldSettings

COMMAND = ExperimentCommand(EXPERIMENTS["faults"])


def life(name: str, pid: int, begin: float, mib: list[float], handles: int = 9) -> list[Sample]:
    """Of one process, seen every 10 s."""
    return [Sample(begin + 10.0 * i, name, pid, one, handles, 4) for i, one in enumerate(mib)]


@pytest.mark.parametrize(
    ("samples", "retained"),
    [
        # the first half minute of a life is left out: samples at 130, 140, 150 and 160 s
        (life("policy", 7, 100.0, [10.0, 20.0, 30.0, 50.0, 50.0, 52.0, 60.0]),
         [Retained("policy", 1, 60.0, (50.0, 60.0), (9, 9), (4, 4))]),
        # quarters are of the time, not of the lives: samples at 30, 40, 50, 130, 140, 150 s have quarters of 30 s
        ([*life("policy", 7, 0.0, [0.0, 0.0, 0.0, 40.0, 42.0, 44.0]),
          *life("policy", 8, 100.0, [0.0, 0.0, 0.0, 70.0, 80.0, 90.0], handles=30)],
         [Retained("policy", 2, 50.0, (42.0, 80.0), (9, 30), (4, 4))]),
        # a process that lives for less than half a minute is left out; names are in order
        ([*life("robot", 3, 0.0, [5.0] * 4), *life("policy", 7, 0.0, [5.0] * 4), *life("adaptation", 8, 0.0, [5.0])],
         [Retained(name, 1, 30.0, (5.0, 5.0), (9, 9), (4, 4)) for name in ("policy", "robot")]),
        # a process with the pid of an earlier one is not as old as that one
        ([*life("policy", 7, 0.0, [5.0] * 4), *life("robot", 7, 100.0, [1.0, 1.0, 1.0, 8.0])],
         [Retained("policy", 1, 30.0, (5.0, 5.0), (9, 9), (4, 4)),
          Retained("robot", 1, 30.0, (8.0, 8.0), (9, 9), (4, 4))]),
    ],
)  # fmt: skip
def test_processes_are_summed_up_by_name(samples: list[Sample], retained: list[Retained]) -> None:
    assert retained_by(samples) == retained


@pytest.mark.parametrize(
    ("mib", "handles", "flat"),
    [
        ((100.0, 124.0), (20, 20), True),
        ((100.0, 126.0), (20, 20), False),
        ((20.0, 35.0), (20, 20), True),  # three quarters more, but only 15 MiB
        ((20.0, 37.0), (20, 20), False),
        ((100.0, 50.0), (20, 36), True),
        ((100.0, 50.0), (20, 37), False),
    ],
)
def test_growth_of_memory_or_open_files_is_reported(mib, handles, flat) -> None:
    assert Retained("policy", 1, 600.0, mib, handles, (4, 4)).flat is flat


def test_a_look_finds_this_process_and_no_other() -> None:
    resources = Resources(lambda: 12.5)
    with open(os.devnull, "rb") as one, open(os.devnull, "rb") as another:
        resources.look({"here": os.getpid(), "never started": 0, "gone": 2**22 + 1})
        del one, another
    resources.look({"here": os.getpid()})
    more, fewer = resources.samples
    assert (more.at, more.name, more.pid) == (12.5, "here", os.getpid())
    assert more.handles == fewer.handles + 2
    assert more.resident_mib > 10.0
    assert more.threads >= 1


def test_processes_are_looked_at_every_few_seconds_until_the_fleet_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    wait, waits = threading.Event.wait, list[float]()

    def quickly(event: threading.Event, timeout: float | None = None) -> bool:
        waits.extend([] if timeout is None else [timeout])
        return wait(event, None if timeout is None else timeout / 500.0)

    monkeypatch.setattr(threading.Event, "wait", quickly)
    resources = Resources()
    world: Any = SimpleNamespace(members={"here": SimpleNamespace(pid=os.getpid())})
    with resources.alongside(world):
        for _ in range(500):
            time.sleep(0.01)
            if len(resources.samples) >= 3:
                break
    count = len(resources.samples)
    assert count >= 3
    time.sleep(0.05)
    assert ({sample.name for sample in resources.samples}, len(resources.samples)) == ({"here"}, count)
    assert 1.0 <= min(waits) <= max(waits) <= 20.0


def test_an_hour_of_faults_comes_in_rounds_of_all_faults_of_one_fleet() -> None:
    once = {fault.name for fault in all_faults() if fault.diagnosis == "real"}
    faults = [fault.name for fault in faults_for(3600.0, seed=3)]
    assert len(faults) >= 1440, "at 2.5 s each"
    rounds = [faults[i : i + len(once)] for i in range(0, len(faults), len(once))]
    assert all(set(one) == once for one in rounds)
    assert rounds[0] != rounds[1]
    assert faults == [fault.name for fault in faults_for(3600.0, seed=3)]
    assert faults != [fault.name for fault in faults_for(3600.0, seed=4)]


def test_the_page_of_a_long_run_has_a_row_for_each_process() -> None:
    rows = [fault_row("kill policy", 0.4), fault_row("kill robot", 0.9), fault_row("stop policy", 0.1)]
    retained = {"name": "policy", "processes": 3, "longest_life_seconds": 612.4, "mib": (50.0, 90.0)}
    page = markdown_of(
        {
            "command": "safedpa experiment faults --minutes 60 --seed 3", "date": "2026-11-27 14:20", "seconds": 3600.0,
            "cores": 2, "load_before": 1.0, "load_after": 2.0, "collisions": 0, "stale_actions": 0, "periods": 72000,
            "acknowledged": 5, "recorded": 6, "rows": rows,
            "resources": [retained | {"handles": (9, 30), "threads": (4, 5), "flat": False}],
        }
    )  # fmt: skip
    assert "| policy | 3 | 612 | 50.0 to 90.0 | 9 to 30 | 4 to 5 | **grew** |" in page
    assert "| kill | 2 | 2 | 0%, 0% | 0.40 to 0.90 | 1.00 to 1.00 |" in page
    assert "kill policy" not in page, "of hundreds of faults only those that failed have a line"


def fault_row(name: str, recovery: float) -> dict[str, Any]:
    zero = dict.fromkeys(
        ("collisions", "stale_actions", "watchdog", "fallbacks", "states_not_recorded", "verdicts_not_recorded"), 0
    )
    return zero | {
        "name": name, "sentence": "", "held": True, "broken": (), "speed": 1.0, "periods": 60,
        "recovery_seconds": recovery, "whole_seconds": 1.0,
    }  # fmt: skip


def test_the_fate_of_a_process_includes_its_last_line(tmp_path: Path) -> None:
    member = Member("policy", "http.server", ("--bind", "nowhere.invalid", "0"), tmp_path / "policy.log")
    assert member.fate() == "its process lives", "it was not started, and did not end"
    member.start()
    end = time.monotonic() + 20.0
    while member.lives and time.monotonic() < end:
        time.sleep(0.02)
    assert member.fate().startswith("its process ended with 1: ")
    member.restart()
    member.kill()
    assert member.fate().startswith("its process ended with -9: ")


@pytest.mark.parametrize("minutes", ["nan", "inf", "1441"])
def test_an_endless_run_is_refused(minutes: str) -> None:
    with pytest.raises(InputError, match=r"--minutes: got .*, wanted 1440 at most"):
        COMMAND.main(["--minutes", minutes], standalone_mode=False)


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
    return ModelMessage(**STAMP, step=step, change=1, fingerprint="f", replaces="e")


def takeover(service: str, state: str) -> TakeoverMessage:
    return TakeoverMessage(**STAMP, service=service, change=1, fingerprint="f", state=state)


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
def test_a_service_is_cut_off_at_its_moment_of_a_change(fault, heard, came, before) -> None:
    """Messages from before the fault do not count."""
    notice = [(0.0, message) for message in before]
    steps: list[Any] = []

    def until(condition: Any, _: float) -> bool:
        found = condition()
        steps.append(found)
        notice.extend((1.0, message) for message in heard if len(steps) == 1)
        return bool(found)

    world: Any = SimpleNamespace(
        observer=SimpleNamespace(notice=notice), until=until, request=lambda *_: None,
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

    state, verdict, nominal = STATE.name, VERDICT.name, NOMINAL.name
    files = {
        "a": [(f"f/v/r1/{state}/x", message(1)), (f"f/v/r1/{verdict}/x", message(1)),
              (f"f/v/r2/{state}/x", message(7))],
        "b": [(f"f/v/r1/{state}/x", message(2)), (f"f/v/r1/{nominal}/x", message(2)),
              (f"f/v/r1/{state}/x", message(1, 2)), (f"f/v/r1/{verdict}/x", message(1))],
    }  # fmt: skip
    monkeypatch.setattr(
        episode, "read_messages", lambda file, _: iter([(key, 0, one) for key, one in files[file.name]])
    )
    found = episode.read_recorded([Path("a"), Path("b")], "r1")
    assert (found.messages, found.states, found.verdicts) == (7, {(1, 1), (1, 2), (2, 1)}, {(1, 1)})
    assert found.lost([(1, 1), (1, 3), (1, 3), (2, 2)], [(1, 1), (1, 2)]) == (2, 1)
    assert episode.read_recorded([], "r1").messages == 0


def test_a_robot_of_the_campaign_writes_its_own_trace_and_connects_through_the_proxy(tmp_path, monkeypatch) -> None:
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
