"""The workbench in a real browser: see where the model fails, add what it lacks, undo; drop files on it."""

import re
from pathlib import Path

import pytest

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.browser, pytest.mark.processes]

PATIENCE = 240_000
"""ms; a search takes seconds, on a busy machine more."""
POLLING = 100
"""ms; a page that is asked at every picture that it draws computes nothing else."""
MAP = ".panel:nth-of-type(2) .js-plotly-plot >> nth=0"
ONE_BAR = "document.querySelectorAll('.stages .value').length === 1"
FILES = """(named) => { const drag = new DataTransfer();
  for (const [name, text] of named) drag.items.add(new File([text], name, {type: 'text/csv'}));
  return drag; }"""


class Watched:
    """A page of 1280 x 800 with everything that it asked for and complained about."""

    def __init__(self, browser, address):
        self.page = browser.new_page(viewport={"width": 1280, "height": 800})
        self.hosts, self.complaints = set(), []
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.on("console", lambda message: self.complaints.append(f"{message.type}: {message.text}"))
        self.page.on("pageerror", lambda error: self.complaints.append(f"error: {error}"))
        self.page.goto(address)
        self.address = address

    def errors_of_bars(self):
        return [float(text) for text in self.page.locator(".stages .value").all_inner_texts()]

    def wait_for_bars(self, count):
        self.page.wait_for_function(
            f"document.querySelectorAll('.stages .value').length === {count}", polling=POLLING, timeout=PATIENCE
        )
        return self.errors_of_bars()

    def mean_of_map(self):
        return self.page.evaluate(
            """() => { const data = document.querySelectorAll('.panel')[1].querySelector('.js-plotly-plot').data;
            const cells = data[0].z.flat().filter((value) => value !== null);
            return cells.reduce((sum, value) => sum + value, 0) / cells.length }"""
        )

    def close(self):
        assert self.hosts == {self.address.split("/")[2]}, "a request left this machine"
        assert self.complaints == []
        self.page.close()


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


def brushed(watched):
    """Draws a box over a part of the error map; returns what the page says of it, and the dots in the other figure."""
    page = watched.page
    box = page.locator(f"{MAP} >> .nsewdrag").bounding_box()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.2 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 0.7 * box["height"], steps=5)
    page.mouse.up()
    page.wait_for_selector("text=/windows: error/", timeout=PATIENCE)
    notice = page.locator(".panel:nth-of-type(2) [aria-live]").inner_text()
    last = "document.querySelectorAll('.panel')[1].querySelectorAll('.js-plotly-plot')[1].data.at(-1)"
    page.wait_for_function(f"{last}.mode === 'markers'", polling=POLLING, timeout=PATIENCE)
    return notice, page.evaluate(f"{last}.x.length")


def test_the_five_steps_on_a_drive_with_hidden_drag(browser, serve, drives):
    model, runs = drives
    watched = Watched(browser, serve(model, *runs))
    page = watched.page
    page.wait_for_selector(f"{MAP} >> .heatmaplayer", state="attached", timeout=PATIENCE)
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280
    notice, dots = brushed(watched)
    assert int(re.match(r"\d+", notice).group()) == dots > 0
    page.keyboard.press("c")
    page.wait_for_selector("text=Quadratic drag is missing", timeout=PATIENCE)
    before, cells = watched.wait_for_bars(1)[0], watched.mean_of_map()
    page.click(".candidate.open >> text=Add")
    after = watched.wait_for_bars(2)
    assert after[0] == before
    assert after[1] < 0.2 * before
    page.wait_for_selector("text=Nothing more is missing", timeout=PATIENCE)
    assert watched.mean_of_map() < 0.5 * cells
    page.click("text=Undo")
    assert watched.wait_for_bars(1) == [before]
    page.wait_for_selector("text=Quadratic drag is missing", timeout=PATIENCE)
    watched.close()


