"""The experiment of live diagnosis, on drives that are scripted: which drives it makes, and what it accepts when."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from tests.messages import stamp

from safedpa.bus import MODEL, STATE, ModelMessage, ReceivedMessage
from safedpa_lab.experiments.diagnosis import live
from safedpa_lab.experiments.diagnosis.live import LiveDrive, drive_live


@pytest.mark.parametrize("quiet", [True, False])
def test_every_case_is_driven_on_every_scene_and_quiet_drives_are_reported_apart(quiet, monkeypatch):
    case, other = list(live.CASES)[:2]
    asked = []

    def drive(name, seed, seconds, after, *, model):
        assert model == "car"
        asked.append((name, seed, seconds, after))
        return LiveDrive(name, seed, collisions=seed, driven=seconds)

    monkeypatch.setattr(live, "drive_live", drive)
    cases = (case, live.NOTHING, other) if quiet else (case, other)
    wanted = live.LiveExperiment(cases, (1, 2, 3), (8, 9), 1800.0, 20.0, model="car")
    progress = []
    found = live.live_experiment(wanted, lambda *one: progress.append(one))
    drives = [(name, seed, 150.0, 20.0) for name in (case, other) for seed in (1, 2, 3)]
    drives += [(live.NOTHING, seed, 1800.0, 20.0) for seed in (8, 9)] if quiet else []
    assert asked == drives
    assert progress == [(number, len(drives)) for number in range(1, len(drives) + 1)]
    assert [(row["case"], row["effect"], row["drives"], row["collisions"]) for row in found["rows"]] == [
        (case, live.CASES[case], 3, 6), (other, live.CASES[other], 3, 6),
    ]  # fmt: skip
    if quiet:
        assert (found["quiet"]["hours"], found["quiet"]["collisions"]) == (1.0, 17)
    else:
        assert found["quiet"] is None


class Diagnosis:
    """The diagnosis node of one robot, whose outcomes are scripted; records what it is asked for."""

    def __init__(self):
        self.known, self.asked, self.now = None, [], 0.0

    def diagnosis_of(self, _robot):
        return self.known

    def answer(self, _robot, request):
        assert (request.do, request.model, request.finding) == ("accept", "f", 3)
        self.asked.append((self.now, request.effect))

    def finds(self, outcome):
        self.known = SimpleNamespace(outcome=outcome, time=self.now, fingerprint="f", number=3)


@pytest.fixture
def scripted(monkeypatch, state_of):
    """scripted(events, seconds, ...): a drive in which outcomes and messages come at given times, and its node."""

    def run(events, seconds=30.0, **options):
        node = Diagnosis()
        script = {round(20 * at): event for at, event in events.items()}
        robot = SimpleNamespace(collisions=[], goals_reached=0, changed_at=None, tick=0)

        def drive(_robot, _nodes, count, hear):
            for robot.tick in range(1, count + 1):
                tick = robot.tick - 1
                state, node.now = state_of((tick, np.zeros(4), np.zeros(2))), tick / 20
                match script.get(tick):
                    case ModelMessage() as message:
                        hear(ReceivedMessage(MODEL, "r1", message, b"", "", 0.0))
                    case event if tick in script:
                        node.finds(event)
                hear(ReceivedMessage(STATE, "r1", state, b"", "", 0.0))
                yield SimpleNamespace(verdict=SimpleNamespace(h_now=1.0 - 0.001 * tick), state=state)

        monkeypatch.setattr(live, "CarRobot", lambda *_, **__: robot)
        monkeypatch.setattr(live, "DiagnosisNode", lambda *_: node)
        monkeypatch.setattr(live, "drive", drive)
        return drive_live("nothing", 1, seconds, **options), node.asked

    return run


def change(step: str, tick: int) -> ModelMessage:
    return ModelMessage(**stamp(tick), step=step, change=1, fingerprint="f", replaces="e", from_tick=tick)


@pytest.mark.parametrize(
    ("seconds", "taken", "driven"), [(10.0, None, 10.0), (60.0, 10.0, 35.1), (60.0, 50.0, 60.0), (1.0, 10.0, 1.0)]
)
def test_a_drive_ends_25_seconds_after_the_change_of_the_model_or_at_its_limit(scripted, seconds, taken, driven):
    found, _ = scripted({} if taken is None else {taken: change("take", round(20 * taken))}, seconds)
    assert found.driven == pytest.approx(driven)
    assert found.taken == (taken if taken is not None and taken < seconds else None)
    assert found.least_h == pytest.approx(1.0 - 0.001 * (round(20 * driven) - 1))


def test_the_model_changes_at_the_first_tick_from_which_it_is_used(scripted):
    events = {1.0: change("offer", 100), 2.0: change("drop", 120), 3.0: change("take", 200), 4.0: change("take", 300)}
    assert scripted(events)[0].taken == pytest.approx(10.0)


def outcome(*effects, error, alike=()):
    """Of a search before which the error on unseen data was 1; entries of other effects and stages come with it."""
    own = {"stage": 0, "effect": "drag", "heldout_error": error, "indistinguishable_from": alike}
    own["parameters"] = {"c": {"value": 0.5}}
    later = {**own, "stage": 1, "heldout_error": 9.0, "indistinguishable_from": ("x",), "parameters": {}}
    other = {**own, "effect": "wind", "heldout_error": 9.0, "indistinguishable_from": ("y",), "parameters": {}}
    report = {"candidates": [later, own, other], "stages": [{"heldout_error": 1.0}]}
    return SimpleNamespace(documents=dict.fromkeys(effects, "text"), effects=list(effects), report=json.dumps(report))


GOOD = {"error": 0.1}


@pytest.mark.parametrize(
    ("events", "reading", "accepted"),
    [
        ({1.0: None, 7.0: outcome("drag", "wind", error=0.39)}, 0.0, [7.0]),
        ({1.0: None, 7.0: outcome("drag", "wind", error=0.41)}, 0.0, []),
        ({7.0: outcome("drag", alike=("slope",), **GOOD)}, 0.0, []),
        ({7.0: outcome("drag", alike=("slope",), **GOOD), 17.0: outcome("drag", alike=("slope",), **GOOD)}, 0.0, [17]),
        ({7.0: outcome("drag", **GOOD)}, 5.0, [12.0]),
        ({7.0: outcome(**GOOD)}, 0.0, []),
        ({2.0: change("take", 40), 7.0: outcome("drag", **GOOD)}, 0.0, []),
    ],
    ids=["enough", "too_little", "ambiguous", "twice", "after_reading", "nothing_found", "after_a_change"],
)
def test_an_effect_is_accepted_once_if_unseen_data_promise_a_fall_to_forty_per_cent(
    scripted, events, reading, accepted
):
    """An effect that others cannot be distinguished from waits for a second search; a user reads before accepting."""
    found, asked = scripted(events, reading=reading)
    assert asked == [(pytest.approx(at), "drag") for at in accepted]
    if found.taken is None and events[7.0].effects:
        assert (found.effect, found.numbers) == ("drag", {"c": 0.5})
        assert found.found == pytest.approx(7.0)
