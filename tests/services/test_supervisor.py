"""How the supervisor starts, monitors and ends the processes of a loop; processes and clock are simulated."""

from dataclasses import dataclass, field
from math import inf
from typing import Any

import pytest

from safedpa.errors import InputError, SafedpaError
from safedpa_services.supervisor.supervisor import Supervisor

BAD_INPUT, FAILED, KILLED = 2, 1, -9


@dataclass
class Process:
    """A child that ends at ``ends_at`` with ``code``; ``done``, shared by all, lists what happened to it."""

    clock: Any
    done: list[tuple[str, Any]]
    name: str
    essential: bool = True
    waits: bool = False
    awaited: bool = False
    has_begun: bool = False
    restarts: int = 0
    cause: str = ""
    given_up: bool = False
    ends_at: float = inf
    code: int = 0
    pid: int = 0
    begun_at: float | None = None
    ended_at: float | None = None

    @property
    def exit_code(self):
        return self.code if self.pid and self.clock.now >= self.ends_at else None

    def start(self):
        self.pid = 7
        self.done.append((self.name, "started"))

    def begin(self):
        self.pid, self.has_begun, self.begun_at = 7, True, self.clock.now

    def restart_if_due(self):
        self.done.append((self.name, "restarted"))
        self.restarts += 1
        self.ends_at = inf
        return True

    def last_text(self):
        return f"{self.name} says why"

    def kill(self, because=""):
        self.done.append((self.name, "killed"))
        self.ends_at, self.code = self.clock.now, KILLED

    def terminate(self):
        self.done.append((self.name, "asked"))

    def end(self, patience):
        self.done.append((self.name, patience))
        self.ended_at = self.clock.now


@dataclass
class Watch:
    """A monitor with given times of heartbeats and stops; the clock advances while it listens."""

    clock: Any
    heard_at: dict[str, float] = field(default_factory=dict)
    silent: dict[str, float] = field(default_factory=dict)
    is_stationary_at: float = 0.0
    takes_orders: bool = True
    orders: list[float] = field(default_factory=list)
    listened_at: list[float] = field(default_factory=list)

    @property
    def health(self):
        return {name: object() for name, at in self.heard_at.items() if self.clock.now >= at}

    def listen(self, wait):
        self.clock.now += wait
        self.listened_at.append(self.clock.now)

    def has_hung(self, service, pid, seconds):
        return pid == 7 and self.silent.get(service, 0.0) > seconds

    def stop_robot(self):
        self.orders.append(self.clock.now)
        return self.takes_orders

    def has_obeyed_stop(self):
        return self.clock.now >= self.is_stationary_at


@dataclass
class Loop:
    """A supervisor of simulated processes, stopped and hurried at given times."""

    clock: Any
    stopped_at: float = 1.0
    hurried_at: float = inf
    robot: Process | None = None
    services: list[Process] = field(default_factory=list)
    others: list[Process] = field(default_factory=list)
    done: list[tuple[str, Any]] = field(default_factory=list)
    turned: list[float] = field(default_factory=list)

    def __post_init__(self):
        self.watch, self.other_watch = Watch(self.clock), Watch(self.clock)

    def add(self, name, *, heard_at=0.0, **fields):
        """A robot or a service, by its name."""
        made = Process(self.clock, self.done, name, **fields)
        if name == "robot":
            self.robot = made
        elif name.startswith("robot"):
            self.others.append(made)
        else:
            self.services.append(made)
        self.watch.heard_at[name] = heard_at
        return made

    def run(self):
        at = self.clock
        return Supervisor(
            self.services, self.robot, self.watch, lambda: at.now >= self.stopped_at,
            lambda: self.turned.append(at.now), lambda: at.now >= self.hurried_at,
            [(other, self.other_watch) for other in self.others],
        ).run()  # fmt: skip

    def happened(self, what):
        return [name for name, happened in self.done if happened == what]


@pytest.fixture
def loop(clock):
    return lambda **fields: Loop(clock, **fields)


# starting


@pytest.mark.parametrize(
    ("essential", "restarts", "longest"), [(True, 0, 120.0), (True, 1, 30.0), (True, 2, 30.0), (False, 0, None)]
)
def test_a_start_is_given_up_when_an_essential_service_stays_silent(loop, essential, restarts, longest):
    """A starting service has two minutes, one that died meanwhile half a minute."""
    made = loop(stopped_at=500.0)
    made.add("robot", ends_at=200.0)
    made.add("policy", heard_at=inf, essential=essential, restarts=restarts)
    if longest is None:
        assert made.run() == 0
        assert made.robot.begun_at == 0.0, "the robot does not wait for it"
        return
    with pytest.raises(SafedpaError, match=rf"^policy: not ready after {longest:.0f} s: policy says why$"):
        made.run()
    assert max(made.turned) == pytest.approx(longest, abs=0.11)
    assert made.robot.begun_at is None
    assert ("policy", "asked") in made.done, "what was started is ended"


