"""What the router reads out of Zenoh's log: lines as Zenoh 1.10.2 writes them."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa_services.router.refusals import Refusals
from safedpa_services.router.router import DuplicateCertificates

ACCESS = "2026-11-21T20:33:54.423019Z TRACE  rx-1 ThreadId({0}) zenoh::net::routing::interceptor::access_control: {1}"
END = "2026-11-21T20:33:54.423033Z TRACE  rx-1 ThreadId({0}) zenoh::net::routing::interceptor: Msg intercepted!"
ZID = "540552e740966635a3e3f4d721ba8194"
FRESH = f"{ZID} on Interface(lo)+CertCommonName(policy)+Transport(Tls)+{ZID} is {{}}authorized to {{}} on {{}}"
CACHED = f"Using cached result: {ZID} is {{}}authorized to {{}} on {{}}"


def decision(form: str, no: str, act: str, key: str = "safedpa/f/r1/action", thread: str = "10") -> str:
    return ACCESS.format(thread, form.format(no, act, key))


def events(capsys: pytest.CaptureFixture[str]) -> list[dict[str, object]]:
    return [json.loads(line) for line in capsys.readouterr().err.splitlines()]


def test_a_denial_is_reported_with_name_and_key(capsys: pytest.CaptureFixture[str]) -> None:
    refusals = Refusals()
    refusals.hear(decision(FRESH, "un", "Put (ingress)", "safedpa/f/denial-1/action"))
    assert refusals.total == 0, "a decision alone is none: many are made in advance"
    refusals.hear(END.format("10"))
    (event,) = events(capsys)
    assert event["kind"] == "bus.denied"
    assert event["sentence"] == "policy may not put under 'safedpa/f/denial-1/action'"
    assert (event["service"], event["robot"]) == ("policy", "denial-1")
    assert refusals.total == 1
    assert refusals.newest == event["sentence"]


def test_a_cached_denial_is_named_after_what_was_heard_before(capsys: pytest.CaptureFixture[str]) -> None:
    refusals = Refusals()
    refusals.name_of = lambda session: {"ab": "robot.r9"}.get(session, "")
    refusals.hear(decision(FRESH, "", "Put (egress)"))
    refusals.hear(decision(CACHED, "un", "Declare Subscriber (ingress)", "safedpa/f/denial-2/action"))
    refusals.hear(END.format("10"))
    refusals.hear(decision(CACHED.replace(ZID, "ab"), "un", "Delete (ingress)", "safedpa/f/denial-3/action"))
    refusals.hear(END.format("10"))
    assert [event["sentence"] for event in events(capsys)] == [
        "policy may not declare subscriber under 'safedpa/f/denial-2/action'",
        "robot.r9 may not delete under 'safedpa/f/denial-3/action'",
    ]


def test_threads_are_not_mixed_up(capsys: pytest.CaptureFixture[str]) -> None:
    refusals = Refusals()
    refusals.hear(decision(FRESH, "un", "Put (ingress)", "safedpa/f/denial-4/action", "10"))
    refusals.hear(decision(FRESH, "", "Put (ingress)", "safedpa/f/denial-5/action", "9"))
    refusals.hear(END.format("10"))
    (event,) = events(capsys)
    assert event["robot"] == "denial-4"


def test_what_is_withheld_on_the_way_out_is_no_attempt() -> None:
    refusals = Refusals()
    refusals.hear(decision(FRESH, "un", "Declare Subscriber (egress)"))
    refusals.hear(END.format("10"))
    assert refusals.total == 0


@pytest.mark.parametrize(
    ("allowed", "act", "kind"),
    [
        ("", "Put", "bus.too_large"),
        ("un", "Put", "bus.denied"),
        ("", "Delete", "bus.denied"),
        ("un", "Query", "bus.denied"),
    ],
)
def test_only_a_put_that_was_allowed_and_goes_no_further_was_too_large(allowed, act, kind, capsys):
    refusals = Refusals()
    refusals.hear(decision(FRESH, allowed, f"{act} (ingress)"))
    refusals.hear(END.format("10"))
    assert [(event["kind"], event["robot"]) for event in events(capsys)] == [(kind, "r1")]
    assert refusals.counts == {kind: 1}


ACCEPTED = "Accepted TLS connection on [::]:7447: 10.0.0.2:5. Common Name: policy."


@pytest.mark.parametrize(
    ("target", "level", "text", "kinds"),
    [
        ("zenoh_link_tls::unicast", "DEBUG", ACCEPTED, ["bus.joined"]),
        ("zenoh_link_tls::unicast", "WARN", "no certificate", ["bus.handshake_refused"]),
        ("zenoh_transport::unicast::establishment::accept", "ERROR", "closed", ["bus.handshake_refused"]),
        ("zenoh_transport::unicast::establishment::accept", "DEBUG", "Decode error", ["bus.handshake_refused"]),
        ("zenoh_transport::unicast::establishment::accept", "DEBUG", "hello", []),
        ("zenoh_transport::unicast::establishment::open", "WARN", "closed", ["bus.zenoh"]),
        ("zenoh::net::runtime", "WARN", "closed", ["bus.zenoh"]),
        ("zenoh::net::runtime", "DEBUG", "closed", []),
    ],
)
def test_a_handshake_that_failed_is_a_refusal_and_other_warnings_are_handed_on(target, level, text, kinds, capsys):
    refusals = Refusals()
    refusals.hear(f"2026-11-21T20:33:49.171284Z {level} acc-0 ThreadId(05) {target}: {text}")
    assert [event["kind"] for event in events(capsys)] == kinds
    assert refusals.total == (1 if kinds == ["bus.handshake_refused"] else 0)


def test_a_refusal_whose_reason_was_lost_is_counted_all_the_same() -> None:
    refusals = Refusals()
    refusals.hear(END.format("10"))
    assert refusals.counts == {"bus.held_back": 1}


def test_handshakes(capsys: pytest.CaptureFixture[str]) -> None:
    refusals = Refusals()
    head = "2026-11-21T20:33:49.171284Z {} acc-0 ThreadId(05) zenoh_link_tls::unicast: {}"
    joined = "Accepted TLS connection on 127.0.0.1:17448: 127.0.0.1:52214. Common Name: denial-7."
    refusals.hear(head.format("DEBUG", joined))
    assert refusals.total == 0
    refusals.hear(head.format(" WARN", "peer sent no certificates. Hint: increase the system open file limit."))
    reported = events(capsys)
    assert reported[0]["sentence"] == "denial-7 connects from 127.0.0.1:52214"
    assert [event["kind"] for event in reported] == ["bus.joined", "bus.handshake_refused"]
    assert reported[1]["sentence"] == "a connection was refused: peer sent no certificates"


@given(st.lists(st.one_of(st.text(), st.just(END.format("1")), st.just(decision(FRESH, "un", "Put (ingress)")))))
def test_no_line_breaks_it_and_no_refusal_is_missed(lines: list[str]) -> None:
    refusals = Refusals()
    for line in lines:
        refusals.hear(line)
    assert refusals.total == sum(line == END.format("1") for line in lines)


class Members:
    """Sessions and the names that they show, looked at for copies; ``cut`` has those that were cut off."""

    def __init__(self) -> None:
        self.there, self.cut = list[tuple[str, str]](), list[set[str]]()
        self.twins = DuplicateCertificates(lambda: self.there, self.cut_off)

    def cut_off(self, sessions: set[str]) -> int:
        self.cut.append(sessions)
        return len(sessions)

    def looked_at(self, times: int, *there: tuple[str, str]) -> list[str]:
        """What the last look finds, while they are there."""
        self.there = list(there)
        return [self.twins.look() for _ in range(times)][-1]


A, B, COPY = ("a", "policy"), ("b", "policy"), ("copy", "policy")


def test_a_certificate_shown_by_two_processes_is_reported_once_that_lasts(capsys: pytest.CaptureFixture[str]) -> None:
    members, others = Members(), (A, ("b", "robot.r1"))
    assert not members.looked_at(9, *others)
    assert not members.looked_at(3, *others, ("c", "robot.r1")), "a process that was just restarted"
    assert members.cut == []
    assert members.twins.look() == ["robot.r1"]
    assert members.cut == [{"c"}], "the one that was there first stays"
    (event,) = events(capsys)
    assert (event["kind"], event["service"]) == ("bus.duplicate_certificate", "robot.r1")
    assert members.looked_at(1, *others) == []


@pytest.mark.parametrize(
    "story",
    [
        [(5, [A, B])],
        [(1, []), (1, [A]), (6, [A, B])],
        [(10, [A, B]), (1, []), (1, [A]), (1, [A, B]), (4, [A, B])],
    ],
    ids=["the router begins again", "they come while it begins", "it hung for a while"],
)
def test_of_two_of_which_no_one_knows_who_is_the_copy_neither_is_cut_off(story: list[tuple[int, list[Any]]]) -> None:
    """Both knock again and again while there is no router; which of them is heard first says nothing."""
    members = Members()
    assert [members.looked_at(times, *there) for times, there in story][-1] == ["policy"]
    assert members.cut == []


def test_a_session_whose_link_was_lost_is_no_newcomer() -> None:
    """A router that hung loses all links at once; they come back in any order, and the copy may be faster."""
    members = Members()
    members.looked_at(10, A)
    members.looked_at(1, COPY)
    assert members.looked_at(4, COPY, A) == ["policy"]
    assert members.cut == [{"copy"}]


@pytest.mark.parametrize(("others", "cut"), [(10, "a"), (5000, "old")])
def test_of_sessions_that_come_and_go_the_oldest_are_forgotten_and_those_present_are_not(others: int, cut: str) -> None:
    """Names may come from an attacker; of 4096 sessions it is remembered when they came first."""
    members, old = Members(), ("old", "policy")
    members.looked_at(10, old)
    for number in range(others):
        members.looked_at(1, A, (f"s{number}", "recorder"))
    assert members.looked_at(4, A, old) == ["policy"]
    assert members.cut == [{cut}]


@pytest.mark.parametrize("name", ["operator", "healthcheck", "router", "", "stranger"])
def test_people_and_checks_may_come_in_any_number(name: str) -> None:
    twins = DuplicateCertificates(lambda: [("a", name), ("b", name), ("b", name)])
    assert not any(twins.look() for _ in range(3))


def test_two_links_of_one_session_are_one_process() -> None:
    twins = DuplicateCertificates(lambda: [("a", "policy"), ("a", "policy")])
    assert not any(twins.look() for _ in range(3))
