"""Every page as a person sees it: phone to wide screen, light and dark.

Nothing is wider than the screen, cut off, or over another text. Who wants to look names a folder for the
pictures in SAFEDPA_SCREENS. And axe-core finds nothing serious. All look at the same servers: nothing is decided here.
"""

import hashlib
import os
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from safedpa_services.command_line.group import safedpa

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.browser, pytest.mark.processes]

PATIENCE = 240_000
SIZES = ((390, 844), (1280, 800), (1400, 900), (1920, 1080))
SCHEMES = {"light": SIZES, "dark": (SIZES[0], SIZES[-1])}
"""Sizes at which each is looked at: what is where does not depend on colours, contrast does not on the size."""
AXE = "axe-core@4.10.3"
SHA256 = "880970c081707360e64f34cea25ff91892f5bc95675b0776925b9709dd8a68bb"
"""Of axe.min.js in that package."""
RUN = """([part, off]) => axe.run(part, {resultTypes: ['violations'],
  rules: Object.fromEntries(off.map((name) => [name, {enabled: false}]))}).then((found) => found.violations
  .filter((item) => ['serious', 'critical'].includes(item.impact))
  .map((item) => `${item.id}: ${item.nodes.map((node) => node.html.slice(0, 120)).join(' ')}`))"""
WRONG = (Path(__file__).parent / "screens.js").read_text(encoding="utf-8")

SETTLE = """([quiet]) => {
  document.documentElement.dataset.settled = 'no';
  let since = performance.now();
  const began = since;
  const observer = new MutationObserver(() => { since = performance.now(); });
  observer.observe(document.body, {childList: true, subtree: true, characterData: true, attributes: true});
  const moves = () => document.getAnimations().some((one) =>
    one.playState === 'running' && one.effect?.getComputedTiming().endTime !== Infinity);
  const frames = (then) => {
    let due = () => { due = () => {}; then(); };
    requestAnimationFrame(() => requestAnimationFrame(() => due()));
    setTimeout(() => due(), quiet);
  };
  const look = () => {
    if (moves()) since = performance.now();
    if (performance.now() - since < quiet && performance.now() - began < 10 * quiet) return setTimeout(look, 20);
    observer.disconnect();
    frames(() => { document.documentElement.dataset.settled = 'yes'; });
  };
  frames(() => { since = performance.now(); look(); });
}"""
"""Begins to wait until nothing of the page has changed or moved for so many ms; a live page never rests for long, which
is why ten times as much is the most. Figures are redrawn 100 ms after the window has another size. A browser that
has nothing to draw, or too much, may owe a frame for ever: then time has to do."""
QUIET = 300


@pytest.fixture(scope="module")
def pictures():
    """The folder for pictures, if one is named: they take as long as all that is asserted."""
    named = os.environ.get("SAFEDPA_SCREENS")
    if not named:
        return None
    folder = Path(named)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def reports(short_drives, tmp_path_factory):
    """The reports of a diagnosis and of a comparison, on disk."""
    model, runs = short_drives
    out, files = tmp_path_factory.mktemp("reports"), list(map(str, runs))
    assert safedpa.run(["compare", str(model), *files, "--out", str(out / "compared")]) == 0
    assert safedpa.run(["diagnose", str(model), *files, "--out", str(out / "found")]) == 0
    return {"compare": out / "compared" / "compare.html", "diagnose": out / "found" / "report.html"}


@pytest.fixture(scope="module")
def axe(tmp_path_factory):
    """The script, or nothing where it cannot be fetched."""
    npm = shutil.which("npm")
    if npm is None:
        return None
    folder = tmp_path_factory.mktemp("axe")
    phrase = [npm, "pack", AXE, "--silent", "--fetch-retries=1", "--fetch-timeout=10000"]
    try:
        done = subprocess.run(phrase, cwd=folder, capture_output=True, timeout=40, check=False)
    except subprocess.TimeoutExpired:
        return None
    packed = next(folder.glob("axe-core-*.tgz"), None)
    if done.returncode != 0 or packed is None:
        return None
    with tarfile.open(packed) as files:
        member = files.extractfile("package/axe.min.js")
        script = b"" if member is None else member.read()
    assert hashlib.sha256(script).hexdigest() == SHA256, "another script than the one that was pinned"
    return script.decode("utf-8")