def test_robots_begin_once_an_awaited_service_is_heard_although_it_is_not_essential(loop):
    made = loop(stopped_at=9.0)
    made.add("robot", waits=True)
    made.add("policy", heard_at=1.0)
    made.add("diagnosis", heard_at=4.0, essential=False, awaited=True)
    assert made.run() == 0
    assert made.robot.begun_at == pytest.approx(4.0, abs=0.06)


@pytest.mark.parametrize("waits", [True, False])
def test_all_robots_begin_once_every_essential_service_is_heard(loop, waits):
    """Robots that can wait are started with the services, to prepare meanwhile."""
    made = loop(stopped_at=3.0)
    robots = [made.add("robot", waits=waits), made.add("robot 2", waits=waits)]
    made.add("policy", heard_at=1.0)
    made.add("safety_filter", heard_at=2.0)
    made.add("dashboard", heard_at=inf, essential=False)
    assert made.run() == 0
    assert [robot.begun_at for robot in robots] == pytest.approx([2.0, 2.0], abs=0.06)
    early = ["robot", "robot 2"] if waits else []
    assert made.happened("started") == [*early, "policy", "safety_filter", "dashboard"]


@pytest.mark.parametrize("stopped_at", [0.0, 1.0, 30.0])
def test_a_stop_while_services_start_ends_the_start_and_no_robot_begins(loop, stopped_at):
    made = loop(stopped_at=stopped_at)
    made.add("robot", waits=True)
    made.add("policy", heard_at=inf)
    assert made.run() == 0
    assert made.clock.now == pytest.approx(stopped_at, abs=0.26)
    assert made.robot.begun_at is None
    assert made.happened("asked") == ["robot", "policy"]
    assert made.watch.orders == [], "a robot that does not drive needs no order to stop"


def test_a_service_that_runs_already_is_not_started_twice(loop):
    made = loop()
    router = made.add("router", pid=7)
    router.start = lambda: pytest.fail("started twice")
    assert made.run() == 0


# while it drives


@pytest.mark.parametrize(
    ("code", "drives", "essential", "outcome"),
    [
        (FAILED, False, True, "restarted"),
        (FAILED, True, False, "restarted"),
        (KILLED, True, True, "restarted"),
        (0, True, True, "restarted"),
        (BAD_INPUT, True, True, "restarted"),
        (BAD_INPUT, True, False, "restarted"),
        (BAD_INPUT, False, True, "the start fails"),
        (BAD_INPUT, False, False, "left out"),
    ],
)
@pytest.mark.parametrize("second", [False, True])
def test_a_dead_service_is_restarted_unless_it_refused_its_input_before_any_robot_drove(
    loop, code, drives, essential, outcome, second
):
    """It does not matter which of several robots drives."""
    made = loop(stopped_at=2.0)
    made.add("robot", has_begun=drives and not second, waits=True, heard_at=inf)
    made.add("robot 2", has_begun=drives and second, waits=True)
    made.add("policy", heard_at=1.0, essential=essential, ends_at=0.0, code=code)
    made.add("adaptation", heard_at=1.0)
    if outcome == "the start fails":
        with pytest.raises(InputError, match="policy says why"):
            made.run()
    elif outcome == "left out" and not drives:
        made.stopped_at = 0.5
        assert made.run() == 0
    else:
        assert made.run() == 0
    assert made.happened("restarted") == (["policy"] if outcome == "restarted" else [])


@pytest.mark.parametrize(
    ("code", "ever_heard", "outcome"),
    [
        (0, True, 0),
        (FAILED, True, FAILED),
        (KILLED, True, "restarted"),
        (BAD_INPUT, True, "restarted"),
        (BAD_INPUT, False, "fails"),
        (KILLED, False, "restarted"),
    ],
)
def test_the_end_of_the_robot_ends_the_loop_and_its_death_restarts_it(loop, code, ever_heard, outcome):
    made = loop(stopped_at=5.0)
    made.add("robot", ends_at=1.0, code=code, heard_at=0.5 if ever_heard else inf)
    if outcome == "fails":
        with pytest.raises(InputError, match="robot says why"):
            made.run()
    elif outcome == "restarted":
        assert made.run() == 0
        assert made.happened("restarted") == ["robot"]
        assert max(made.turned) > 4.9, "the loop goes on"
    else:
        assert made.run() == outcome
        assert max(made.turned) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(
    ("name", "essential", "silent", "killed"),
    [
        ("policy", True, 11.0, True),
        ("policy", True, 9.0, False),
        ("policy", False, 11.0, False),
        ("policy", True, 0.0, False),
        ("dashboard", True, 59.0, False),
        ("dashboard", True, 61.0, True),
    ],
)
def test_an_essential_service_is_restarted_after_ten_seconds_of_silence_and_the_dashboard_after_a_minute(
    loop, name, essential, silent, killed
):
    made = loop()
    made.add(name, essential=essential)
    made.watch.silent[name] = silent
    made.run()
    assert bool(made.happened("killed")) is killed
    assert bool(made.happened("restarted")) is killed


