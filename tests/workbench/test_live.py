"""The live page: its history of messages, its requests, and the page with a simulated diagnosis."""

import json
import signal

import pytest
from tests.messages import finding_of, stamp, state_of, verdict_of

from safedpa.bus import (
    FINDING,
    STATE,
    Answer,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    ModelMessage,
    Request,
    TakeoverMessage,
)
from safedpa.errors import InputError
from safedpa_services.workbench.live.links import LiveLink, ReplayLink
from safedpa_services.workbench.live.panels import (
    change_lines,
    error_bars,
    error_figure,
    evidence_figure,
    field_figure,
    live_cards,
)
from safedpa_services.workbench.live.store import RobotHistory
from safedpa_services.workbench.panels.theme import LIGHT

pytestmark = pytest.mark.slow

PATIENCE = 240_000
"""ms; on a busy machine a page takes its time."""
POLLING = 100
"""ms; a page that is asked at every picture that it draws computes nothing else."""
NOTE_OFFER = """() => {
  window.offered = false;
  const look = () => { window.offered ||= document.body.innerText.includes('change 1 is offered to'); };
  new MutationObserver(look).observe(document.body, {childList: true, subtree: true, characterData: true});
}"""
"""The words go by themselves: a busy browser may have shown them before anybody looks."""

REPORT = {
    "robot": "car",
    "stages": [{"heldout_error": 0.6}],
    "candidates": [
        {
            "stage": 0, "effect": "towed_load", "heldout_error": 0.1, "score": 8.0, "decision": "accepted",
            "indistinguishable_from": ["payload"], "reason": "gain on unseen blocks 8.0 standard errors",
            "parameters": {"mass_ratio": {"value": 0.8, "std": 0.05, "unit": "1"}},
        },
        {"stage": 0, "effect": "payload", "heldout_error": "no number"},
        "no candidate at all",
    ],
    "next_experiment": {"manoeuvre": "coast down", "why": "they differ there"},
}  # fmt: skip


def state(tick, epoch=1, **more):
    fields = {**stamp(tick, epoch=epoch), "applied": (1.0, 0.0), "obstacles": ((1.0, 1.0, 0.3),), **more}
    return state_of(0.01 * tick, 0.0, 0.0, 1.0, **fields)


def verdict(tick, **more):
    fields = {**stamp(tick), "action": (1.0, 0.0), "nominal": (1.0, 0.0), "h_now": 0.4, "h_next": 0.4, **more}
    return verdict_of("passed", sentence="The nominal action is safe.", margin=0.03, microseconds=300.0, **fields)


def finding(tick, stage="watching", error=0.05, report="", number=0):
    fields = {"model": "aaaa", "sentence": f"the stage is {stage}", "error": error, "where": "speed", "report": report}
    return finding_of(stage, **stamp(tick), number=number, **fields)


def model(tick, step):
    return ModelMessage(
        **stamp(tick), step=step, change=1, fingerprint="bbbb", replaces="aaaa", who="ann", why="accept"
    )


@pytest.fixture
def history():
    made = RobotHistory("r1")
    for tick in range(200):
        made.update(state(tick), 0.05 * tick)
    return made


def test_a_change_is_listed_with_the_error_before_and_after(history):
    for tick in range(0, 100, 20):
        history.update(finding(tick, "candidates", 0.5, number=1), 1.0)
    history.update(model(100, "offer"), 1.0)
    history.update(model(101, "take"), 1.0)
    for tick in range(120, 200, 20):
        history.update(finding(tick, error=0.1), 1.0)
    assert history.error_before_change == 0.5
    assert "−80 %" in error_bars(history, 0.0)
    assert "change 1, model bbbb is taken by ann: accept" in change_lines(history)
    assert [mark.kind for mark in history.marks].count("model") == 2
    for figure in (error_figure(history, LIGHT), evidence_figure(history, LIGHT), field_figure(history, LIGHT)):
        assert json.loads(json.dumps(figure, allow_nan=False))


def test_a_restarted_robot_begins_a_new_page(history):
    history.update(finding(20, "candidates", number=1, report=json.dumps(REPORT)), 1.0)
    history.update(state(0, epoch=2), 2.0)
    assert (history.finding, history.report, len(history.path)) == (None, None, 1)


def test_a_waiting_robot_that_repeats_itself_draws_one_point(history):
    before = len(history.path)
    history.update(state(199), 20.0)
    assert len(history.path) == before


SILENT = "r1: no state for 4 s; the robot has ended, hangs or is cut off, and brakes by itself."


@pytest.mark.parametrize(
    ("heard", "diagnosis_heard", "reported"),
    [
        (0.1, 1.0, ""),
        (0.1, 2.9, ""),
        (4.0, 1.0, f"{SILENT} r1 drove for 10 s"),
        (4.0, None, SILENT),
        (0.1, 4.0, "The diagnosis has been silent for 4 s."),
        (0.1, None, "No message from a diagnosis"),
    ],
)
def test_the_robots_silence_is_reported_first_and_then_the_diagnosis(history, heard, diagnosis_heard, reported):
    """Both speak at least once a second; a few lost messages are no silence."""
    history.update(state(200), 100.0 - heard)
    history.update(verdict(200), 100.0 - heard)
    if diagnosis_heard is not None:
        history.update(finding(200), 100.0 - diagnosis_heard)
    notice = history.silence_message(100.0)
    assert notice.startswith(reported)
    assert bool(notice) is bool(reported)


