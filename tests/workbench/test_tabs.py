"""Tabs that come and go: what happens in one does not disturb the others."""

from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui")
from nicegui import Client, ui

from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench import live_page, page
from safedpa_services.workbench.bench import Bench
from safedpa_services.workbench.recordings import InputSelection
from safedpa_services.workbench.rerun_view import RerunViewerServer


def test_an_error_in_one_tab_is_kept_and_the_others_hear(tmp_path, caplog):
    bench, heard = Bench(InputSelection(), tmp_path), []

    def raises(news):
        raise RuntimeError(f"planted at {news}")

    bench.listen("first", raises)
    bench.listen("second", heard.append)
    bench.cancel()
    assert heard == ["busy"]
    assert "planted at busy" in caplog.text


def _opened(built, module, monkeypatch, finished, *, leaves):
    """A tab that was built and begins; where it leaves, the browser goes while it is asked for its taste."""

    async def begun():
        client = Client(ui.page("/"))

        async def asked():
            if leaves:
                client.delete()
            return False

        monkeypatch.setattr(module, "prefers_dark", asked)
        with client:
            made = built()
            client.on_delete(made.close)
            await made.begin()
        return client

    return finished(begun())


class Attended(Bench):
    """Knows who listens."""

    def __init__(self, *about):
        super().__init__(*about)
        self.listeners = []

    def listen(self, tab, heard):
        super().listen(tab, heard)
        self.listeners.append(tab)

    def leave(self, tab):
        super().leave(tab)
        self.listeners = [listener for listener in self.listeners if listener is not tab]


def test_a_tab_that_went_while_it_was_asked_does_not_begin_to_listen(tmp_path, monkeypatch, finished):
    bench, heard = Attended(InputSelection(), tmp_path), []

    def built():
        return page.WorkbenchPage(bench, RerunViewerServer(), FileStore.of((), ()))

    _opened(built, page, monkeypatch, finished, leaves=True)
    bench.listen("another", heard.append)
    bench.cancel()
    assert bench.listeners == ["another"]
    assert heard == ["busy"]
    client = _opened(built, page, monkeypatch, finished, leaves=False)
    assert len(bench.listeners) == 2, "one that stays does listen"
    client.delete()
    assert bench.listeners == ["another"]


@pytest.mark.parametrize("leaves", [True, False])
def test_a_live_tab_that_went_shows_nothing(leaves, monkeypatch, finished):
    link, shown = SimpleNamespace(untold=set()), []
    monkeypatch.setattr(live_page.LivePage, "show", lambda made: shown.extend([made]))
    _opened(lambda: live_page.LivePage(link), live_page, monkeypatch, finished, leaves=leaves)
    assert len(shown) == len(link.untold) == (0 if leaves else 1)
