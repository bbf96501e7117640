"""The lease of a service: never two holders, whatever is late, lost or restarted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.waiting import until

from safedpa.bus.messages.requests import LeaseAnswer, LeaseRequest, Request
from safedpa.bus.service.lease import (
    LEASE_SECONDS,
    Lease,
    LeasedTransport,
    LeaseKeeper,
    LeaseTable,
    wait_for_lease,
)
from safedpa.bus.transport.memory import MemoryBroker, MemoryTransport
from safedpa.errors import InputError
from safedpa.runtime.stop_orders import StopOrders
from safedpa_services.router.router import DuplicateCertificates


class World:
    """A router's table and a clock that every question moves on."""

    def __init__(self) -> None:
        self.now = 0.0
        self.table = LeaseTable(clock=self.clock)
        self.there = self.back = 0.0
        self.lost = False

    def clock(self) -> float:
        return self.now

    def ask(self, request: LeaseRequest) -> LeaseAnswer | None:
        self.now += self.there
        answer = self.table.ask(request)
        self.now += self.back
        return None if self.lost else answer

    def lease(self, name: str) -> Lease:
        return Lease(self.ask, name, self.clock)


DELAYS = st.floats(0.0, 2.0)
ACTS = st.tuples(st.sampled_from(["a", "b", "wait", "release a", "router"]), DELAYS, DELAYS, st.booleans())


@given(acts=st.lists(ACTS, max_size=40))
def test_two_instances_never_hold_the_lease_at_once(acts: list[tuple[str, float, float, bool]]) -> None:
    world = World()
    leases = {name: world.lease(name) for name in "ab"}
    for what, world.there, world.back, world.lost in acts:
        if what == "wait":
            world.now += world.there
        elif what == "router":
            world.table = LeaseTable(clock=world.clock)
        elif what == "release a":
            leases["a"].release()
        else:
            leases[what].attempt()
        assert not (leases["a"].held and leases["b"].held)


def test_a_lease_ends_for_its_holder_before_the_router_grants_it_again() -> None:
    world = World()
    one, other = world.lease("one"), world.lease("other")
    world.now = LEASE_SECONDS
    assert one.attempt() is not None
    world.now += 0.8 * LEASE_SECONDS
    refused = other.attempt()
    assert (one.held, other.held) == (False, False)
    assert refused is not None
    assert refused.wait == pytest.approx(0.2 * LEASE_SECONDS)
    world.now += refused.wait
    other.attempt()
    assert (other.held, other.term) == (True, one.term + 1)


def test_what_the_holder_carried_on_comes_to_the_next_one_and_a_refused_one_changes_nothing() -> None:
    world = World()
    one, other = world.lease("one"), world.lease("other")
    world.now = LEASE_SECONDS
    one.attempt()
    one.attempt("stop r1")
    other.attempt("nonsense")
    one.release("stop r1, r2")
    assert wait_for_lease(other, lambda: False) == "stop r1, r2"
    assert wait_for_lease(world.lease("third"), lambda: True) is None


def test_nothing_is_sent_without_the_lease() -> None:
    world, inner = World(), MemoryTransport(MemoryBroker())
    heard: list[bytes] = []
    inner.subscribe("safedpa/f/r/action", lambda _key, payload: heard.append(payload))
    gate = LeasedTransport(inner)
    gate.put("safedpa/f/r/action", b"before", never_drop=True)
    gate.lease = world.lease("one")
    world.now = LEASE_SECONDS
    gate.lease.attempt()
    gate.put("safedpa/f/r/action", b"held", never_drop=True)
    world.now += LEASE_SECONDS
    gate.put("safedpa/f/r/action", b"after", never_drop=True)
    assert heard == [b"held"]


@pytest.mark.parametrize("why", ["the loop hangs", "the router does not answer"])
def test_a_holder_that_cannot_renew_ends(why: str) -> None:
    table, ended = LeaseTable(seconds=0.0), list[str]()
    answers = True

    def ask(request: LeaseRequest) -> LeaseAnswer | None:
        return table.ask(request) if answers else None

    lease = Lease(ask, "one")
    lease.attempt()
    keeper = LeaseKeeper(lease, lambda: "", lambda: ended.append(why))
    if why == "the router does not answer":
        answers = False
        until(lambda: keeper.progress() or ended, 5.0)
    assert until(lambda: ended, 5.0)
    assert not lease.held


def test_stop_orders_are_inherited_and_unreadable_ones_stop_the_fleet() -> None:
    before, after = StopOrders(), StopOrders()
    before.latch("r1", "it jumped")
    after.inherit(before.text())
    assert "it jumped" in after.reason("r1")
    assert not after.reason("r2")
    after.inherit("")
    assert not after.reason("r2")
    after.inherit("{")
    assert after.reason("r2")
    with pytest.raises(InputError, match="wanted stop, go, confirm or status"):
        after.answer("r1", Request(do="dance"))


@pytest.mark.parametrize(("standby", "cut"), [("safety_filter", {"third"}), ("", {"second", "third"})])
def test_with_a_standby_a_second_filter_stays_and_a_third_is_cut_off(standby: str, cut: set[str]) -> None:
    members, gone = [("first", "safety_filter"), ("p", "policy")], set[str]()
    certificates = DuplicateCertificates(lambda: members, lambda found: gone.update(found) or len(found), standby)
    for session in ("", "second", "third"):
        members += [(session, "safety_filter")] if session else []
        for _ in range(20):
            certificates.look()
    assert gone == cut
