"""The wheel's build hook. ``make test-compiled`` tests that compiled modules decide like their source."""

from __future__ import annotations

import importlib.util
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from safedpa.compiled import MODULES, compiled_modules

ROOT = Path(__file__).parents[3]


def source_of(file: str) -> Path:
    """Returns the file of a module, such as ``safedpa/compiled.py``."""
    return ROOT / ("sim" if file.startswith("safedpa_sim/") else "shared") / file


class Interface:
    """The used part of hatchling's hook, if hatchling is not installed."""

    def __init__(self, root: Path, **config: Any) -> None:
        self.root, self.config, self.notice = str(root), config, []
        self.app = types.SimpleNamespace(display_info=self.notice.append, display_warning=self.notice.append)

    def __class_getitem__(cls, item: object) -> type[Interface]:
        return cls


@pytest.fixture
def build(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    plugin = types.ModuleType("interface")
    plugin.BuildHookInterface = Interface  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "hatchling.builders.hooks.plugin.interface", plugin)
    for name in ("hatchling", "hatchling.builders", "hatchling.builders.hooks", "hatchling.builders.hooks.plugin"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def hook(build: types.ModuleType, root: Path = ROOT) -> Any:
    return build.CompilingHook(root, generator=["numpy"], requires=["mypy"])


def in_wheel(data: dict[str, Any]) -> list[str]:
    """Returns what the hook adds to the wheel."""
    return sorted(data["force_include"].values())


def blank() -> dict[str, Any]:
    return {"force_include": {}, "pure_python": True, "infer_tag": False}


def test_the_list_is_the_one_that_is_reported_at_run_time(build: types.ModuleType) -> None:
    assert build.listed(ROOT / "shared" / "safedpa" / "compiled.py") == list(MODULES)
    assert all(source_of(name.replace(".", "/") + ".py").is_file() for name in MODULES)
    assert compiled_modules() in ((), MODULES)


@pytest.mark.parametrize("wanted", ["", "1"])
def test_an_editable_installation_gets_nothing_compiled(build, monkeypatch, wanted):
    monkeypatch.setenv("SAFEDPA_COMPILE", wanted)
    one, data = hook(build), blank()
    one.initialize("editable", data)
    assert (data, one.notice) == (blank(), [])


def test_a_wheel_of_source_holds_nothing_compiled(build: types.ModuleType, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SAFEDPA_COMPILE", "0")
    one, data = hook(build), blank()
    assert one.dependencies() == []
    one.initialize("standard", data)
    assert (data, one.notice) == (blank(), [])


def test_without_a_compiler_the_wheel_is_of_source_with_a_warning(build, monkeypatch):
    monkeypatch.setattr(build.shutil, "which", lambda _: None)
    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    one, data = hook(build), blank()
    assert one.dependencies() == []
    one.initialize("standard", data)
    assert data == blank()
    assert one.notice == ["safedpa: a wheel of Python source: not compiled: no C compiler"]
    monkeypatch.setenv("SAFEDPA_COMPILE", "1")
    with pytest.raises(RuntimeError, match="no C compiler; set SAFEDPA_COMPILE=0"):
        hook(build).initialize("standard", blank())


def test_a_wheel_whose_decisions_cannot_be_compiled_is_of_source(build, monkeypatch, tmp_path) -> None:
    (tmp_path / "shared" / "safedpa").mkdir(parents=True)
    (tmp_path / "shared" / "safedpa" / "__init__.py").touch()
    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    monkeypatch.setattr(build.shutil, "which", lambda _: "/bin/cc")
    one, data = hook(build, tmp_path), blank()
    one.initialize("standard", data)
    assert data == blank()
    assert "No module named safedpa.generate" in one.notice[0]


@pytest.mark.parametrize("works", [True, False])
def test_the_wheel_holds_all_that_is_compiled_or_nothing(build, monkeypatch, works):
    def compiler(command: list[str], cwd: Path | None = None, **others: Any) -> Any:
        if cwd is None:  # safedpa.generate
            folder = Path(command[-1])
            folder.mkdir()
            (folder / "key-digest.so").touch()
            return types.SimpleNamespace(returncode=0, stdout="", stderr="")
        names = [file for file in command if file.endswith(".py")]
        assert all((cwd / name).read_text() == source_of(name).read_text() for name in names)
        for name in ["group", *names[: None if works else 1]]:
            (cwd / name).with_suffix(".so").touch()
        return types.SimpleNamespace(returncode=0 if works else 1, stdout="", stderr="first\nlast words")

    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    monkeypatch.setattr(build.shutil, "which", lambda _: "/bin/cc")
    monkeypatch.setattr(build.subprocess, "run", compiler)
    one, data = hook(build), blank()
    assert one.dependencies() == ["numpy", "mypy"]
    one.initialize("standard", data)
    if works:
        compiled = ["group.so", *(name.replace(".", "/") + ".so" for name in MODULES)]
        assert in_wheel(data) == sorted([*compiled, "safedpa/native/built/key-digest.so"])
        assert (data["pure_python"], data["infer_tag"]) == (False, True)
    else:
        assert in_wheel(data) == []
        assert data["pure_python"]
        assert one.notice == ["safedpa: a wheel of Python source: not compiled: mypyc: last words"]
    one.finalize("standard", data, "")
    assert not one._work.exists()
