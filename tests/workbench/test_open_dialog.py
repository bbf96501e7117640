"""The dialog that opens recordings: which column map it begins with, uploads, names out of files; without a browser."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui")
from nicegui import ui
from tests.workbench.tab import Tab

from safedpa.records import McapRecorder
from safedpa_services.web.shelf import Shelf
from safedpa_services.workbench.file_preview import RawRows
from safedpa_services.workbench.open_dialog import ColumnsTable, OpenDialog
from safedpa_services.workbench.recordings import Choice

NATIVE, GUESSED, DART = "native names", "guessed from the names", "dart_car_columns"
OWN = "t,x,y,yaw,speed,target_speed,steer"
STRANGE = "time,east,north"
OF_DART = "elapsed time sensors,vicon time,vicon x,vicon y,vicon yaw,throttle,steering"
BUS = "needs no column map"


def opened(folder: Path) -> OpenDialog:
    return OpenDialog(lambda _: asyncio.sleep(0), folder, Shelf.of((), (folder,)))


@pytest.mark.parametrize(
    ("header", "chosen", "map_then", "read_as"),
    [
        (OWN, NATIVE, NATIVE, ["t", "x"]),
        (f"{OWN},battery", NATIVE, NATIVE, ["t", "x"]),
        (OWN, GUESSED, GUESSED, ["t", "x"]),
        (OWN, DART, DART, ["vicon time", "vicon x"]),  # a person's own choice stays
        (OF_DART, NATIVE, DART, ["vicon time", "vicon x"]),
        (OF_DART, GUESSED, GUESSED, [None, "vicon x"]),
        (OWN.removesuffix(",steer"), NATIVE, GUESSED, ["t", "x"]),
        (STRANGE, NATIVE, GUESSED, ["time", None]),
        (STRANGE, DART, DART, ["vicon time", "vicon x"]),
        (None, NATIVE, NATIVE, []),  # a recording of the bus
    ],
)
def test_a_fitting_map_is_chosen_where_the_file_lacks_native_columns_and_no_map_was_chosen(
    header: str | None, chosen: str, map_then: str, read_as: list[str | None], tmp_path: Path, finished: Any
) -> None:
    path = tmp_path / ("run.mcap" if header is None else "run.csv")
    if header is None:
        with McapRecorder(path):
            """It has no columns."""
    else:
        path.write_text(f"{header}\n" + "0," * header.count(",") + "0\n", encoding="utf-8")

    async def story() -> tuple[str, list[Any], bool]:
        with Tab() as tab:
            dialog = opened(tmp_path)
            (columns,) = tab.all(ui.select)
            columns.value = chosen
            dialog.show(Choice("car", (str(path),)))
            sources = [select.value for select in tab.all(ui.select)[1::2]]
            return columns.value, sources, any(BUS in line for line in tab.lines)

    found, sources, told = finished(story())
    assert found == map_then
    assert sources[: len(read_as)] == read_as
    assert bool(sources) is bool(read_as)
    assert told is (header is None)


@pytest.mark.parametrize(("model", "named"), [("", True), ("car", False), ("", False)])
def test_without_a_model_or_a_recording_no_columns_are_shown(
    model: str, named: bool, tmp_path: Path, finished: Any
) -> None:
    path = tmp_path / "run.csv"
    path.write_text(OF_DART, encoding="utf-8")

    async def story() -> list[Any]:
        with Tab() as tab:
            opened(tmp_path).show(Choice(model, (str(path),) if named else ()))
            return [select.value for select in tab.all(ui.select)]

    assert finished(story()) == [NATIVE]


@pytest.mark.parametrize("name", ["/\x1b[2J\u202eodom:x", "/<script>alert(1)</script>:x", "/" + "a" * 5000])
def test_a_topic_of_a_bag_is_offered_as_text_and_kept_as_it_is(name: str, plain: Any, finished: Any) -> None:
    from safedpa_services.workbench.column_form import guessed

    async def story() -> dict[str, str]:
        with Tab() as tab:
            ColumnsTable(lambda: None).show(guessed(plain.system, [name]), RawRows((name,), ()))
            return dict(tab.all(ui.select)[0].options)

    options = finished(story())
    assert name in options
    assert options[name].isprintable()
    assert len(options[name]) < 300


class Sent(ui.upload.FileUpload):
    """A file whose last byte comes when ``others`` have come."""

    def __init__(self, name: str, text: str, after: tuple[Sent, ...] = ()) -> None:
        super().__init__(name, "text/csv")
        self._text, self._after, self.there = text, after, asyncio.Event()

    async def save(self, path: str | Path) -> None:
        for other in self._after:
            await other.there.wait()
        Path(path).write_text(self._text, encoding="utf-8")
        self.there.set()

    async def read(self) -> bytes:
        return self._text.encode()

    async def text(self, encoding: str = "utf-8") -> str:
        return self._text

    async def iterate(self, *, chunk_size: int = 1) -> AsyncIterator[bytes]:  # type: ignore[override]
        yield self._text.encode()

    def size(self) -> int:
        return len(self._text)


@pytest.fixture
def kept(finished: Any, tmp_path: Path) -> Any:
    """kept(sent): texts and names of the files that were kept after ``sent()`` came together, and what is said."""

    def run(sent: Callable[[], list[Sent]]) -> tuple[list[str], list[str], str]:
        before = set(map(str, (tmp_path / "uploads").glob("*")))

        async def story() -> tuple[str, list[str]]:
            with Tab() as tab:
                opened(tmp_path)
                (upload,), (paths,) = tab.all(ui.upload), tab.all(ui.textarea)
                files = sent()
                await upload.handle_uploads(files)
                await tab.until(lambda: len((paths.value or "").splitlines()) == len(files))
                return " ".join(tab.lines), paths.value.splitlines()

        said, paths = finished(story())
        files = sorted((tmp_path / "uploads").iterdir())
        assert {str(path) for path in files} - set(paths) == before
        return [path.read_text(encoding="utf-8") for path in files], [path.name for path in files], said

    return run


def test_uploads_of_one_name_are_both_kept(kept: Any) -> None:
    texts, names, said = kept(lambda: [Sent("drive.csv", "first"), Sent("drive.csv", "second")])
    assert texts == ["first", "second"]
    assert names == ["001_drive.csv", "002_drive.csv"]
    assert all(name in said for name in names)


def test_each_upload_is_named_whichever_comes_last(kept: Any) -> None:
    def sent() -> list[Sent]:
        short = Sent("short.csv", "short")
        return [Sent("long.csv", "long", (short,)), short]

    texts, names, said = kept(sent)
    assert texts == ["long", "short"]
    assert "Uploaded: long.csv" in said
    assert "Uploaded: short.csv" in said
    assert names == ["001_long.csv", "002_short.csv"]


def test_an_upload_never_replaces_an_older_file(kept: Any, tmp_path: Path) -> None:
    (tmp_path / "uploads").mkdir()
    (tmp_path / "uploads" / "002_drive.csv").write_text("old", encoding="utf-8")
    texts, _, _ = kept(lambda: [Sent("drive.csv", "new")])
    assert texts == ["old", "new"]
