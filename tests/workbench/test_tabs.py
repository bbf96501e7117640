"""Tabs that come and go: what happens in one is nothing to the others."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui")
from nicegui import Client, ui

from safedpa_services.web.shelf import Shelf
from safedpa_services.workbench import live_page, page
from safedpa_services.workbench.bench import Bench
from safedpa_services.workbench.recordings import Choice
from safedpa_services.workbench.rerun_view import RerunDoor


def test_an_error_in_one_tab_is_kept_and_the_others_hear(tmp_path, caplog):
    bench, heard = Bench(Choice(), tmp_path), []

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

        monkeypatch.setattr(module, "wishes_dark", asked)
        with client:
            made = built()
            client.on_delete(made.close)
            await made.begin()
        return client

    return finished(begun())


def test_a_tab_that_went_while_it_was_asked_does_not_begin_to_listen(tmp_path, monkeypatch, finished):
    bench, heard = Bench(Choice(), tmp_path), []

    def built():
        return page.Page(bench, RerunDoor(), Shelf.of((), ()))

    _opened(built, page, monkeypatch, finished, leaves=True)
    bench.listen("another", heard.append)
    bench.cancel()
    assert list(bench._tabs) == ["another"]
    assert heard == ["busy"]
    client = _opened(built, page, monkeypatch, finished, leaves=False)
    assert len(bench._tabs) == 2, "one that stays does listen"
    client.delete()
    assert list(bench._tabs) == ["another"]


@pytest.mark.parametrize("leaves", [True, False])
def test_a_live_tab_that_went_shows_nothing(leaves, monkeypatch, finished):
    link, shown = SimpleNamespace(untold=set()), []
    monkeypatch.setattr(live_page.LivePage, "show", lambda made: shown.extend([made]))
    monkeypatch.setattr(live_page.LivePage, "_build", lambda made: setattr(made, "_dark", ui.dark_mode(None)))
    _opened(lambda: live_page.LivePage(link), live_page, monkeypatch, finished, leaves=leaves)
    assert len(shown) == len(link.untold) == (0 if leaves else 1)
