"""Recordings dragged from a folder onto the page: kept on the server, said to be there, read, opened."""

from __future__ import annotations

import pytest

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.browser, pytest.mark.processes]

PATIENCE = 240_000
"""ms."""
POLLING = 100
"""ms; a page that is asked at every picture that it draws computes nothing else."""
FILES = """(named) => { const drag = new DataTransfer();
  for (const [name, text] of named) drag.items.add(new File([text], name, {type: 'text/csv'}));
  return drag; }"""


def dragged(page, at, *files):
    """What a browser does when files are dragged over ``at`` and let go there."""
    drag = page.evaluate_handle(FILES, [list(item) for item in files])
    for kind in ("dragenter", "dragover"):
        page.dispatch_event(at, kind, {"dataTransfer": drag})
    onto = ".q-uploader__dnd" if at == ".q-uploader" else at  # the box covers itself while something is above it
    page.wait_for_selector(onto, state="attached", timeout=PATIENCE)
    page.dispatch_event(onto, "drop", {"dataTransfer": drag})


def opened(browser, address):
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.complaints = []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.goto(address)
    return page


def test_files_dragged_onto_the_box_are_opened(browser, serve, drives, tmp_path):
    model, runs = drives
    page = opened(browser, serve("--folder", model.parent))
    page.wait_for_selector(".q-uploader", timeout=PATIENCE)
    page.fill("input[aria-label^='Model']", str(model))
    page.press("input[aria-label^='Model']", "Tab")
    dragged(page, ".q-uploader", *((path.name, path.read_text(encoding="utf-8")) for path in runs))
    for path in runs:  # they travel side by side, so any may come first
        page.wait_for_selector(f"text=/Uploaded: {path.name}, .* MB/", timeout=PATIENCE)
    page.wait_for_selector("text=/drive_..csv .first of 2 files.: 800 rows in 1 stretch/", timeout=PATIENCE)
    kept = {path.name[4:]: path.read_text(encoding="utf-8") for path in (tmp_path / "out" / "uploads").iterdir()}
    assert kept == {path.name: path.read_text(encoding="utf-8") for path in runs}
    page.locator(".q-dialog").get_by_role("button", name="Open", exact=True).click()  # a path may say 'open' too
    page.wait_for_function(
        "document.querySelectorAll('.stages .value').length === 1", polling=POLLING, timeout=PATIENCE
    )
    assert "2 recordings, 80 s" in page.locator(".what").inner_text()
    assert page.complaints == []
    page.close()


def test_files_dropped_beside_the_box_do_not_take_the_page_away(browser, serve, drives, tmp_path):
    model, runs = drives
    page = opened(browser, serve(model, runs[0]))
    page.wait_for_function(
        "document.querySelectorAll('.stages .value').length === 1", polling=POLLING, timeout=PATIENCE
    )
    dragged(page, "main", (runs[1].name, runs[1].read_text(encoding="utf-8")))
    page.wait_for_selector("text=/Uploaded: drive_2.csv/", timeout=PATIENCE)
    assert str(tmp_path / "out" / "uploads" / "001_drive_2.csv") in page.input_value(".q-dialog textarea")
    dragged(page, ".dialog-title", ("notes.txt", "no recording"))
    page.wait_for_selector("text=/Not taken: wanted recordings .*csv/", timeout=PATIENCE)
    assert len(list((tmp_path / "out" / "uploads").iterdir())) == 1
    assert page.complaints == []
    page.close()
