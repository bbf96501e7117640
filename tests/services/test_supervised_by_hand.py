"""What the supervisor does turn after turn and at the end, with processes that only note what is done to them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.supervisor import child as child_module
from safedpa_services.supervisor import supervisor as module
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.supervisor import Supervisor


class Noting:
    """A child that lives from its start to its end; what is done to it goes into ``done``."""

    def __init__(self, name: str, done: list[Any], *, essential: bool = True, begun: bool = True) -> None:
        self.name, self.done, self.essential, self.begun = name, done, essential, begun
        self.pid, self.restarts, self.waits = 7, 0, False
        self.exit_code: int | None = None

    def kill(self) -> None:
        self.done.append((self.name, "killed"))

    def terminate(self) -> None:
        self.done.append((self.name, "asked"))

    def end(self, patience: float) -> None:
        self.done.append((self.name, patience))

    def begin(self) -> None:
        self.begun = True


class Hearing:
    """A watch with a clock that goes on while it listens; ``stands_at`` [s]: from when on its robot stands."""

    def __init__(self, clock: list[float], hung: dict[str, float], stands_at: float, *, takes: bool = True) -> None:
        self.clock, self.hung, self.stands_at, self.takes = clock, hung, stands_at, takes
        self.health: dict[str, object] = {}

    def listen(self, wait: float) -> None:
        self.clock[0] += wait

    def has_hung(self, service: str, pid: int, seconds: float) -> bool:
        assert pid == 7
        return self.hung.get(service, 0.0) > seconds

    def stop_robot(self) -> bool:
        return self.takes

    def stands(self) -> bool:
        return self.clock[0] >= self.stands_at


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    return now


@pytest.mark.parametrize(
    ("essential", "silent", "killed"),
    [(True, 11.0, True), (True, 9.0, False), (False, 11.0, False), (True, 0.0, False)],
)
def test_what_the_loop_needs_is_killed_after_ten_seconds_of_silence(
    essential: bool, silent: float, killed: bool, clock: list[float]
) -> None:
    done: list[Any] = []
    service = Noting("policy", done, essential=essential)
    watch: Any = Hearing(clock, {"policy": silent}, 0.0)
    Supervisor([service], None, watch, lambda: True, lambda: None)._turn()  # type: ignore[list-item]
    assert done == ([("policy", "killed")] if killed else [])


@pytest.mark.parametrize(
    ("stands_at", "takes", "hurried", "braked_for"),
    [(0.0, True, False, 0.05), (2.0, True, False, 2.0), (99.0, True, False, 5.0), (99.0, False, False, 0.0),
     (99.0, True, True, 0.0)],
)  # fmt: skip
def test_at_the_end_a_robot_has_five_seconds_to_stand_and_every_process_its_time(
    stands_at: float, takes: bool, hurried: bool, braked_for: float, clock: list[float]
) -> None:
    """The robot first, then services, recorder and router last; who is in a hurry waits for nobody."""
    done: list[Any] = []
    robot, *services = (Noting(name, done) for name in ("robot", "router", "recorder", "policy"))
    watch: Any = Hearing(clock, {}, stands_at, takes=takes)
    turned: list[float] = []
    supervisor = Supervisor(
        services, robot, watch, lambda: True, lambda: turned.append(clock[0]), lambda: hurried  # type: ignore[arg-type]
    )  # fmt: skip
    supervisor._end()
    assert max(turned, default=0.0) == pytest.approx(braked_for, abs=0.051)
    robots, others = (0.0, 0.0) if hurried else (8.0, 6.0)
    assert done == [
        ("robot", "asked"), ("robot", robots), ("policy", "asked"), ("policy", others), ("policy", others),
        ("recorder", others), ("router", others),
    ]  # fmt: skip


def test_a_robot_that_never_drove_or_ended_is_not_waited_for(clock: list[float]) -> None:
    for robot in (Noting("robot", [], begun=False), Noting("robot", [])):
        robot.exit_code = 0 if robot.begun else None
        watch: Any = Hearing(clock, {}, 99.0)
        Supervisor([], robot, watch, lambda: True, lambda: None)._brake()  # type: ignore[arg-type]
    assert clock == [0.0]


@pytest.mark.parametrize(("ends_at", "waited"), [(0.0, 0.0), (2.0, 2.0), (99.0, 5.0)])
def test_the_other_robots_have_five_seconds_after_the_first_ones_end(
    ends_at: float, waited: float, clock: list[float]
) -> None:
    class Driving(Noting):
        exit_code = property(lambda _self: 0 if clock[0] >= ends_at else None, lambda _self, _value: None)  # type: ignore[assignment]

    first, other = Noting("robot", []), Driving("robot 2", [])
    first.exit_code = 0
    watch: Any = Hearing(clock, {}, 0.0)
    supervisor = Supervisor([], first, watch, lambda: False, lambda: None, others=[(other, watch)])  # type: ignore[arg-type, list-item]
    assert supervisor._attend() == 0
    assert clock[0] == pytest.approx(waited + 0.05, abs=0.06)


def test_who_dies_quickly_again_and_again_is_started_after_longer_and_longer_pauses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tenth of a second, then twice as long each time, five seconds at most; ten seconds of life end that."""
    now, lives = [100.0], [0.0] * 9 + [9.0, 11.0, 0.0]

    class Dying(Child):
        def start(self) -> None:
            self._started, self._died = now[0], 0.0

    monkeypatch.setattr(child_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    dying, pauses = Dying("policy", "none", (), tmp_path / "log"), list[float]()
    dying.start()
    for life in lives:
        now[0] += life
        died = now[0]
        while not dying.restart_if_due():
            now[0] += 0.01
        pauses.append(now[0] - died)
    assert pauses == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0, 5.0, 0.0, 0.1], abs=0.02)
    assert dying.restarts == len(lives)
