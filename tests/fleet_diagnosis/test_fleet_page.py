"""The fleet's page in a real browser: offline, sorted, narrowed, and the robots' pages behind its links."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    with playwright.sync_playwright() as play:
        started = play.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-background-networking"]
        )
        yield started
        started.close()


def opened(browser: Any, path: Any) -> tuple[Any, list[str]]:
    page, said = browser.new_page(viewport={"width": 1280, "height": 900}), []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith("file:") else said.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_selector(".main-svg")
    return page, said


def test_the_page_draws_sorts_and_narrows_without_a_network(browser, small_fleet):
    page, said = opened(browser, small_fleet.out / "fleet.html")
    assert page.locator("section.card").count() == 4
    assert page.locator("#strips .main-svg").count() > 0
    page.click("th button:has-text('after')")
    shown = page.locator("#robots tbody tr td:nth-child(5)").all_inner_texts()
    assert [float(text) for text in shown] == sorted(float(text) for text in shown)
    page.fill("#filter", "steering_offset")
    assert page.locator("#robots tbody tr:visible").count() == 1
    assert page.inner_text("#shown") == "1 of 5"
    assert said == []
    page.close()


def test_a_link_leads_to_the_robots_report_which_draws_with_the_shared_script(browser, small_fleet):
    page, said = opened(browser, small_fleet.out / "fleet.html")
    page.click("#robot-car_002 a")
    page.wait_for_selector("#falling .main-svg")
    assert page.inner_text("h1") == "car_002"
    assert said == []
    page.close()
