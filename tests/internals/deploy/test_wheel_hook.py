"""The wheel's build hook. ``make test-compiled`` tests that compiled modules decide like their source."""

from __future__ import annotations

import importlib.util
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from safedpa.compiled import MODULES, compiled_modules
from safedpa.generate import GENERATORS

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


GENERATED = sorted(name.replace(".", "/") + ".py" for name in GENERATORS)


def test_the_list_is_the_one_that_is_reported_at_run_time(build: types.ModuleType) -> None:
    assert build.listed(ROOT / "shared" / "safedpa" / "compiled.py") == list(MODULES)
    assert all(source_of(name.replace(".", "/") + ".py").is_file() for name in MODULES), "run make environment"
    assert compiled_modules() in ((), MODULES)


@pytest.mark.parametrize("wanted", ["", "1"])
def test_an_editable_installation_gets_nothing_generated_or_compiled(build, monkeypatch, wanted):
    monkeypatch.setenv("SAFEDPA_COMPILE", wanted)
    one, data = hook(build), blank()
    one.initialize("editable", data)
    assert (data, one.notice) == (blank(), [])


def test_a_wheel_of_source_holds_the_generated_modules(build: types.ModuleType, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SAFEDPA_COMPILE", "0")
    one, data = hook(build), blank()
    assert one.dependencies() == ["numpy"]
    one.initialize("standard", data)
    assert in_wheel(data) == GENERATED
    for file, name in data["force_include"].items():
        assert Path(file).read_bytes() == source_of(name).read_bytes(), "run make environment"
    assert one.notice == []


def test_without_a_compiler_the_wheel_is_of_source_with_a_warning(build, monkeypatch):
    monkeypatch.setattr(build.shutil, "which", lambda _: None)
    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    one, data = hook(build), blank()
    assert one.dependencies() == ["numpy"]
    one.initialize("standard", data)
    assert in_wheel(data) == GENERATED
    assert one.notice == ["safedpa: a wheel of Python source: not compiled: no C compiler"]
    monkeypatch.setenv("SAFEDPA_COMPILE", "1")
    with pytest.raises(RuntimeError, match="no C compiler; set SAFEDPA_COMPILE=0"):
        hook(build).initialize("standard", blank())


def test_a_wheel_for_which_nothing_can_be_generated_is_not_built(build: types.ModuleType, tmp_path: Path) -> None:
    (tmp_path / "shared" / "safedpa").mkdir(parents=True)
    (tmp_path / "shared" / "safedpa" / "__init__.py").touch()
    with pytest.raises(RuntimeError, match=r"generate failed: .*No module named safedpa\.generate"):
        hook(build, tmp_path).initialize("standard", blank())


@pytest.mark.parametrize("works", [True, False])
def test_the_wheel_holds_all_compiled_modules_or_none(build, monkeypatch, works):
    def compiler(command: list[str], cwd: Path | None = None, **others: Any) -> Any:
        if cwd is None:
            return run(command, **others)
        names = [file for file in command if file.endswith(".py")]
        assert all((cwd / name).read_text() == source_of(name).read_text() for name in names)
        for name in ["group", *names[: None if works else 1]]:
            (cwd / name).with_suffix(".so").touch()
        return types.SimpleNamespace(returncode=0 if works else 1, stdout="", stderr="first\nlast words")

    run = build.subprocess.run
    monkeypatch.delenv("SAFEDPA_COMPILE", raising=False)
    monkeypatch.setattr(build.shutil, "which", lambda _: "/bin/cc")
    monkeypatch.setattr(build.subprocess, "run", compiler)
    one, data = hook(build), blank()
    assert one.dependencies() == ["numpy", "mypy"]
    one.initialize("standard", data)
    if works:
        compiled = ["group.so", *(name.replace(".", "/") + ".so" for name in MODULES)]
        assert in_wheel(data) == sorted([*GENERATED, *compiled])
        assert (data["pure_python"], data["infer_tag"]) == (False, True)
    else:
        assert in_wheel(data) == GENERATED
        assert data["pure_python"]
        assert one.notice == ["safedpa: a wheel of Python source: not compiled: mypyc: last words"]
    one.finalize("standard", data, "")
    assert not one._work.exists()