def test_a_deadlock_is_reported_with_reason_and_remedy_and_its_mark_stays(history):
    assert history.deadlock_message(10.0) == "", "before a verdict nothing is known"
    history.update(verdict(198, stationary_for=9.0), 10.0)
    assert history.deadlock_message(10.0) == "", "it is stationary while no motion is requested"
    reason = "margin: obstacle leave less room"
    for tick, seconds in ((199, 5.5), (219, 6.5)):
        history.update(verdict(tick, stationary_for=seconds, stationary_reason=reason), 10.0)
    assert history.deadlock_message(10.0).startswith(
        "r1 has been stationary for 6 s, margin: obstacle leave less room. Give it another goal"
    )
    assert change_lines(history).count("stationary: margin") == 1
    history.update(verdict(220), 10.0)
    assert history.deadlock_message(10.0) == ""
    assert change_lines(history).count("stationary: margin") == 1


@pytest.mark.parametrize(
    ("tick", "goals", "collisions", "account"),
    [
        (None, 0, 0, "Nothing was driven."),
        (200, 3, 0, "r1 drove for 10 s: 3 goals, 0 collisions."),
        (1228, 1, 1, "r1 drove for 61 s: 1 goal, 1 collision."),
    ],
)
def test_the_account_of_a_drive_counts_its_goals_and_collisions(tick, goals, collisions, account):
    history = RobotHistory("r1")
    if tick is not None:
        history.update(state(tick, goals_reached=goals, collisions=collisions), 1.0)
    assert history.summary() == account


def test_services_with_different_models_are_named(history):
    for service, fingerprint in (("policy", "aaaa"), ("safety_filter", "aaaa"), ("adaptation", "aaaa")):
        history.update(HealthMessage(**stamp(1), service=service, pid=1, state="running", model=fingerprint), 1.0)
    assert history.mismatch() == ""
    history.update(TakeoverMessage(**stamp(2), service="policy", change=1, fingerprint="bbbb", state="taken"), 1.0)
    assert "policy bbbb" in history.mismatch()
    refusal = TakeoverMessage(**stamp(3), service="policy", change=2, fingerprint="cccc", state="refused", reason="bad")
    history.update(refusal, 1.0)
    assert "policy refuses change 2: bad" in change_lines(history)
    phrase = "the margin of obstacle goes from 0.03 to 0.115 where h is 0.08"
    ready = TakeoverMessage(
        **stamp(4), service="safety_filter", change=3, fingerprint="dddd", state="ready", expected_effect=phrase
    )
    history.update(ready, 1.0)
    assert f"change 3: {phrase}" in change_lines(history)


@pytest.mark.parametrize("report", ["no json", "[]", '{"candidates": 3}'])
def test_an_unreadable_report_is_reported_and_left_out(history, report):
    history.update(finding(20, "candidates", number=1, report=report), 1.0)
    assert history.report is None
    assert "an invalid report" in history.problems[-1]


def test_cards_show_what_can_be_read_and_name_the_rest():
    cards, experiment = live_cards("car", REPORT, ("towed_load", "payload", "own_effect"))
    assert [card.effect for card in cards] == ["towed_load", "payload", "own_effect"]
    assert cards[0].decision == "accepted"
    assert cards[0].indistinguishable_from == ("payload",)
    assert any("0.6 → 0.1" in line for line in cards[0].speaks_for)
    assert cards[1].parameters == ()
    assert "coast down" in experiment
    assert live_cards("car", None, ()) == ([], "")


def test_of_two_entries_of_one_name_the_accepted_one_has_the_card():
    own = REPORT["candidates"][0]
    tried_first = {**own, "heldout_error": None, "decision": "rejected", "parameters": {}}
    (card,), _ = live_cards("car", {**REPORT, "candidates": [tried_first, own]}, ("towed_load",))
    assert (card.decision, card.indistinguishable_from) == ("accepted", ("payload",))


def test_the_link_reports_answers_missing_ones_and_nonsense(finished):
    broker = MemoryBroker()
    link = LiveLink(Bus(MemoryTransport(broker), "fleet"))
    other = MemoryTransport(broker)
    reported = finished(link.ask("r1", Request(do="status")))
    assert not reported.ok
    assert "No diagnosis answers" in reported.sentence
    other.answer("safedpa/fleet/r1/request", lambda _key, _payload: b"\xc1 nonsense")
    reported = finished(link.ask("r1", Request(do="status")))
    assert "an invalid answer" in reported.sentence
    sender = Bus(other, "fleet")
    sender.answer_requests(lambda robot, request: Answer(ok=True, sentence=f"{robot} {request.do}"), "r2")
    assert finished(link.ask("r2", Request(do="status"))).sentence == "r2 status"


