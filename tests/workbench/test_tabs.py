"""Tabs that come and go: what happens in one does not disturb the others."""

from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui")
from nicegui import Client, ui

from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench import page
from safedpa_services.workbench import tab as tab_module
from safedpa_services.workbench.live import page as live_page
from safedpa_services.workbench.rerun_viewer import RerunViewerServer
from safedpa_services.workbench.session.controller import SessionController
from safedpa_services.workbench.session.inputs import InputSelection


def test_an_error_in_one_tab_is_kept_and_the_others_hear(tmp_path, caplog):
    controller, heard = SessionController(InputSelection(), tmp_path), []

    def raises(event):
        raise RuntimeError(f"planted at {event}")

    controller.add_listener("first", raises)
    controller.add_listener("second", heard.append)
    controller.cancel()
    assert heard == ["busy"]
    assert "planted at busy" in caplog.text


def _open(build, monkeypatch, finished, *, leaves):
    """Builds a tab and begins it; with ``leaves`` its browser closes while it is asked for its colour scheme."""

    async def story():
        client = Client(ui.page("/"))

        async def asked():
            if leaves:
                client.delete()
            return False

        monkeypatch.setattr(tab_module, "prefers_dark_mode", asked)
        with client:
            tab = build()
            client.on_delete(tab.close)
            await tab.begin()
        return client

    return finished(story())


class Attended(SessionController):
    """Records its listeners."""

    def __init__(self, *about):
        super().__init__(*about)
        self.listeners = []

    def add_listener(self, tab, on_event):
        super().add_listener(tab, on_event)
        self.listeners.append(tab)

    def remove_listener(self, tab):
        super().remove_listener(tab)
        self.listeners = [listener for listener in self.listeners if listener is not tab]


def test_a_tab_that_went_while_it_was_asked_does_not_begin_to_listen(tmp_path, monkeypatch, finished):
    controller, heard = Attended(InputSelection(), tmp_path), []

    def build():
        return page.WorkbenchPage(controller, RerunViewerServer(), FileStore.of((), ()))

    _open(build, monkeypatch, finished, leaves=True)
    controller.add_listener("another", heard.append)
    controller.cancel()
    assert controller.listeners == ["another"]
    assert heard == ["busy"]
    client = _open(build, monkeypatch, finished, leaves=False)
    assert len(controller.listeners) == 2, "one that stays does listen"
    client.delete()
    assert controller.listeners == ["another"]


@pytest.mark.parametrize("leaves", [True, False])
def test_a_live_tab_that_went_shows_nothing(leaves, monkeypatch, finished):
    link, shown = SimpleNamespace(pages_to_notify=set()), []
    monkeypatch.setattr(live_page.LivePage, "show", lambda made: shown.extend([made]))
    _open(lambda: live_page.LivePage(link), monkeypatch, finished, leaves=leaves)
    assert len(shown) == len(link.pages_to_notify) == (0 if leaves else 1)
