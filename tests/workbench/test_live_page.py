"""The live page without a browser: answers, consequences, decisions, and what pops up."""

import asyncio
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("nicegui")
from nicegui import ui
from tests.messages import finding_of, state_of, verdict_of
from tests.workbench.tab import Tab, turns

from safedpa.bus import Answer
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench import page, tab
from safedpa_services.workbench.live.links import QueryResult
from safedpa_services.workbench.live.page import LivePage
from safedpa_services.workbench.live.store import RobotHistory
from safedpa_services.workbench.panels.elements import with_table
from safedpa_services.workbench.rerun_viewer import RerunViewerServer
from safedpa_services.workbench.session.controller import SessionController
from safedpa_services.workbench.session.inputs import InputSelection

FORESEEN = ("the margin goes from 1 to 2",)
STATUS = Answer(ok=True, sentence="change 1 begins", candidates=("drag", "wind"), foreseen=FORESEEN, earlier=1)
REFUSED = Answer(ok=False, sentence="refused: no one is there")
BACK = "back to the model before the last change"
LONGEST_COVERED = 10_000
"""ms for which words may cover a part of the page."""
LETTERS_A_SECOND = 15.0


class Link:
    """A drive of one robot that is played; ``answers`` in turn, of which the last one stays."""

    title, ended = "fleet f", False

    def __init__(self, *answers):
        self.answers, self.asked, self.pages_to_notify = list(answers), list[Any](), set[object]()
        history, now = RobotHistory("r1"), time.monotonic()
        history.update(state_of(tick=20, robot_time=1.0), now)
        history.update(verdict_of("passed", h_now=0.4, margin=0.03), now)
        history.update(finding_of("candidates", model="a" * 8, number=7, report='{"candidates": []}'), now)
        self.store = SimpleNamespace(robots={"r1": history}, last_refusal="")

    async def ask(self, robot, request):
        self.asked.append((robot, request))
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


def reported(answer):
    return QueryResult(answer, answer.sentence)


@pytest.fixture
def shown(finished):
    """shown(link, do): what ``do(page, tab)`` returns of a live page that shows the robot and knows its candidates."""

    def run(link, do):
        async def story():
            with Tab() as tab:
                made: Any = link
                page = LivePage(made)
                page.show()
                await page.ask_status()
                page.show()
                return await do(page, tab)

        return finished(story())

    return run


def can_be_read(notice):
    """Whether it stays long enough, and goes by itself."""
    return bool(1000.0 * len(notice["message"]) / LETTERS_A_SECOND <= notice["timeout"] <= LONGEST_COVERED)


@pytest.mark.parametrize(
    ("button", "do", "answer", "phrase", "kind"),
    [
        ("accept drag", "accept", reported(STATUS), "Accepted: change 1 begins.", "positive"),
        ("reject drag", "reject", reported(STATUS), "Rejected: change 1 begins.", "positive"),
        (BACK, "roll_back", reported(STATUS), "Rolled back: change 1 begins.", "positive"),
        ("accept drag", "accept", reported(REFUSED), "Refused because no one is there.", "negative"),
        ("accept drag", "accept", QueryResult(None, "No diagnosis answers."), "No diagnosis answers.", "negative"),
    ],
)
def test_a_decision_is_asked_for_with_what_was_seen_and_its_answer_pops_up(shown, button, do, answer, phrase, kind):
    link = Link(reported(STATUS), answer, reported(STATUS))

    async def decide(_, tab):
        tab.all(ui.input)[0].value = "ann"
        await tab.click(button)
        return tab.popped_up

    (notice,) = shown(link, decide)
    robot, request = link.asked[1]
    assert (robot, request.do, request.model, request.finding, request.who) == ("r1", do, "a" * 8, 7, "ann")
    assert request.effect == ("" if do == "roll_back" else "drag")
    assert (notice["message"], notice["type"]) == (phrase, kind)
    assert can_be_read(notice)
    assert [request.do for _, request in link.asked] == ["status", do, "status"]


def test_each_candidate_shows_the_consequence_of_accepting_it_with_h_and_margin_of_now(shown):
    async def look(page, tab):
        await page.ask_status()
        first = [line for line in tab.lines if line.startswith("If you accept: ")]
        (wind,) = [element for element in tab.all(ui.html) if element.content == "wind"]
        await tab.trigger(wind.parent_slot.parent, "click")
        return first + [line for line in tab.lines if line.startswith("If you accept: ")]

    drag, wind = shown(Link(reported(STATUS)), look)
    assert drag.startswith("If you accept: the margin goes from 1 to 2. Now h is 0.40, the margin 0.030.")
    assert "is being computed" in wind


