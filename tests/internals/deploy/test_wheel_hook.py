"""What the wheel's build hook decides; that compiled modules decide alike is what ``make test-compiled`` shows."""

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
    """The file of a module, such as ``safedpa/compiled.py``."""
    return ROOT / ("sim" if file.startswith("safedpa_sim/") else "shared") / file


class Interface:
    """Of hatchling's hook as much as is used, where hatchling is not installed."""

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
    return build.CompilingHook(root, requires=["mypy"])


def blank() -> dict[str, Any]:
    return {"force_include": {}, "pure_python": True, "infer_tag": False}


def test_the_list_is_the_one_that_is_reported_at_run_time(build: types.ModuleType) -> None:
    assert build.listed(ROOT / "shared" / "safedpa" / "compiled.py") == list(MODULES)
    assert all(source_of(name.replace(".", "/") + ".py").is_file() for name in MODULES)
    assert compiled_modules() in ((), MODULES)


@pytest.mark.parametrize(("version", "wanted"), [("editable", ""), ("editable", "1"), ("standard", "0")])
def test_some_wheels_are_never_compiled(
    build: types.ModuleType, monkeypatch: pytest.MonkeyPatch, version: str, wanted: str
) -> None:
    monkeypatch.setenv("SAFEDPA_COMPILE", wanted)
    monkeypatch.setattr(build.subprocess, "run", lambda *_, **__: pytest.fail("compiles"))
    one, data = hook(build), blank()
    one.initialize(version, data)
    assert (data, one.notice) == (blank(), [])
    assert wanted != "0" or one.dependencies() == []


def test_without_a_compiler_the_wheel_is_of_source_with_a_warning(
    build: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
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


@pytest.mark.parametrize("works", [True, False])
def test_what_comes_out_goes_into_the_wheel_and_nothing_half_done(
    build: types.ModuleType, monkeypatch: pytest.MonkeyPatch, works: bool
) -> None:
    def compiler(command: list[str], cwd: Path, **_: Any) -> types.SimpleNamespace:
        names = [file for file in command if file.endswith(".py")]
        assert all((cwd / name).read_text() == source_of(name).read_text() for name in names)
        for name in ["group", *names[: None if works else 1]]:
            (cwd / name).with_suffix(".so").touch()
        return types.SimpleNamespace(returncode=0 if works else 1, stdout="", stderr="first\nlast words")

    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    monkeypatch.setattr(build.shutil, "which", lambda _: "/bin/cc")
    monkeypatch.setattr(build.subprocess, "run", compiler)
    one, data = hook(build), blank()
    assert one.dependencies() == ["mypy"]
    one.initialize("standard", data)
    inside = sorted(data["force_include"].values())
    if works:
        assert inside == sorted(["group.so", *(name.replace(".", "/") + ".so" for name in MODULES)])
        assert (data["pure_python"], data["infer_tag"]) == (False, True)
    else:
        assert data == blank()
        assert one.notice == ["safedpa: a wheel of Python source: not compiled: mypyc: last words"]
    one.finalize("standard", data, "")
    assert not one._work.exists()
