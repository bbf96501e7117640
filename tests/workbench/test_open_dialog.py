"""The dialog that opens recordings: which column map it begins with, uploads, names out of files; without a browser."""

import asyncio
from pathlib import Path

import pytest

pytest.importorskip("nicegui")
from nicegui import ui
from nicegui.elements.upload_files import SmallFileUpload
from tests.workbench.tab import Tab

from safedpa.records import McapRecorder
from safedpa.records.readers.preview import RowPreview
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench.open_dialog.dialog import ColumnsTable, OpenDialog
from safedpa_services.workbench.session.inputs import InputSelection

NATIVE, GUESSED, DART = "native names", "guessed from the names", "dart_car_columns"
OWN = "t,x,y,yaw,speed,target_speed,steer"
STRANGE = "time,first,second"
OF_DART = "elapsed time sensors,vicon time,vicon x,vicon y,vicon yaw,throttle,steering"
BUS = "needs no column map"


def opened(folder):
    return OpenDialog(lambda _: asyncio.sleep(0), folder, FileStore.of((), (folder,)))


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
    header, chosen, map_then, read_as, tmp_path, finished
):
    path = tmp_path / ("run.mcap" if header is None else "run.csv")
    if header is None:
        with McapRecorder(path):
            """It has no columns."""
    else:
        path.write_text(f"{header}\n" + "0," * header.count(",") + "0\n", encoding="utf-8")

    async def story():
        with Tab() as tab:
            dialog = opened(tmp_path)
            (columns,) = tab.all(ui.select)
            columns.value = chosen
            await dialog.show(InputSelection("car", (str(path),)))
            sources = [select.value for select in tab.all(ui.select)[1::2]]
            return columns.value, sources, any(BUS in line for line in tab.lines)

    found, sources, reported = finished(story())
    assert found == map_then
    assert sources[: len(read_as)] == read_as
    assert bool(sources) is bool(read_as)
    assert reported is (header is None)


@pytest.mark.parametrize(("model", "named"), [("", True), ("car", False), ("", False)])
def test_without_a_model_or_a_recording_no_columns_are_shown(model, named, tmp_path, finished):
    path = tmp_path / "run.csv"
    path.write_text(OF_DART, encoding="utf-8")

    async def story():
        with Tab() as tab:
            await opened(tmp_path).show(InputSelection(model, (str(path),) if named else ()))
            return [select.value for select in tab.all(ui.select)]

    assert finished(story()) == [NATIVE]


@pytest.mark.parametrize("name", ["/\x1b[2J\u202eodom:x", "/<script>alert(1)</script>:x", "/" + "a" * 5000])
def test_a_topic_of_a_bag_is_offered_as_text_and_kept_as_it_is(name, plain, finished):
    from safedpa.records.column_map.form import guess_columns

    async def story():
        with Tab() as tab:
            ColumnsTable(lambda: None).show(guess_columns(plain.system, [name]), RowPreview((name,), ()))
            return dict(tab.all(ui.select)[0].options)

    options = finished(story())
    assert name in options
    assert options[name].isprintable()
    assert len(options[name]) < 300


class Sent(SmallFileUpload):
    """A file whose last byte comes when those ``after`` which it comes are there."""

    def __init__(self, name, text, *after):
        super().__init__(name, "text/csv", text.encode())
        self._after, self.there = after, asyncio.Event()

    async def save(self, path):
        for other in self._after:
            await other.there.wait()
        await super().save(path)
        self.there.set()


def two_of_one_name():
    return [Sent("drive.csv", "first"), Sent("drive.csv", "second")]


def the_longer_one_comes_last():
    short = Sent("short.csv", "second")
    return [Sent("long.csv", "first", short), short]


@pytest.mark.parametrize(
    ("sent", "names"),
    [
        (two_of_one_name, ["001_drive.csv", "002_drive.csv"]),
        (the_longer_one_comes_last, ["001_long.csv", "002_short.csv"]),
    ],
)
@pytest.mark.parametrize("older", [None, "002_drive.csv"])
def test_uploads_that_come_together_are_all_kept_and_named_and_replace_no_older_file(
    sent, names, older, tmp_path, finished
):
    uploads = tmp_path / "uploads"
    if older is not None:
        uploads.mkdir()
        (uploads / older).write_text("older", encoding="utf-8")

    async def story():
        with Tab() as tab:
            opened(tmp_path)
            (upload,), (paths,) = tab.all(ui.upload), tab.all(ui.textarea)
            files = sent()
            await upload.handle_uploads(files)
            await tab.until(lambda: len((paths.value or "").splitlines()) == len(files))
            return " ".join(tab.lines), [Path(line) for line in paths.value.splitlines()], [one.name for one in files]

    notice, paths, given = finished(story())
    texts = {path.name: path.read_text(encoding="utf-8") for path in uploads.iterdir()}
    assert texts.pop(older, "older") == "older"
    assert sorted(texts) == sorted(path.name for path in paths)
    assert sorted(texts.values()) == ["first", "second"]
    if older is None:
        assert sorted(texts) == names
        assert [texts[name] for name in names] == ["first", "second"]
    assert all(f"Uploaded: {name}" in notice for name in given)
    assert all(path.name in notice for path in paths)