def test_a_supervisor_that_was_stopped_itself_kills_no_service_for_the_heartbeats_it_did_not_read(loop):
    made = loop(stopped_at=30.0)
    made.add("policy")
    listen = made.watch.listen

    def listened(wait):
        if 1.0 < made.clock.now < 2.0:
            made.clock.now += 12.0  # stopped meanwhile
            made.watch.silent["policy"] = 12.0
        elif made.clock.now > 15.0:
            made.watch.silent["policy"] = 0.1
        listen(wait)

    made.watch.listen = listened
    made.run()
    assert made.happened("killed") == []


@pytest.mark.parametrize(
    ("other_ends_at", "stopped_at", "waited"),
    [(0.0, inf, 0.0), (3.0, inf, 2.0), (inf, inf, 5.0), (inf, 2.0, 1.0), (inf, 1.0, 0.0)],
)
def test_other_robots_have_five_seconds_after_the_first_ones_end(loop, other_ends_at, stopped_at, waited):
    made = loop(stopped_at=stopped_at)
    made.add("robot", ends_at=1.0)
    made.add("robot 2", ends_at=other_ends_at)
    made.watch.takes_orders = False
    assert made.run() == 0
    assert max(made.turned) - 1.0 == pytest.approx(waited, abs=0.11)


# ending


@pytest.mark.parametrize(
    ("is_stationary_at", "takes_orders", "hurried_at", "robot_ends_at", "braked_for"),
    [
        (0.0, True, inf, inf, 0.05),
        (3.0, True, inf, inf, 2.0),
        (inf, True, inf, inf, 5.0),
        (inf, False, inf, inf, 0.0),
        (inf, True, 0.0, inf, 0.0),
        (inf, True, 2.0, inf, 1.0),
        (inf, True, inf, 3.0, 2.0),
    ],
)
def test_a_stopped_robot_brakes_first_and_the_recorder_ends_after_the_services(
    loop, is_stationary_at, takes_orders, hurried_at, robot_ends_at, braked_for
):
    """Five seconds for braking, eight for the robot's process, six for a service; no time after a second signal."""
    made = loop(stopped_at=1.0, hurried_at=hurried_at)
    made.add("router")
    made.add("recorder")
    made.add("policy")
    made.add("robot", ends_at=robot_ends_at)
    made.watch.is_stationary_at, made.watch.takes_orders = is_stationary_at, takes_orders
    assert made.run() == 0
    assert max(made.turned) - 1.0 == pytest.approx(braked_for, abs=0.06)
    assert len(made.watch.orders) == (hurried_at > 1.0)
    robot, others = (0.0, 0.0) if hurried_at < inf else (8.0, 6.0)
    assert [event for event in made.done if event[1] != "started"] == [
        ("robot", "asked"), ("robot", robot), ("policy", "asked"), ("policy", others),
        ("policy", others), ("recorder", others), ("router", others),
    ]  # fmt: skip
    assert made.watch.listened_at[-1] > made.services[0].ended_at, "what the recorder reports last is heard"


def test_every_robot_is_listened_to_and_brakes_until_it_stands(loop):
    made = loop(stopped_at=1.0)
    made.add("robot")
    made.add("robot 2")
    made.other_watch.is_stationary_at = 3.0
    assert made.run() == 0
    assert len(made.watch.orders) == len(made.other_watch.orders) == 1
    assert max(made.turned) == pytest.approx(3.0, abs=0.06)
    heard = [at for at in made.other_watch.listened_at if at < 1.0]
    assert len(heard) == pytest.approx(20, abs=2), "as often as the first one"


def test_a_robot_that_has_ended_gets_no_order_to_stop(loop):
    made = loop(stopped_at=9.0)
    made.add("robot", ends_at=1.0)
    made.watch.is_stationary_at = inf
    assert made.run() == 0
    assert made.watch.orders == []
    assert max(made.turned) < 1.1


def test_everything_is_ended_when_a_turn_fails(loop):
    made = loop()
    made.add("policy")

    def fails(_):
        raise KeyError("a defect of the view")

    made.turned = type("Turns", (), {"append": staticmethod(fails)})()
    with pytest.raises(KeyError):
        made.run()
    assert ("policy", 6.0) in made.done
