"""Draws the diagrams of the pages, which are mermaid text, as pictures: the site shows them without a script.

    python docs/draw_diagrams.py        # draws those that are missing, into docs/pictures; needs Chromium

A picture bears the hash of its text, so a diagram that was changed has none until this is run again; a test says so.
mermaid is the one that NiceGUI brings.
"""

from __future__ import annotations

import functools
import hashlib
import http.server
import importlib.util
import re
import threading
from pathlib import Path

PAGES = Path(__file__).parent
FENCE = re.compile(r"```mermaid\n(.*?)```", re.DOTALL)
SCRIPT = """async (text) => {
  const {mermaid} = await import('/index.js');
  mermaid.initialize({startOnLoad: false, theme: 'neutral', htmlLabels: false, flowchart: {htmlLabels: false}});
  return (await mermaid.render('drawn', text)).svg;
}"""


def picture_of(text: str) -> str:
    """Name of the picture of a diagram, below docs/pictures."""
    return f"diagram-{hashlib.sha256(text.strip().encode()).hexdigest()[:12]}.svg"


def diagrams() -> dict[str, str]:
    """Texts of all diagrams, by the name of their picture."""
    found = [text for page in sorted(PAGES.rglob("*.md")) for text in FENCE.findall(page.read_text(encoding="utf-8"))]
    return {picture_of(text): text for text in found}


def draw() -> None:
    """Draws what is missing and deletes what nothing shows any more."""
    folder, wanted = PAGES / "pictures", diagrams()
    for path in folder.glob("diagram-*.svg"):
        if path.name not in wanted:
            path.unlink()
    missing = {name: text for name, text in wanted.items() if not (folder / name).exists()}
    if missing:
        for name, svg in _drawn(missing).items():
            (folder / name).write_text(svg + "\n", encoding="utf-8")


def _drawn(texts: dict[str, str]) -> dict[str, str]:
    from playwright.sync_api import sync_playwright

    from safedpa_services.workbench.screenshots import find_browser

    nicegui = importlib.util.find_spec("nicegui")
    assert nicegui is not None
    assert nicegui.origin is not None
    brought = Path(nicegui.origin).parent / "elements" / "mermaid" / "dist"
    serve = functools.partial(_Quiet, directory=str(brought))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as server, sync_playwright() as play:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = play.chromium.launch(executable_path=find_browser(), args=["--no-sandbox"])
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
        drawn = {name: str(page.evaluate(SCRIPT, text)) for name, text in texts.items()}
        drawn = {name: svg.replace('style="', 'style="background: white; ', 1) for name, svg in drawn.items()}
        browser.close()
        server.shutdown()
    return drawn


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *_arguments: object) -> None:  # noqa: A002  its name in the base class
        del format


if __name__ == "__main__":
    draw()
