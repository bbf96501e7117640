"""Every page as a person sees it: phone to wide screen, light and dark; the pictures are kept for who wants to look.

Nothing is wider than the screen, cut off, or over another text. SAFEDPA_SCREENS names a folder for the pictures.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from safedpa_services.command_line.group import safedpa

pytestmark = [pytest.mark.slow, pytest.mark.browser, pytest.mark.processes]

PATIENCE = 240_000
SIZES = ((390, 844), (1280, 800), (1400, 900), (1920, 1080))
SCHEMES = ("light", "dark")
WRONG = (Path(__file__).parent / "screens.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """The folder for pictures."""
    named = os.environ.get("SAFEDPA_SCREENS")
    folder = Path(named) if named else tmp_path_factory.mktemp("screens")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def reports(drives, tmp_path_factory):
    """The reports of a diagnosis, of a comparison and of a rehearsal, on disk."""
    model, runs = drives
    out, files = tmp_path_factory.mktemp("reports"), list(map(str, runs))
    assert safedpa.run(["compare", str(model), *files, "--out", str(out / "compared")]) == 0
    assert safedpa.run(["diagnose", str(model), *files, "--out", str(out / "found")]) == 0
    return {"compare": out / "compared" / "compare.html", "diagnose": out / "found" / "report.html"}


def looked_at(browser, address, ready, name, pictures, steps=(("", lambda _page: None),)):
    """What is wrong at each width and in each scheme, after each step; a picture of each."""
    found = []
    for scheme in SCHEMES:
        context = browser.new_context(color_scheme=scheme)
        page = context.new_page()
        page.set_viewport_size({"width": SIZES[1][0], "height": SIZES[1][1]})
        page.goto(address)
        page.wait_for_selector(ready, timeout=PATIENCE)
        for step, act in steps:
            act(page)
            for width, height in SIZES:
                page.set_viewport_size({"width": width, "height": height})
                page.wait_for_timeout(900)
                title = f"{name}{step}-{scheme}-{width}"
                page.screenshot(path=pictures / f"{title}.png", full_page=not step)
                found += [f"{title}: {line}" for line in page.evaluate(WRONG, [width])]
        context.close()
    return "\n".join(found)


def dialog(key, sign):
    """Opens one."""

    def act(page):
        page.keyboard.press("Escape")
        page.wait_for_selector(".q-dialog", state="detached", timeout=PATIENCE)
        page.keyboard.press(key)
        page.wait_for_selector(sign, timeout=PATIENCE)

    return act


def test_the_workbench(browser, serve, drives, pictures):
    model, runs = drives
    steps = (("", lambda _page: None), ("-open", dialog("o", ".preview table")), ("-keys", dialog("?", "dl.keys")))
    assert looked_at(browser, serve(model, *runs), ".candidate", "workbench", pictures, steps) == ""


def test_the_live_page(browser, live, pictures):
    assert looked_at(browser, live[1], ".candidate", "live", pictures) == ""


@pytest.mark.parametrize("name", ["compare", "diagnose"])
def test_the_reports(browser, reports, name, pictures):
    assert looked_at(browser, reports[name].as_uri(), ".main-svg", name, pictures) == ""
