"""Intruders: none of them moves a robot, and each attempt is logged."""

import json
import time
from collections.abc import Callable
from typing import Any

import pytest
from fleet_containers import Fleet, Watch, run

pytestmark = pytest.mark.fleet

VICTIM = "robot-1"
LOG_SECONDS = 60.0

Reported = dict[str, Any]


class Attempt:
    """What an intruder does, what the robots do meanwhile, and what the logs say of it."""

    def __init__(self, fleet: Fleet, watch: Watch) -> None:
        self.fleet, self.watch = fleet, watch
        self.began = time.time()
        assert watch.until(lambda reported: VICTIM in reported["robots"], 60.0) is not None, (
            "the victim was never heard"
        )
        self.before = watch.now()

    def make(self, key: str, *phrase: str, given: str = "", network: str = "bus") -> dict[str, Any]:
        """Runs the intruder with the key of one role; it knows the victim's epoch and tick.

        One whose session could not be opened on a busy machine, though it may, tries again.
        """
        for _ in range(3):
            did = self._make(key, *phrase, given=given, network=network)
            if "error" not in did or phrase[0] == "enrol":
                break
        return did

    def _make(self, key: str, *phrase: str, given: str, network: str) -> dict[str, Any]:
        robot = self.watch.now()["robots"][VICTIM]
        stamp = ("--robot", VICTIM, "--epoch", str(robot["epoch"]), "--tick", str(robot["tick"]))
        command = self.fleet.guest("fleet_intruder.py", key, *phrase, *stamp)
        command[command.index("--network") + 1] = self.fleet.network(network)
        done = run(*command, timeout=60.0, given=given)
        did: dict[str, Any] = json.loads(done.stdout)
        return did

    def moved_no_one(self) -> str:
        """Every action that a robot applied was its filter's; no robot collided; the victim is driven on."""
        victim = self.before["robots"][VICTIM]["checked"]
        after = self.watch.until(lambda reported: reported["robots"][VICTIM]["checked"] > victim + 40, 90.0)
        assert after is not None, "the victim is not driven any more"
        for name, robot in after["robots"].items():
            assert robot["foreign"] == self.before["robots"][name]["foreign"] == 0, f"{name} was moved by a stranger"
            assert robot["collisions"] == 0, name
            assert robot["starts"] == self.before["robots"][name]["starts"], f"{name} was restarted"
        return "moved no one"

    def logged(
        self, service: str, kind: str, fits: Callable[[Reported], bool] = lambda event: True, other_kind: str = ""
    ) -> str:
        """The sentence of the event; waits a little for it. Fails where there is none."""
        events: list[Reported] = []
        end = time.monotonic() + LOG_SECONDS
        while time.monotonic() < end:
            events = self.fleet.events(service, self.began)
            found = [event for event in events if event["kind"] in (kind, other_kind) and fits(event)]
            if found:
                return f"{service}: {found[-1]['sentence']}"
            self.watch.now()
        raise AssertionError(f"{service} logged no {kind}: {events}")


@pytest.fixture
def attempt(fleet: Fleet, watch: Watch) -> Attempt:
    return Attempt(fleet, watch)


@pytest.fixture(scope="module")
def captured(fleet: Fleet, watch: Watch) -> str:
    """Three seconds of real actions, states and verdicts."""
    heard = Attempt(fleet, watch).make("recorder-key", "capture", "--role", "recorder")
    keys = {key for key, _ in heard["heard"]}
    assert f"safedpa/fleet/{VICTIM}/action" in keys
    return json.dumps(heard)


@pytest.mark.parametrize("how", ["bare", "plain", "foreign"])
def test_without_a_certificate_of_the_fleet_a_client_is_refused(how, attempt, rows):
    did = attempt.make("healthcheck-key", "enter", "--how", how)
    assert did["opened"] is False, did
    names = {"bare": "without certificate", "plain": "in plain text", "foreign": "certificate of a foreign authority"}
    rows.append((names[how], attempt.moved_no_one(), attempt.logged("router", "bus.handshake_refused")))


