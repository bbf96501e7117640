"""The same problems through other filters: what each answers is judged alike, and what is missing is named."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from safedpa.safety import SafetyFilter, Status
from safedpa_lab.experiments.adversary import peers
from safedpa_lab.experiments.adversary.linear_judge import LinearJudge
from safedpa_lab.experiments.adversary.peer_filters import PEERS
from safedpa_lab.experiments.adversary.peers import OWN, PEER_PACKAGES, Peers, peer_problems


def rows(found):
    return {row.what: row for row in found[1]}


def script_that(folder, body):
    """A script in the place of the peers'."""
    path = folder / "peer_filters.py"
    path.write_text(f"import json, sys\nproblems = json.load(sys.stdin)['problems']\n{body}\n")
    return path


@pytest.fixture
def scripted(monkeypatch, tmp_path):
    def use(body):
        script_that(tmp_path, body)
        monkeypatch.setattr(peers, "__file__", str(tmp_path / "peers.py"))
        monkeypatch.setattr(peers, "PEER_PACKAGES", {"planted": "json"})

    return use


def test_every_peer_that_is_asked_has_a_filter():
    assert set(PEERS) == set(PEER_PACKAGES)


def test_a_peer_that_is_not_installed_is_named_as_missing(monkeypatch):
    monkeypatch.setattr(peers, "PEER_PACKAGES", {"planted": "no_such_package_anywhere"})
    (row,) = Peers().work(("planted", 0, 2))[1]
    assert row.what == "planted: no_such_package_anywhere is not installed here"
    assert row.held is None


def test_silent_and_announced_unsafe_actions_are_counted_apart(scripted):
    scripted("print(json.dumps([{'action': p['wish'], 'said': 'beware' if i % 2 else ''} "
             "for i, p in enumerate(problems)]))")  # fmt: skip
    found = rows(Peers((sys.executable,)).work(("planted", 3, 20)))
    unsaid = found["planted, at scale 1: unsafe action, and not a word"].measured
    said = found["planted, at scale 1: unsafe action, and said so"].measured
    assert unsaid > 5
    assert said > 5
    assert unsaid + said <= 20
    assert found["planted, at scale 1: no action at all"].measured == 0


def test_the_answers_of_the_reference_are_safe(scripted, monkeypatch):
    problems = peer_problems(3, 20, False)
    best = [LinearJudge(problem).nearest() for problem in problems]
    answers = [{"action": None if item is None else item.action.tolist(), "said": ""} for item in best]
    scripted(f"print({json.dumps(answers)!r})")
    monkeypatch.setattr(peers, "peer_problems", lambda *_: problems)
    found = rows(Peers((sys.executable,)).work(("planted", 3, 20)))
    assert found["planted, at scale 1: unsafe action, and not a word"].measured == 0
    assert found["planted, at scale 1: no action at all"].measured == sum(item is None for item in best)


def test_a_failing_peer_is_reported(scripted):
    scripted("raise SystemExit('no licence')")
    (row,) = Peers((sys.executable,)).work(("planted", 0, 2))[1]
    assert row.what == "planted: failed: no licence"


def test_own_answers_are_judged_like_the_others(monkeypatch):
    original = SafetyFilter.decide

    def deaf(self, state, wish, *others, **known):
        verdict = original(self, state, wish, *others, **known)
        action = np.clip(wish, -1.0, 1.0)
        action.setflags(write=False)
        return replace(verdict, action=action, status=Status.passed)

    before = rows(Peers().work((OWN, 3, 20)))["safedpa, at scale 1: unsafe action, and not a word"]
    assert before.measured == 0
    monkeypatch.setattr(SafetyFilter, "decide", deaf)
    after = rows(Peers().work((OWN, 3, 20)))["safedpa, at scale 1: unsafe action, and not a word"]
    assert after.measured > 10
    assert after.held is False


def test_all_problems_have_one_shape_and_the_units_that_were_asked_for():
    for mixed in (False, True):
        for problem in peer_problems(2, 30, mixed):
            assert problem.P.shape == (6, 5)
            assert problem.g.shape == (5, 2)
            assert (problem.low == -1.0).all()
    sizes = [max(LinearJudge(p).scale) / min(LinearJudge(p).scale) for p in peer_problems(2, 30, True)]
    assert np.median(sizes) > 1e4
