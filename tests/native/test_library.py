"""The cache of compiled kernels: private, checked before loading, safe for parallel processes; otherwise a reason."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest

from safedpa.native import NoKernelError
from safedpa.native.library import cache_folder, later, load, recall, remember
from safedpa.native.steps import rows_source
from safedpa.robots.car import shipped_rows
from safedpa.safety.barriers.equation import tape_of

if shutil.which("cc") is None:
    pytest.skip("no C compiler", allow_module_level=True)

SOURCE = "double twice(double x) { return 2.0 * x; }\n"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    return cache_folder()


def test_a_kernel_is_compiled_once_into_a_private_folder(folder: Path) -> None:
    assert load(SOURCE) is load(SOURCE)
    [file] = folder.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert file.stat().st_mode & 0o077 == 0


def spoilt(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1] + b"x")


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:100])


def exchanged(file: Path) -> None:
    """A complete library of other contents under the name of this one."""
    file.write_bytes(file.read_bytes() + b"\0")


@pytest.mark.parametrize("damage", [spoilt, cut, exchanged])
def test_a_file_with_another_digest_is_compiled_again_instead_of_loaded(
    folder: Path, damage: Callable[[Path], None]
) -> None:
    source = f"{SOURCE}/* {damage.__name__} */\n"
    code = f"from safedpa.native.library import load; load({source!r})"
    subprocess.run([sys.executable, "-c", code], check=True)
    [file] = folder.iterdir()
    right = file.read_bytes()
    damage(file)
    load(source)
    assert [path.read_bytes() for path in folder.iterdir()] == [right]


def test_a_text_is_recalled_until_its_file_is_changed(folder: Path) -> None:
    assert recall("key") is None
    remember("key", "what was made")
    assert recall("key") == "what was made"
    [file] = folder.iterdir()
    assert file.stat().st_mode & 0o077 == 0
    spoilt(file)
    assert recall("key") is None
    assert not any(folder.iterdir())


def test_rows_from_the_cache_are_those_that_were_translated(folder: Path) -> None:
    for pattern in shipped_rows.patterns():
        translated, recalled = (rows_source(tape_of(pattern, shipped_rows.STATES)) for _ in range(2))
        assert recalled == translated
    assert len(list(folder.glob("*.json"))) == len(set(shipped_rows.patterns()))


def test_a_text_in_a_folder_that_others_may_write_is_not_recalled(folder: Path) -> None:
    remember("key", "what was made")
    folder.chmod(0o777)
    assert recall("key") is None


def open_to_all(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.chmod(0o777)


def open_above(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.parent.chmod(0o777)


def link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir(parents=True)
    folder.symlink_to(folder.parent / "elsewhere")


def owned_by_another(folder: Path) -> None:
    folder.mkdir(parents=True)
    if os.geteuid() != 0:
        pytest.skip("only root may give a folder away")
    os.chown(folder, 12345, -1)


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [(open_to_all, "chmod go-w"), (open_above, "chmod go-w"), (link, "a link"), (owned_by_another, "user 12345")],
)
def test_a_folder_that_others_may_write_is_refused(folder: Path, prepare: Callable[[Path], None], reason: str) -> None:
    prepare(folder)
    with pytest.raises(NoKernelError, match=reason):
        load(SOURCE)
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("variable", "value", "reason"),
    [("PATH", "", "no C compiler was found"), ("SAFEDPA_COMPILE", "0", "forbids"), ("CC", "false", "failed")],
)
def test_the_reason_is_one_line(monkeypatch: pytest.MonkeyPatch, variable: str, value: str, reason: str) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv(variable, value)
    with pytest.raises(NoKernelError, match=reason) as caught:
        load(SOURCE)
    assert "\n" not in str(caught.value)


@pytest.mark.long
def test_processes_may_compile_the_same_source_at_the_same_time(folder: Path) -> None:
    code = f"from safedpa.native.library import load; load({SOURCE!r})"
    started = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(4)]
    assert [process.wait() for process in started] == [0] * 4
    assert len(list(folder.iterdir())) == 1


def test_a_task_that_fails_does_not_keep_those_after_it_waiting(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise MemoryError("no memory for a compiler")

    done = Event()
    later(fail)
    later(done.set)
    assert done.wait(20.0)
    assert "compiling failed" in caplog.text


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everywhere")
def test_a_folder_that_cannot_be_read_holds_no_text(folder: Path) -> None:
    remember("key", "what was made")
    folder.chmod(0o000)
    try:
        assert recall("key") is None
    finally:
        folder.chmod(0o700)


def test_a_file_in_place_of_the_folder_holds_no_text(folder: Path) -> None:
    folder.parent.mkdir(parents=True)
    folder.write_text("no folder")
    remember("key", "what was made")
    assert recall("key") is None