@pytest.mark.parametrize(
    ("role", "topic"), [("policy", "action"), ("policy", "model"), ("dashboard", "action"), ("recorder", "state")]
)
def test_a_certificate_of_the_wrong_role_commands_nothing(role, topic, attempt, rows):
    did = attempt.make(f"{role}-key", "act", "--role", role, "--topic", topic)
    assert did["sent"] > 20, did
    moved = attempt.moved_no_one()
    reported = attempt.logged(
        "router", "bus.denied", lambda event: event.get("service") == role and topic in event["key"]
    )
    rows.append((f"{topic} with the certificate of {role}", moved, reported))


def test_a_client_that_may_listen_cannot_replay_a_capture(attempt: Attempt, captured: str, rows: list[tuple[str, ...]]):
    did = attempt.make("recorder-key", "replay", "--role", "recorder", given=captured)
    assert did["sent"] > 100, did
    # Next to the real recorder it may be cut off as a second one before a message of it has arrived.
    reported = attempt.logged(
        "router", "bus.denied", lambda event: event.get("service") == "recorder", "bus.duplicate_certificate"
    )
    rows.append(("replayed capture, certificate of recorder", attempt.moved_no_one(), reported))


def test_a_replayed_capture_moves_no_robot_even_with_the_key_of_the_filter(attempt, captured, rows):
    did = attempt.make("safety-filter-key", "replay", "--role", "safety_filter", given=captured)
    assert did["sent"] > 100, did
    reported = attempt.logged(VICTIM, "message.refused")
    rows.append(("replayed capture, stolen key of the filter", attempt.moved_no_one(), reported))


def test_payloads_that_are_too_large_stop_at_the_router(attempt: Attempt, rows: list[tuple[str, ...]]) -> None:
    did = attempt.make("safety-filter-key", "large", "--role", "safety_filter")
    assert did["sent"] == 5, did
    reported = attempt.logged("router", "bus.too_large", lambda event: event["robot"] == VICTIM)
    rows.append(("a million bytes, stolen key of the filter", attempt.moved_no_one(), reported))


def test_malformed_payloads_are_refused_by_the_robot(attempt: Attempt, rows: list[tuple[str, ...]]) -> None:
    did = attempt.make("safety-filter-key", "malformed", "--role", "safety_filter")
    assert did["sent"] > 5, did
    reported = attempt.logged(VICTIM, "message.refused")
    rows.append(("malformed payloads, stolen key of the filter", attempt.moved_no_one(), reported))


def test_malformed_states_are_refused_by_the_services(attempt: Attempt, rows: list[tuple[str, ...]]) -> None:
    """There is no robot's key to steal outside of it; the diagnosis holds one that may put findings and models."""
    did = attempt.make("diagnosis-key", "malformed", "--role", "diagnosis", "--topic", "model")
    assert did["sent"] > 5, did
    reported = attempt.logged("safety_filter", "message.refused")
    rows.append(("malformed models, stolen key of the diagnosis", attempt.moved_no_one(), reported))


def test_the_authority_signs_nothing_for_a_container_that_is_no_robot(attempt: Attempt, rows: list[tuple[str, ...]]):
    did = attempt.make("", "enrol", network="enrolment")
    assert not did.get("got"), did
    reported = attempt.logged("authority", "authority.refused")
    rows.append(("request for a robot's certificate", attempt.moved_no_one(), reported))


def test_a_stranger_with_the_key_and_the_tick_would_be_seen(attempt: Attempt, rows: list[tuple[str, ...]]) -> None:
    """The counterpart: with the filter's key a client is the filter, so the check that no robot moved can fail."""
    attempt.make("safety-filter-key", "act", "--role", "safety_filter", "--how", "brake")
    seen = attempt.watch.until(lambda reported: reported["robots"][VICTIM]["foreign"] > 0, 10.0)
    assert seen is not None
    rows.append(("action with the stolen key of the filter", "MOVES the robot, as it must: the check can fail"))