def test_the_link_waits_a_few_seconds_for_an_answer(monkeypatch, finished):
    bus, waited = Bus(MemoryTransport(MemoryBroker()), "fleet"), []
    monkeypatch.setattr(bus, "request", lambda _robot, _request, seconds: waited.append(seconds))
    finished(LiveLink(bus).ask("r1", Request(do="status")))
    assert 1.0 <= waited[0] <= 4.0


def test_garbage_on_the_bus_is_counted_and_robots_appear_with_their_states():
    broker = MemoryBroker()
    link = LiveLink(Bus(MemoryTransport(broker), "fleet"))
    sender = MemoryTransport(broker)
    robot = Bus(sender, "fleet")
    sender.put("safedpa/fleet/r1/state", b"\x00garbage", never_drop=False)
    robot.publish(FINDING, "r9", finding(1))
    link.listen()
    assert link.store.refused == 1
    assert link.store.robots == {}
    robot.publish(STATE, "r1", state(1))
    link.listen()
    sender.put("safedpa/fleet/r1/finding", b"\x00garbage", never_drop=False)
    link.listen()
    assert list(link.store.robots) == ["r1"]
    assert "refused" in link.store.robots["r1"].problems[-1]


def test_a_recording_plays_at_the_pace_of_the_robots_clock(tmp_path, finished):
    from safedpa.records import McapRecorder

    now = [100.0]
    path = tmp_path / "drive.mcap"
    broker = MemoryBroker()
    recorded = Bus(MemoryTransport(broker), "fleet")
    inbox = recorded.inbox((STATE, FINDING), keep_all=True)
    for tick in range(0, 100):
        recorded.publish(STATE, "r1", state(tick))
    recorded.publish(FINDING, "r1", finding(99, "candidates", 0.5, json.dumps(REPORT), 1))
    with McapRecorder(path) as recorder:
        for item in inbox.take(0.0):
            recorder.write(item.key, item.payload, item.message.tick * 50_000_000, item.message.tick * 50_000_000)
    link = ReplayLink(path, clock=lambda: now[0])
    link.listen()
    assert len(link.store.robots["r1"].path) == 1
    now[0] += 2.0
    link.listen()
    assert link.store.robots["r1"].now == pytest.approx(2.0)
    now[0] += 10.0
    link.listen()
    assert finished(link.ask("r1", Request(do="status"))).answer.candidates == ("towed_load",)
    reported = finished(link.ask("r1", Request(do="accept", effect="towed_load")))
    assert not reported.ok
    assert "a recording" in reported.sentence


def test_a_recording_without_messages_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        ReplayLink(tmp_path / "none.mcap")


@pytest.mark.long
@pytest.mark.browser
@pytest.mark.processes
def test_a_candidate_is_accepted_on_the_live_page(browser, live):
    server, address = live
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    hosts, complaints = set(), []
    page.on("request", lambda request: hosts.add(request.url.split("/")[2]))
    page.on("console", lambda message: complaints.append(message.text))
    page.goto(address)
    page.wait_for_selector(".candidate.open >> text=Accept", timeout=PATIENCE)
    page.wait_for_selector("#verdict >> text=/the stage is candidates/i", timeout=PATIENCE)
    page.wait_for_selector("text=/If you accept: the margin of obstacle goes from 0.03 to 0.1/", timeout=PATIENCE)
    assert not page.get_by_label("back to the model before").is_visible()
    page.evaluate(NOTE_OFFER)
    page.keyboard.press("a")
    page.wait_for_function("window.offered", polling=POLLING, timeout=PATIENCE)
    page.wait_for_selector("text=−80 % since the change", timeout=PATIENCE)
    page.wait_for_selector(".candidate", state="detached", timeout=PATIENCE)  # what may be accepted is asked for
    page.get_by_label("back to the model before").wait_for(timeout=PATIENCE)
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280
    before = len(complaints)
    server.send_signal(signal.SIGTERM)
    page.wait_for_selector("text=/The drive has ended. r1 drove for/", timeout=PATIENCE)
    server.wait(PATIENCE / 1000)
    page.wait_for_timeout(2000)
    assert not page.locator("#popup").is_visible(), "an end is no lost connection"
    page.close()
    assert hosts == {address.split("/")[2]}
    assert [line for line in complaints[:before] if "WebSocket" not in line] == []
    ended = ("net::ERR_", "WebSocket")  # what a browser says, again and again, of a server that goes and is gone
    assert [line for line in complaints[before:] if not any(word in line for word in ended)] == []


@pytest.mark.long
@pytest.mark.browser
@pytest.mark.processes
def test_a_drive_that_ends_while_the_page_loads_is_reported_as_ended(browser, live):
    """The page was delivered, but its scripts are not loaded yet: the server waits for it, with a limit."""
    server, address = live
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    ended = []

    def end(response):
        if response.request.resource_type == "document" and not ended:
            ended.append(response.url)
            server.send_signal(signal.SIGTERM)

    page.on("response", end)
    page.goto(address)
    page.get_by_text("The drive has ended").locator("visible=true").first.wait_for(timeout=PATIENCE)
    server.wait(PATIENCE / 1000)
    page.close()