def test_everything_by_keyboard_and_saved(browser, serve, drives, short_drive, tmp_path):
    watched = Watched(browser, serve(drives[0], short_drive))
    page = watched.page
    page.wait_for_selector(".candidate", timeout=PATIENCE)
    best = "document.querySelector('.candidate .name')?.innerText"
    first = page.locator(".candidate .name").first.inner_text()
    page.keyboard.press("x")
    page.wait_for_function(f"![undefined, '{first}'].includes({best})", polling=POLLING, timeout=PATIENCE)
    page.keyboard.press("u")
    page.wait_for_function(f"{best} === '{first}'", polling=POLLING, timeout=PATIENCE)
    page.keyboard.press("m")
    page.wait_for_selector("text=/windows: error/", timeout=PATIENCE)
    page.keyboard.press("a")
    watched.wait_for_bars(2)
    page.keyboard.press("s")
    page.wait_for_selector("text=/(Written|Saved): .*model.toml/", timeout=PATIENCE)
    assert "quadratic_drag" in (tmp_path / "out" / "model.toml").read_text(encoding="utf-8")
    page.keyboard.press("?")
    page.wait_for_selector("text=add the open candidate", timeout=PATIENCE)
    page.keyboard.press("Escape")
    page.wait_for_selector(".q-dialog", state="detached", timeout=PATIENCE)  # it keeps the focus until it is gone
    reached = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.add(
            page.evaluate("document.activeElement.getAttribute('aria-label') ?? document.activeElement.innerText")
        )
    for name in ("variable across", "start of the prediction", "select the cell of the map with the largest error"):
        assert name in reached, reached
    watched.close()


def test_a_foreign_log_is_mapped_in_the_page(browser, serve, drives, tmp_path):
    model, runs = drives
    text = runs[0].read_text(encoding="utf-8").replace("t,x,y,yaw,speed,", "time,pos_x,pos_y,heading,velocity,", 1)
    foreign = tmp_path / "foreign.csv"
    foreign.write_text(text, encoding="utf-8")
    watched = Watched(browser, serve(model, foreign))
    page = watched.page
    page.wait_for_selector("text=/800 rows in 1 stretch/", timeout=PATIENCE)
    page.wait_for_selector("#verdict >> text=column 't' is missing", timeout=PATIENCE)
    assert page.locator("#verdict").inner_text().count("column 't' is missing") == 1
    page.wait_for_selector(".preview >> text=speed [m/s]", timeout=PATIENCE)
    page.locator(".q-dialog").get_by_role("button", name="Open", exact=True).click()
    page.wait_for_selector(f"{MAP} >> .heatmaplayer", state="attached", timeout=PATIENCE)
    watched.close()


def test_the_real_car(browser, serve, data_folder):
    logs = sorted(Path(data_folder, "dart_rc_car").glob("91*/*.csv"))
    if not logs:
        pytest.skip(f"no car logs in {data_folder}")
    watched = Watched(browser, serve("dart_car", *logs[:2], "--columns", "dart_car_columns"))
    page = watched.page
    page.wait_for_selector(f"{MAP} >> .heatmaplayer", state="attached", timeout=PATIENCE)
    before = watched.wait_for_bars(2)
    assert before[1] < before[0]
    page.wait_for_selector(".candidate", timeout=PATIENCE)
    page.click(".candidate.open >> text=Add")
    after = watched.wait_for_bars(3)
    assert after[2] < 0.9 * after[1]
    page.click("text=Undo")
    assert watched.wait_for_bars(2) == before
    watched.close()


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
    retained = {path.name[4:]: path.read_text(encoding="utf-8") for path in (tmp_path / "out" / "uploads").iterdir()}
    assert retained == {path.name: path.read_text(encoding="utf-8") for path in runs}
    page.locator(".q-dialog").get_by_role("button", name="Open", exact=True).click()  # a path may say 'open' too
    page.wait_for_function(ONE_BAR, polling=POLLING, timeout=PATIENCE)
    assert "2 recordings, 80 s" in page.locator(".what").inner_text()
    assert page.complaints == []
    page.close()


def test_files_dropped_next_to_the_upload_box_do_not_replace_the_page(browser, serve, drives, tmp_path):
    model, runs = drives
    page = opened(browser, serve(model, runs[0]))
    page.wait_for_function(ONE_BAR, polling=POLLING, timeout=PATIENCE)
    dragged(page, "main", (runs[1].name, runs[1].read_text(encoding="utf-8")))
    page.wait_for_selector("text=/Uploaded: drive_2.csv/", timeout=PATIENCE)
    assert str(tmp_path / "out" / "uploads" / "001_drive_2.csv") in page.input_value(".q-dialog textarea")
    dragged(page, ".dialog-title", ("notes.txt", "no recording"))
    page.wait_for_selector("text=/Not uploaded: wanted recordings .*csv/", timeout=PATIENCE)
    assert len(list((tmp_path / "out" / "uploads").iterdir())) == 1
    assert page.complaints == []
    page.close()
