"""``deploy/house.py`` counts what it says: lines by kind, and modules with one importer, packages looked through."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def house() -> ModuleType:
    spec = importlib.util.spec_from_file_location("house", ROOT / "deploy" / "house.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["house"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def written(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_a_package_is_looked_through(house: ModuleType, tmp_path: Path) -> None:
    """``part`` is handed on by its package and asked for by two; ``alone`` by one; the laboratory does not count."""
    found = house.modules(
        written(
            tmp_path,
            {
                "shared/safedpa/__init__.py": "",
                "shared/safedpa/room/__init__.py": 'from safedpa.room.part import one\n__all__ = ["one"]\n',
                "shared/safedpa/room/part.py": "one = 1\n",
                "shared/safedpa/alone.py": "two = 2\n",
                "shared/safedpa/first.py": "from safedpa.alone import two\nfrom safedpa.room import one\n",
                "shared/safedpa/second.py": "from safedpa.room import one\n",
                "sim/safedpa_lab/third.py": "from safedpa.alone import two\n",
            },
        )
    )
    assert found["safedpa.room.part"].importers == {"safedpa.first", "safedpa.second"}
    assert [module.name for module in house.alone(found)] == ["safedpa.alone"]
    assert "safedpa_lab.third" not in found


def test_lines_are_code_told_or_blank(house: ModuleType, tmp_path: Path) -> None:
    text = '"""What\n\nit is."""\n\n# why\nx = 1  # so\n'
    found = house.modules(written(tmp_path, {"shared/safedpa/a.py": text}))
    module = found["safedpa.a"]
    assert (module.lines, module.told, module.blank) == (6, 4, 1)
    assert "| all | 6 | 1 | 4 | 1 | 1 | 0 |" in house.table(found)


def test_the_house_itself_is_counted(house: ModuleType) -> None:
    found = house.modules(ROOT)
    assert len(found) > 500
    assert found["safedpa.safety.safety_filter"].importers >= {"safedpa.safety.batch"}
