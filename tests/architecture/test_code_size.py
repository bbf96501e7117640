"""``deploy/code_size.py`` counts lines, repeated names and the files of one decision; the figures do not grow."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def house() -> ModuleType:
    spec = importlib.util.spec_from_file_location("code_size", ROOT / "deploy" / "code_size.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["code_size"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def whole(house: ModuleType) -> dict[str, Any]:
    """The modules of this checkout."""
    found: dict[str, Any] = house.modules(ROOT)
    return found


def written(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_lines_are_code_text_or_blank(house: ModuleType, tmp_path: Path) -> None:
    text = '"""What\n\nit is."""\n\n# why\nx = 1  # so\n'
    found = house.modules(written(tmp_path, {"shared/safedpa/a.py": text}))
    module = found["safedpa.a"]
    assert (module.lines, module.text, module.blank) == (6, 4, 1)
    assert "| all | 6 | 1 | 4 | 1 | 1 |" in house.table(found)


def test_classes_of_one_name_are_found_but_for_a_robot_s_effects(house: ModuleType, tmp_path: Path) -> None:
    found = house.modules(
        written(
            tmp_path,
            {
                "shared/safedpa/a.py": "class One: ...\nclass _Own: ...\n",
                "shared/safedpa/b.py": "class One: ...\nclass _Own: ...\n",
                "shared/safedpa/robots/x/effects/drag.py": "class Drag: ...\n",
                "shared/safedpa/robots/y/effects/drag.py": "class Drag: ...\n",
                "services/safedpa_services/c.py": "class One: ...\n",
            },
        )
    )
    assert house.twice_named(found) == {"One": ["safedpa.a", "safedpa.b"]}


MOST_ASKING = 17
"""Places that ask whether a system has certain names, most of them x and y: a plane to draw or a heading to turn."""


@pytest.mark.long
def test_no_further_name_is_given_twice(house: ModuleType, whole: dict[str, Any]) -> None:
    assert set(house.twice_named(whole)) == set()


def test_who_asks_for_a_state_by_its_name_is_found(house: ModuleType, tmp_path: Path) -> None:
    asks = "def f(system): return system.state_names[:2] == ('x', 'y')\n"
    found = house.modules(
        written(
            tmp_path,
            {
                "shared/safedpa/a.py": asks,
                "shared/safedpa/robots/x/b.py": asks,
                "shared/safedpa/c.py": "def f(one, other): return one.state_names == other.state_names\n",
            },
        )
    )
    assert [line.partition(":")[0] for line in house.asks_for_names(found)] == ["safedpa.a"]


@pytest.mark.long
def test_no_further_place_asks_for_states_by_name(house: ModuleType, whole: dict[str, Any]) -> None:
    assert len(house.asks_for_names(whole)) <= MOST_ASKING


def test_a_decision_passes_no_more_files_than_it_did(house: ModuleType) -> None:
    most = {(asked, status): files for asked, status, files, _ in house.decision_files()}
    assert set(most) >= {("SafetyFilter.decide", "passed"), ("SafetyFilter.decide", "corrected")}
    assert max(files for (asked, _), files in most.items() if asked == "SafetyFilter.decide") <= 27
    assert max(most.values()) <= 46  # four of them are the session: memory, guard, plausibility, measurement
