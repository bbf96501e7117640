"""A small fleet, really diagnosed: groups, files, the command, the page in a browser.

All tests that need it are in this file, so that one process diagnoses it once.
"""

import json
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from safedpa.fleet.one_robot import Options, Task, diagnose_robot, options_digest
from safedpa.fleet.robots import RobotLogs
from safedpa_services.command_line.group import safedpa


@pytest.mark.long
def test_every_robot_is_in_its_group(small_fleet):
    result = small_fleet.result
    assert (result["hidden"]["hits"], result["hidden"]["of"]) == (3, 3)
    assert (result["healthy"]["hits"], result["healthy"]["of"]) == (2, 2)
    assert result["groups_right"] == result["groups_hidden"] == 3
    assert (result["groups_false"], result["wrong"]) == (0, [])


@pytest.mark.long
def test_every_robot_has_its_files_and_they_are_small(small_fleet):
    names = sorted(path.name for path in (small_fleet.out / "robots").iterdir())
    assert names == [f"car_{i:03d}" for i in range(5)]
    for name in names:
        folder = small_fleet.out / "robots" / name
        assert {path.name for path in folder.iterdir()} == {"model.toml", "report.html", "report.json", "result.json"}
        page = (folder / "report.html").read_text(encoding="utf-8")
        assert '<script src="../../plotly.min.js"></script>' in page
        assert len(page) < 1_000_000
    assert (small_fleet.out / "plotly.min.js").stat().st_size > 1_000_000


@pytest.mark.long
def test_the_page_holds_every_group_and_robot(small_fleet):
    page = (small_fleet.out / "fleet.html").read_text(encoding="utf-8")
    for text in ("steering_offset", "constant_force", "rolling_resistance", "nothing is missing"):
        assert text in page
    for index in range(5):
        assert f'href="robots/car_{index:03d}/report.html"' in page
    assert "http://" not in page.split("<script>")[0]


@pytest.mark.long
def test_diagnosed_robots_are_not_diagnosed_again_and_the_document_is_the_same(small_fleet, capsys):
    before = json.loads((small_fleet.out / "fleet.json").read_text(encoding="utf-8"))
    assert safedpa.run(["diagnose", *small_fleet.arguments, "--jobs", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["diagnosed_now"], document["groups"]) == (0, before["groups"])
    assert document["robots"] == before["robots"]


@pytest.mark.long
def test_the_command_prints_which_robots_lack_what(small_fleet, capsys):
    assert safedpa.run(["diagnose", *small_fleet.arguments, "--jobs", "1"]) == 0
    reported = capsys.readouterr().out
    assert reported.lstrip().startswith("5 robots: 1 lacks")
    assert "in 2 nothing is missing" in reported
    assert "fleet.html" in reported


@pytest.mark.long
def test_too_short_data_are_named(small_fleet, tmp_path):
    own = tmp_path / "recordings" / "car_000"
    shutil.copytree(small_fleet.folder / "recordings" / "car_000", own)
    files, options = tuple(sorted(own.glob("*.csv"))), Options(str(small_fleet.folder / "model.toml"))
    for path in files:
        path.write_text("".join(path.read_text(encoding="utf-8").splitlines(keepends=True)[:40]), encoding="utf-8")
    result = diagnose_robot(Task(RobotLogs("car_000", files), options, options_digest(options)))
    assert result.document["status"] == "no_verdict"
    assert "too little" in result.document["reason"]


@pytest.mark.long
def test_a_fleet_without_a_usable_recording_is_bad_input(small_fleet, tmp_path, capsys):
    (tmp_path / "recordings" / "a").mkdir(parents=True)
    (tmp_path / "recordings" / "a" / "run.csv").write_text("t,x\n1,2\n", encoding="utf-8")
    arguments = [str(small_fleet.folder / "model.toml"), "--fleet", str(tmp_path / "recordings"), "--jobs", "1"]
    assert safedpa.run(["diagnose", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert "no robot's recordings can be used" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "fleet.json").read_text(encoding="utf-8"))["counts"]["unreadable"] == 1


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["car"], "--fleet FOLDER"), (["car", "--jobs", "2", "a.csv"], "--jobs: got no fleet"),
        (["car", "--again", "a.csv"], "--again: got no fleet"), (["car", "--fleet", "nowhere"], "is not a folder"),
        (["car", "--fleet", ".", "a.csv", "--out", "out"], "leave one of them out"),
        (["car", "--fleet", ".", "--out", "."], "choose another folder for the results"),
    ],
)  # fmt: skip
def test_options_that_make_no_fleet_are_refused_in_one_line(arguments, reported, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert safedpa.run(["diagnose", *arguments]) == 2
    shown = capsys.readouterr().err
    assert reported in shown
    assert shown.count("\n") == 1


PATIENCE = 240_000
"""ms; on a busy machine a page takes its time."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    with playwright.sync_playwright() as play:
        arguments = ["--no-sandbox", "--disable-background-networking"]
        started = play.chromium.launch(executable_path=chromium, args=arguments, timeout=PATIENCE)
        yield started
        started.close()


def opened(browser: Any, path: Any) -> tuple[Any, list[str]]:
    page, notice = browser.new_page(viewport={"width": 1280, "height": 900}), []
    page.set_default_timeout(PATIENCE)
    page.on("console", lambda message: notice.append(message.text))
    page.on("pageerror", lambda error: notice.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith("file:") else notice.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_selector(".main-svg")
    return page, notice


@pytest.mark.long
@pytest.mark.slow
def test_the_page_draws_sorts_and_narrows_without_a_network(browser, small_fleet):
    page, notice = opened(browser, small_fleet.out / "fleet.html")
    assert page.locator("section.card").count() == 4
    assert page.locator("#strips .main-svg").count() > 0
    page.click("th button:has-text('after')")
    shown = page.locator("#robots tbody tr td:nth-child(5)").all_inner_texts()
    assert [float(text) for text in shown] == sorted(float(text) for text in shown)
    page.fill("#filter", "steering_offset")
    assert page.locator("#robots tbody tr:visible").count() == 1
    assert page.inner_text("#shown") == "1 of 5"
    assert notice == []
    page.close()


@pytest.mark.long
@pytest.mark.slow
def test_a_link_leads_to_the_robots_report_which_draws_with_the_shared_script(browser, small_fleet):
    page, notice = opened(browser, small_fleet.out / "fleet.html")
    page.click("#robot-car_002 a")
    page.wait_for_selector("#falling .main-svg")
    assert (page.inner_text("h1"), notice) == ("car_002", [])
    page.close()
