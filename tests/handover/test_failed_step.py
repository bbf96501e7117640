"""What a session of the filter knows of its robot outlives a failed step: the next session decides as it would have."""

import math
import re
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from tests.safety.node_steps import CAR, SETTINGS, asked, latent_at, state_at

from safedpa.bus import StateMessage, VerdictMessage
from safedpa.runtime.node import SafetyFilterNode

TICKS, BEGIN = 60, 20
NEAR = ((3.0, 0.6, 0.3),)


def commands(seed: int) -> list[tuple[float, float]]:
    draw = np.random.default_rng(seed)
    return [
        (float(v), float(w)) for v, w in np.repeat(draw.uniform((0.3, -0.2), (0.9, 0.2), (TICKS // 4, 2)), 4, axis=0)
    ]


def measured(kind: str, seed: int) -> list[StateMessage]:
    """The states of a car that drives as its model, whose state or clock is wrong from ``BEGIN`` on."""
    sent, late = commands(seed), 4 if kind == "late" else 0
    state, rows = np.array([0.0, 0.0, 0.0, 0.5]), list[StateMessage]()
    memory = CAR.initial_memory(np.array(sent[0]))
    for tick in range(TICKS):
        values = tuple(state.tolist())
        shown = {
            "jump": (values[0], values[1] + 1.0, *values[2:]),
            "frozen": rows[BEGIN].values if tick > BEGIN else values,
            "lost": (math.nan,) * 4,
            "lost for a while": (math.nan,) * 4 if tick < BEGIN + 15 else values,
        }.get(kind, values)
        applied = sent[max(0, tick - 1)]
        # A clock at a third of its rate: the stamps advance by less than the arrivals.
        arrived = 0.05 * tick + (0.1 * max(0, tick - BEGIN) if kind == "slow clock" else 0.0)
        timed = {"lockstep": kind != "slow clock", "publish_time": arrived, "obstacles": NEAR}
        rows.append(state_at(tick, shown if tick >= BEGIN else values, applied=applied, **timed))
        acting = sent[max(0, tick - late)]
        state, memory = CAR.advance(state, np.array(acting), memory, CAR.latent)
    return rows


def verdicts(states: Sequence[StateMessage], seed: int, failed: int = -1) -> list[VerdictMessage]:
    """The answers to all states, of which the step ``failed`` fails; -1: none does."""
    node, found, sent = SafetyFilterNode(CAR, SETTINGS), list[VerdictMessage](), commands(seed)
    for state in states:
        if state.tick == failed:
            node.rescue("r", state, "planted")
        else:
            found.append(asked(node, state, latent_at(state), sent[state.tick]))
    return found


def worded(verdict: VerdictMessage) -> str:
    return re.sub(r"\d+(\.\d+)?", "#", verdict.sentence)


@pytest.mark.parametrize("kind", ["healthy", "jump", "frozen", "lost", "lost for a while", "late", "slow clock"])
@given(seed=some.integers(0, 1000), failed=some.integers(BEGIN + 6, TICKS - 10))
@settings(max_examples=4)
def test_the_next_session_decides_as_the_one_before_would_have(kind: str, seed: int, failed: int) -> None:
    states = measured(kind, seed)
    whole = {verdict.tick: verdict for verdict in verdicts(states, seed)}
    # What was predicted for the tick after the failed one is lost with it.
    for verdict in (item for item in verdicts(states, seed, failed) if item.tick > failed + 1):
        other = whole[verdict.tick]
        assert (verdict.status, worded(verdict)) == (other.status, worded(other))
        np.testing.assert_allclose(verdict.action, other.action, atol=1e-6)
        assert verdict.margin == pytest.approx(other.margin)
        # A prediction along a failed step knows less: the same is only what is measured.
        same = {"healthy": slice(0, 4), "jump": slice(2, 4)}.get(kind, slice(0, 0))
        for one, another in zip(verdict.predicted[:1], other.predicted[:1], strict=True):
            np.testing.assert_allclose(one[same], another[same], atol=1e-6)
