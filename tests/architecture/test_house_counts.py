"""``deploy/house.py`` counts what it says: lines by kind, modules with one importer, names, one decision's files.

And the house itself does not fall behind what it has come to.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

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
    assert found["safedpa.alone"].measured
    assert not found["safedpa.room.part"].measured


def test_lines_are_code_reported_or_blank(house: ModuleType, tmp_path: Path) -> None:
    text = '"""What\n\nit is."""\n\n# why\nx = 1  # so\n'
    found = house.modules(written(tmp_path, {"shared/safedpa/a.py": text}))
    module = found["safedpa.a"]
    assert (module.lines, module.reported, module.blank) == (6, 4, 1)
    assert "| all | 6 | 1 | 4 | 1 | 1 | 0 |" in house.table(found)


@pytest.mark.long
def test_the_house_itself_is_counted(whole: dict[str, Any]) -> None:
    assert len(whole) > 500
    assert whole["safedpa.safety.filter"].importers >= {"safedpa.safety.batch.filter"}


def test_why_two_modules_stay_apart_is_reported(house: ModuleType, tmp_path: Path) -> None:
    one = "one = 1\n"
    found = house.modules(
        written(
            tmp_path,
            {
                "shared/safedpa/a/used.py": one,
                "shared/safedpa/a/user.py": "from safedpa.a.used import one\n",
                "shared/safedpa/b/far.py": one,
                "shared/safedpa/a/asks.py": "from safedpa.b.far import one\n",
                "shared/safedpa/a/long.py": one * 300,
                "shared/safedpa/a/longer.py": "from safedpa.a.long import one\n" * 151,
                "shared/safedpa/robots/x/part.py": one,
                "shared/safedpa/robots/x/robot.py": "from safedpa.robots.x.part import one\n",
                "services/safedpa_services/s/work.py": one,
                "services/safedpa_services/s/__main__.py": "from safedpa_services.s.work import one\n",
            },
        )
    )
    assert {module.name.partition(".")[2]: house.why_apart(module, found) for module in house.alone(found)} == {
        "a.used": "",
        "b.far": "another room",
        "a.long": "too long together",
        "robots.x.part": "declared by a robot",
        "s.work": "a program's work",
    }


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


MOST_ALONE, MOST_APART = 121, 50
"""Modules with one importer, and those of them that could be one with it; 121 and 50 on 27 November 2026, when the
ground's forces on a simulated car went where they are compiled and loaded without the physics engine."""
MOST_ASKING = 17
"""Places that ask whether a system has certain names, most of them x and y: a plane to draw or a heading to turn."""
TWICE = {"Grid", "Proposal", "Request", "RunError", "Seen", "Sensed", "Stage", "Trial"}
"""Names that several public classes of ``safedpa`` still have."""


@pytest.mark.long
def test_no_further_name_is_given_twice(house: ModuleType, whole: dict[str, Any]) -> None:
    assert set(house.twice_named(whole)) <= TWICE


@pytest.mark.long
def test_no_further_module_stands_alone_that_could_be_one_with_another(
    house: ModuleType, whole: dict[str, Any]
) -> None:
    apart = [module for module in house.alone(whole) if not house.why_apart(module, whole)]
    assert len(house.alone(whole)) <= MOST_ALONE
    assert len(apart) <= MOST_APART, [module.name for module in apart]


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
    assert max(most.values()) <= 42  # one more since a model's step has a file of its own
