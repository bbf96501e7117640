"""Files that a browser sends side by side: each is kept, none over another, and each is named."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui")
from nicegui import Client, ui

from safedpa_services.web.shelf import Shelf
from safedpa_services.workbench.open_dialog import OpenDialog


class Sent:
    """A file whose last byte comes when ``others`` have come."""

    def __init__(self, name, text, *, after=()):
        self.name, self._text, self._after, self.there = name, text, after, asyncio.Event()

    async def save(self, path):
        for other in self._after:
            await other.there.wait()
        path.write_text(self._text, encoding="utf-8")
        self.there.set()


def kept(finished, folder, sent):
    """The text of each file that was kept, and what the dialog says, after ``sent()`` came together."""
    before = set(map(str, (folder / "uploads").glob("*")))

    async def story():
        with Client(ui.page("/")):
            dialog = OpenDialog(lambda choice: None, folder, Shelf.of((), ()))
            files = sent()
            await asyncio.wait_for(
                asyncio.gather(*(dialog._uploaded(SimpleNamespace(file=one)) for one in files)), 60.0
            )
            return dialog._taken.content, dialog._paths.value.splitlines()

    said, paths = finished(story())
    files = sorted((folder / "uploads").iterdir())
    assert {str(path) for path in files} - set(paths) == before
    return [path.read_text(encoding="utf-8") for path in files], [path.name for path in files], said


def test_files_of_one_name_are_both_kept(tmp_path, finished):
    texts, names, said = kept(finished, tmp_path, lambda: [Sent("drive.csv", "first"), Sent("drive.csv", "second")])
    assert texts == ["first", "second"]
    assert names == ["001_drive.csv", "002_drive.csv"]
    assert all(name in said for name in names)


def test_each_is_named_whichever_comes_last(tmp_path, finished):
    def sent():
        short = Sent("short.csv", "short")
        return [Sent("long.csv", "long", after=[short]), short]

    texts, names, said = kept(finished, tmp_path, sent)
    assert texts == ["long", "short"]
    assert "Uploaded: long.csv" in said
    assert "Uploaded: short.csv" in said
    assert names == ["001_long.csv", "002_short.csv"]


def test_a_file_that_was_deleted_gives_no_other_its_place(tmp_path, finished):
    (tmp_path / "uploads").mkdir()
    (tmp_path / "uploads" / "002_drive.csv").write_text("old", encoding="utf-8")
    texts, _, _ = kept(finished, tmp_path, lambda: [Sent("drive.csv", "new")])
    assert texts == ["old", "new"]