def test_the_margins_of_an_offer_are_a_table(shown):
    rows = ("margin of | now | then | h now | takes effect", "obstacle | 0.03 | 0.115 | 0.4 | at once")

    async def look(page, tab):
        await page.ask_status()
        return next(line for line in tab.lines if line.startswith("If you accept: "))

    line = shown(Link(reported(replace(STATUS, foreseen=("\n".join(rows),)))), look)
    assert line.startswith("If you accept: all services switch")
    assert "<th>margin of</th><th>now</th>" in line
    assert "<td>obstacle</td><td>0.03</td><td>0.115</td><td>0.4</td><td>at once</td>" in line


def test_markup_in_a_table_is_escaped():
    assert with_table("text\na | b\n<i> | 1").endswith("<td>&lt;i&gt;</td><td>1</td></tr></tbody></table>")
    assert with_table("a < b") == "a &lt; b"


def test_the_end_of_a_change_pops_up_once(shown):
    pending = replace(STATUS, pending="change 1")
    over = replace(STATUS, sentence="change 1 was refused: the filter cannot have it")

    async def wait(page, tab):
        assert any(line.endswith("(change 1 …)") for line in tab.lines)
        for _ in range(3):
            await page.ask_status()
        return tab.popped_up

    (notice,) = shown(Link(reported(pending), reported(over)), wait)
    assert notice["message"] == "Change 1 was refused: the filter cannot have it"
    assert can_be_read(notice)


def test_without_an_earlier_model_there_is_no_way_back(shown):
    async def look(_, tab):
        return bool(tab.button(BACK).visible)

    assert not shown(Link(reported(replace(STATUS, earlier=0))), look)
    assert shown(Link(reported(STATUS)), look)


def test_a_browser_gets_the_next_picture_once_it_has_taken_the_last_one(shown, monkeypatch):
    """One that draws too slowly would keep all of them; the end of the drive is shown at once."""
    link, drawn = Link(reported(STATUS)), list[int]()

    async def look(page, tab):
        answer = asyncio.Event()

        async def answered(_script, _seconds):
            await answer.wait()

        async def count():
            before = len(drawn)
            for _ in range(3):
                redraw()
                await turns()
            return len(drawn) - before

        monkeypatch.setattr("safedpa_services.workbench.live.page.run_script", answered)
        monkeypatch.setattr(page, "show", lambda: drawn.append(1))
        redraw = next(timer.callback for timer in tab.all(ui.timer) if timer.interval < 1.0)
        waiting = await count()
        answer.set()
        await turns()
        taken = await count()
        answer.clear()
        redraw()
        link.ended = True
        ended = await count()
        answer.set()
        await turns()
        return waiting, taken, ended

    assert shown(link, look) == (1, 3, 3)


def test_the_picture_is_drawn_about_twice_a_second_and_the_answers_come_within_seconds(shown):
    async def look(_, tab):
        return [timer.interval for timer in tab.all(ui.timer)]

    picture, status = shown(Link(reported(STATUS)), look)
    assert 0.2 <= picture <= 1.0
    assert 0.5 <= status <= 3.0


def test_an_error_message_of_the_workbench_pops_up_for_no_longer_than_ten_seconds(finished, tmp_path, monkeypatch):
    async def light():
        return False

    class Recorded(SessionController):
        def add_listener(self, tab, on_event):
            super().add_listener(tab, on_event)
            callbacks.append(on_event)

    callbacks: list[Any] = []
    monkeypatch.setattr(tab, "prefers_dark_mode", light)
    controller = Recorded(InputSelection(), tmp_path)
    controller.error_message = "the worker was ended: start it again"

    async def story():
        with Tab() as tab:
            await page.WorkbenchPage(controller, RerunViewerServer(), FileStore.of((), ())).begin()
            opened: Any = object()
            controller.session = opened
            callbacks[0]("error")
            return tab.popped_up

    (notice,) = finished(story())
    assert (notice["message"], notice["type"]) == (controller.error_message, "negative")
    assert can_be_read(notice)