def settle(page):
    """Waits, and not for ever, whatever becomes of the page meanwhile."""
    page.evaluate(SETTLE, [QUIET])
    page.wait_for_selector("html[data-settled=yes]", state="attached", timeout=PATIENCE)


class Looks:
    """What is wrong with a page at each width and in each scheme, after each step, and what axe-core finds there.

    One page, loaded once for each scheme, is looked at by both; a picture of each, where pictures are wanted.
    """

    def __init__(self, browser, pictures, axe):
        self.wrong, self.barriers = [], None if axe is None else []
        self._browser, self._pictures, self._axe = browser, pictures, axe

    def at(self, address, ready, name, steps=(("", lambda _page: None),)):
        context = self._browser.new_context()
        page = context.new_page()
        for scheme, sizes in SCHEMES.items():
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size({"width": SIZES[1][0], "height": SIZES[1][1]})
            page.goto(address)
            page.wait_for_selector(ready, timeout=PATIENCE)
            if self._axe is not None:
                page.evaluate(self._axe)
            for step, act in steps:
                act(page)
                for width, height in sizes:
                    page.set_viewport_size({"width": width, "height": height})
                    settle(page)
                    title = f"{name}{step}-{scheme}-{width}"
                    if self._pictures is not None:
                        page.screenshot(path=self._pictures / f"{title}.png", full_page=not step)
                    self.wrong += [f"{title}: {line}" for line in page.evaluate(WRONG, [width])]
                    if self._axe is not None:
                        self.barriers += [f"{title}: {line}" for line in _barriers(page, step, width)]
        context.close()
        return self


def _barriers(page, step, width):
    """Of the narrowest and of the widest page; of a dialog, on the widest."""
    if step:
        # axe takes what lies behind a dialog for the background of its letters; WRONG looks at these
        return page.evaluate(RUN, [".q-dialog", ["color-contrast"]]) if width == SIZES[-1][0] else []
    return page.evaluate(RUN, ["html", []]) if width in (SIZES[0][0], SIZES[-1][0]) else []


def dialog(key, sign):
    """Opens one."""

    def act(page):
        page.keyboard.press("Escape")
        page.wait_for_selector(".q-dialog", state="detached", timeout=PATIENCE)
        page.keyboard.press(key)
        page.wait_for_selector(sign, timeout=PATIENCE)

    return act


@pytest.fixture(scope="module")
def look_of_workbench(browser, shown_workbench, pictures, axe):
    steps = (("", lambda _page: None), ("-open", dialog("o", ".preview table")), ("-keys", dialog("?", "dl.keys")))
    return Looks(browser, pictures, axe).at(shown_workbench, ".candidate", "workbench", steps)


@pytest.fixture(scope="module")
def look_of_live(browser, shown_live, pictures, axe):
    return Looks(browser, pictures, axe).at(shown_live, ".candidate", "live")


def test_the_workbench(look_of_workbench):
    assert look_of_workbench.wrong == []


def test_the_live_page(look_of_live):
    assert look_of_live.wrong == []


@pytest.mark.parametrize("name", ["compare", "diagnose"])
def test_the_reports(browser, reports, name, pictures):
    assert Looks(browser, pictures, None).at(reports[name].as_uri(), ".main-svg", name).wrong == []


@pytest.mark.parametrize("name", ["workbench", "live"])
def test_axe_finds_nothing(request, name):
    found = request.getfixturevalue(f"look_of_{name}").barriers
    if found is None:
        pytest.skip(f"{AXE} cannot be fetched by npm")
    assert found == []
