"""The inputs of one robot's step: which are kept, which complete a tick, and which are stale."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as some
from tests.bus.fleet import EPOCH, StateAt, latent_of, stamp

from safedpa.bus import LATENT, NOMINAL, NominalMessage, Stale, StateMessage
from safedpa.bus.service.robot_slot import RobotSlot

ticks = some.integers(0, 8)
epochs = some.sampled_from([EPOCH, EPOCH - 1, EPOCH + 1])


def slot_at(state: StateMessage) -> RobotSlot:
    return RobotSlot(state, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def state_of(samples: dict[str, StateMessage]) -> StateAt:
    return lambda lockstep: dataclasses.replace(samples["state"], tick=5, epoch=EPOCH, lockstep=lockstep)


@given(heard=some.lists(some.tuples(ticks, epochs), max_size=6))
def test_the_newest_input_of_the_epoch_is_kept(heard: list[tuple[int, int]], state_of: StateAt) -> None:
    slot, newest = slot_at(state_of(lockstep=False)), -1
    for tick, epoch in heard:
        better = epoch == EPOCH and tick > newest
        assert slot.keep(LATENT, latent_of(tick, epoch)) is better
        newest = tick if better else newest
        assert (slot.inputs[LATENT].tick if LATENT in slot.inputs else -1) == newest


@given(tick=ticks, epoch=epochs, lockstep=some.booleans(), slack=some.integers(0, 3))
def test_an_input_completes_its_tick_or_in_real_time_one_within_the_slack(tick, epoch, lockstep, slack, state_of):
    """An input that completes no tick is given as stale, with its age; the topic itself allows a latent no age."""
    slot = slot_at(state_of(lockstep=lockstep))
    assert slot.is_complete((), {})
    assert not slot.is_complete((LATENT,), {LATENT: slack})
    assert slot.given((LATENT,), {LATENT: slack}) == {LATENT: Stale(LATENT, None)}
    slot.inputs[LATENT] = latent_of(tick, epoch)
    usable = epoch == EPOCH and tick in range(5 - (0 if lockstep else slack), 6)
    assert slot.is_complete((LATENT,), {LATENT: slack}) is usable
    age = max(5 - tick, 0) if epoch == EPOCH else None
    assert slot.given((LATENT,), {LATENT: slack})[LATENT] == (latent_of(tick) if usable else Stale(LATENT, age))


def test_an_input_of_a_former_epoch_is_replaced_whatever_its_tick(state_of: StateAt) -> None:
    slot = slot_at(state_of(lockstep=False))
    slot.inputs[LATENT] = latent_of(90, EPOCH - 1)
    assert slot.keep(LATENT, latent_of(1))
    assert slot.inputs[LATENT].tick == 1


def test_slack_is_for_the_topics_that_are_named(state_of: StateAt) -> None:
    slot = slot_at(state_of(lockstep=False))
    slot.keep(LATENT, latent_of(4))
    slot.keep(NOMINAL, NominalMessage(**stamp(4), values=(0.0, 0.0), controller="test"))
    assert not slot.is_complete((LATENT, NOMINAL), {LATENT: 1})
    slot.keep(NOMINAL, NominalMessage(**stamp(5), values=(0.0, 0.0), controller="test"))
    assert slot.is_complete((LATENT, NOMINAL), {LATENT: 1})
    assert not slot.is_complete((LATENT, NOMINAL), {})
