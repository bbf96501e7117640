"""axe-core finds nothing serious on the pages, light and dark, phone and desk; nothing is wider than the screen."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tarfile

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.browser, pytest.mark.processes]

PATIENCE = 240_000
AXE = "axe-core@4.10.3"
SHA256 = "880970c081707360e64f34cea25ff91892f5bc95675b0776925b9709dd8a68bb"
"""Of axe.min.js in that package."""
RUN = """([part, off]) => axe.run(part, {resultTypes: ['violations'],
  rules: Object.fromEntries(off.map((name) => [name, {enabled: false}]))}).then((found) => found.violations
  .filter((item) => ['serious', 'critical'].includes(item.impact))
  .map((item) => `${item.id}: ${item.nodes.map((node) => node.html.slice(0, 120)).join(' ')}`))"""
SCHEMES = ("light", "dark")
WIDTHS = (390, 1280, 1400, 1920)


@pytest.fixture(scope="session")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The script; skips where it cannot be fetched."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm, which fetches axe-core")
    folder = tmp_path_factory.mktemp("axe")
    try:
        done = subprocess.run([npm, "pack", AXE, "--silent"], cwd=folder, capture_output=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{AXE} cannot be fetched")
    packed = next(folder.glob("axe-core-*.tgz"), None)
    if done.returncode != 0 or packed is None:
        pytest.skip(f"{AXE} cannot be fetched")
    with tarfile.open(packed) as files:
        member = files.extractfile("package/axe.min.js")
        script = b"" if member is None else member.read()
    assert hashlib.sha256(script).hexdigest() == SHA256, "another script than the one that was pinned"
    return script.decode("utf-8")


def checked(browser, axe, address, scheme, more=lambda _page: None):
    context = browser.new_context(color_scheme=scheme, bypass_csp=True)
    page = context.new_page()
    page.goto(address)
    page.wait_for_selector(".candidate", timeout=PATIENCE)
    page.evaluate(axe)
    found = []
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_timeout(300)
        if width in (WIDTHS[0], WIDTHS[-1]):
            found += [f"{scheme} {width}: {line}" for line in page.evaluate(RUN, ["body", []])]
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    found += page.evaluate(RUN, ["html", []])
    found += more(page) or []
    context.close()
    return found


def test_the_workbench(browser, serve, drives, axe):
    model, runs = drives

    def dialogs(page):
        found = []
        for key, sign in (("o", ".preview table"), ("?", "dl.keys")):
            page.keyboard.press(key)
            page.wait_for_selector(sign, timeout=PATIENCE)
            page.wait_for_timeout(500)
            # axe takes what lies behind a dialog for the background of its letters; test_screens looks at these
            found += page.evaluate(RUN, [".q-dialog", ["color-contrast"]])
            page.keyboard.press("Escape")
            page.wait_for_selector(sign, state="hidden", timeout=PATIENCE)
        return found

    address = serve(model, runs[0])
    assert [line for scheme in SCHEMES for line in checked(browser, axe, address, scheme, dialogs)] == []


def test_the_live_page(browser, live, axe):
    _, address = live
    assert [line for scheme in SCHEMES for line in checked(browser, axe, address, scheme)] == []
