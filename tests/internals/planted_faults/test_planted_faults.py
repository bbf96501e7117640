"""The command that plants faults finds their places, plants one at a time, and reports who noticed from who did not."""

import ast
import subprocess
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
SOURCE = '''"""A margin."""

import os

__all__ = ["margin", "widest"]

PATIENCE_SECONDS = 2.0


def margin(errors, predicted, kept, deadline):
    """The margin."""
    if deadline and not kept:
        return None
    largest = max(abs(error - predicted) for error in errors if error > 0.0)
    os.fsync(3)
    return largest / 1000.0


def widest(fields, count):
    """The widest."""
    count += 1
    same = (fields.a, fields.b)
    return same, fields[1:], count.sqrt(4.0), any(fields)
'''
JUDGE = """
from safedpa.safety.margins.conformal import margin
def test_the_margin(): assert margin([2000.0, 1000.0], 0.0, True, 1) == 2.0
def test_never_true(): assert False
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working tree with one module and one file of tests, of which one test always fails."""
    root = tmp_path_factory.mktemp("tree")
    for name, text in {
        "shared/safedpa/__init__.py": "",
        "shared/safedpa/safety/__init__.py": "",
        "shared/safedpa/safety/margins/conformal.py": SOURCE.replace("    os.fsync(3)\n", ""),
        "tests/safety/test_margin.py": JUDGE,
        "tests/bus/test_other.py": "from safedpa.nothing import nothing\n",
        "pyproject.toml": '[tool.pytest.ini_options]\nmarkers = ["slow: slow"]\n',
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    subprocess.run(["git", "init", "-q"], cwd=root, check=True)
    return root


@pytest.fixture(autouse=True)
def _found_alongside_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """The runs that it starts are of small tests that need no plugin: to import those takes longer than all else."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")


@pytest.mark.parametrize(
    ("change", "before", "after"),
    [
        ("turned", "error - predicted", "predicted - error"),
        ("turned", "abs(error - predicted)", "error - predicted"),
        ("dropped", "deadline and not kept", "not kept"),
        ("other_extreme", "max(", "min("),
        ("one_ahead", "fields[1:]", "fields[:-1]"),
        ("everything_used", "for error in errors if error > 0.0", "for error in errors)"),
        ("spread", "count.sqrt(4.0)", "4.0"),
        ("field_left_out", "(fields.a, fields.b)", "(fields.b,)"),
        ("unit_lost", "largest / 1000.0", "largest * 1000.0"),
        ("later_wins", "error > 0.0", "error < 0.0"),
        ("not_durable", "os.fsync(3)", "pass"),
        ("longer", "PATIENCE_SECONDS = 2.0", "PATIENCE_SECONDS = 20.0"),
        ("miscounted", "count += 1", "pass"),
        ("miscounted", "any(fields)", "all(fields)"),
    ],
)
def test_a_slip_is_made_where_its_form_stands(change: str, before: str, after: str) -> None:
    from safedpa_lab.planted_faults import ast_changes as changes

    made = [
        (ast.get_source_segment(SOURCE, node) or "", ast.unparse(ast.fix_missing_locations(one)))
        for node in ast.walk(ast.parse(SOURCE))
        for one in getattr(changes, change)(node)
    ]
    assert any(before in was and after in becomes for was, becomes in made), made


def test_a_check_that_leads_away_is_gone_and_nothing_else() -> None:
    from safedpa_lab.planted_faults import ast_changes as changes

    (check,) = [node for node in ast.walk(ast.parse(SOURCE)) if isinstance(node, ast.If)]
    assert ast.unparse(next(iter(changes.guard_gone(check)))) == "if False:\n    return None"


def test_every_class_has_files_and_its_places_are_planted_alone(tree: Path) -> None:
    from safedpa_lab.planted_faults.fault_classes import CLASSES, faults_in

    for kind in CLASSES:
        assert all(any(ROOT.glob(glob)) for glob in kind.where), kind.name
    source = (tree / "shared/safedpa/safety/margins/conformal.py").read_text(encoding="utf-8")
    found = [fault for kind in CLASSES for fault in faults_in(tree, kind)]
    assert len({fault.kind for fault in found}) >= 5
    for fault in found:
        planted = fault.planted(source)
        ast.parse(planted)
        assert source.encode()[fault.first : fault.end].decode() == fault.before
        assert len(planted) - len(source) == len(fault.after) - len(fault.before)
        assert "__all__" not in fault.before
        assert '"margin"' not in fault.before


def test_a_seed_draws_the_same_places_from_every_class(tree: Path) -> None:
    from safedpa_lab.planted_faults.__main__ import drawn

    first, second, other = drawn(tree, 1, 8), drawn(tree, 1, 8), drawn(tree, 2, 8)
    assert first == second != other
    assert len({fault.kind for fault in first}) >= 5
    assert len({(fault.path, fault.first, fault.after) for fault in first}) == 8


def test_a_fault_whose_file_has_changed_is_found_again_or_reported_as_gone(tree: Path, tmp_path: Path) -> None:
    import shutil

    from safedpa_lab.planted_faults.__main__ import difference, drawn, there_now

    shutil.copytree(tree, tmp_path / "later")
    fault = next(one for one in drawn(tree, 1, 1000) if one.before == "abs(error - predicted)")
    path = tmp_path / "later" / fault.path
    source = path.read_text(encoding="utf-8")
    row = {"fault": vars(fault), "difference": difference(fault, source)}
    assert there_now(tmp_path / "later", dict(row)) == fault
    path.write_text(source.replace("import os", "import os\nimport sys"), encoding="utf-8")
    found = there_now(tmp_path / "later", row)
    assert found is not None
    assert (found.line, found.first, row["fault"]) == (fault.line + 1, fault.first + len("import sys\n"), vars(found))
    path.write_text(source.replace("abs(error - predicted)", "abs(error)"), encoding="utf-8")
    assert there_now(tmp_path / "later", row) is None
    path.unlink()
    assert there_now(tmp_path / "later", row) is None


HANDED = {
    "shared/safedpa/one.py": """
class Message:
    tick: int
    epoch: int
    until: float = 0.0
class Session:
    def __init__(self): self.seen = 0
    def follow(self, state, document):
        self.seen, self._own = state.tick, 1
        self._own = 2
        document["seen"] = self.seen
        return Message(tick=state.tick, epoch=1, until=2.0)
""",
    "services/safedpa_services/two.py": """
def read(session, message, document):
    return session.seen, message.tick, message.epoch, message.until, document.get("seen", 3), document.get("own", 4)
""",
}


def test_what_one_module_hands_to_another_is_derived_and_planted(tmp_path: Path) -> None:
    from safedpa_lab.planted_faults.fault_classes import CLASSES, HANDED_OVER, faults_in

    for name, text in HANDED.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    (kind,) = [one for one in CLASSES if one.name == HANDED_OVER]
    found = {(fault.before, fault.after) for fault in faults_in(tmp_path, kind)}
    given = "Message(tick=state.tick, epoch=1, until=2.0)"
    assert found == {
        ("self.seen, self._own = state.tick, 1", "self._own = 1"),
        ('document["seen"] = self.seen', "pass"),
        (given, "Message(tick=state.tick, epoch=1)"),
        (given, "Message(tick=1, epoch=state.tick, until=2.0)"),
        ('document.get("seen", 3)', "3"),
    }


@pytest.fixture(scope="module")
def near() -> Any:
    """Of this very tree: a thousand files are read once."""
    from safedpa_lab.planted_faults.nearest_tests import Nearness

    return Nearness(ROOT)


@pytest.mark.long
def test_the_nearest_tests_import_the_module(tree: Path, near: Any) -> None:
    from safedpa_lab.planted_faults.nearest_tests import Nearness

    assert Nearness(tree).files("shared/safedpa/safety/margins/conformal.py", "margin", 5) == [
        "tests/safety/test_margin.py"
    ]
    found = near.files("shared/safedpa/safety/margins/conformal.py", "OnlineMargin", 20)
    assert "tests/safety/test_margin_conformal.py" in found


@pytest.mark.parametrize(
    ("before", "after", "probed_as"),
    [
        ("error - predicted", "predicted - error", 'abs((__import__("reached").reported() and (error - predicted)))'),
        ("if deadline and not kept:\n        return None", "if False:\n        return None",
         'if not __import__("reached").reported() or deadline and not kept:'),
        ("count += 1", "pass", '__import__("reached").reported(); count += 1'),
    ],
)  # fmt: skip
def test_the_place_of_a_fault_reports_when_it_is_reached_and_computes_the_same(before, after, probed_as) -> None:
    from safedpa_lab.planted_faults.fault_classes import Fault
    from safedpa_lab.planted_faults.working_copy import probed

    first = SOURCE.index(before)
    text = probed(Fault("", "", 0, "f", before, after, first, first + len(before)), SOURCE)
    assert probed_as in text
    ast.parse(text)


def test_a_number_of_a_module_is_reached_where_a_function_reads_it_and_not_by_import() -> None:
    from safedpa_lab.planted_faults.fault_classes import Fault
    from safedpa_lab.planted_faults.working_copy import probed

    source = "SECONDS = 2.0\n\n\ndef late(now):\n    return now > SECONDS, f'{SECONDS}'\n"
    text = probed(Fault("", "", 1, "", "SECONDS = 2.0", "SECONDS = 20.0", 0, 13), source)
    assert text.startswith("SECONDS = 2.0\n")
    assert 'now > (__import__("reached").reported() and SECONDS)' in text


@pytest.mark.long
def test_what_leads_to_a_module_by_no_import_is_asked_after_all_that_does(near: Any) -> None:
    assert near.files("services/safedpa_services/command_line/serve.py", "_Sayings.__call__", 60)
    far = near.files("sim/safedpa_lab/experiments/point/figures.py", "_path", 60)
    assert far


def test_slow_tests_of_the_nearest_files_run_before_quick_ones_of_farther_files() -> None:
    from safedpa_lab.planted_faults.working_copy import NEAR, _turns

    turns = list(_turns([str(number) for number in range(NEAR + 2)]))
    assert len(set(turns)) == len(turns) == 2 * (NEAR + 2)
    at = {(chosen, number): place for place, (chosen, number, _) in enumerate(turns)}
    assert at["not slow", 2] < at["slow", 0] < at["slow", 2] < at["not slow", 3]
    assert at["slow", NEAR - 1] < at["not slow", NEAR]


@pytest.mark.long
@pytest.mark.slow
def test_who_notices_is_reported_from_who_fails_anyway(tree: Path, tmp_path: Path) -> None:
    from safedpa_lab.planted_faults.__main__ import drawn
    from safedpa_lab.planted_faults.fault_classes import Fault
    from safedpa_lab.planted_faults.working_copy import Copy

    copy = Copy(tree, tmp_path)
    tests = ["tests/safety/test_margin.py"]
    faults = {(fault.before, fault.after): fault for fault in drawn(tree, 1, 1000)}
    of_a_margin = next(fault for (before, after), fault in faults.items() if after.startswith("min("))
    found = copy.tried(of_a_margin, tests, 60.0)
    assert (found.result, found.by, found.files) == ("noticed", f"{tests[0]}::test_the_margin", 1)
    assert found.reaching == 1
    assert found.unsound == (f"{tests[0]}::test_never_true",)
    of_a_check = next(fault for (before, after), fault in faults.items() if after.startswith("if False"))
    found = copy.tried(of_a_check, tests, 60.0)
    assert (found.result, found.reaching) == ("unnoticed", 1)
    first = (tree / of_a_margin.path).read_text(encoding="utf-8").index("count += 1")
    elsewhere = Fault("", of_a_margin.path, 0, "widest", "count += 1", "pass", first, first + 10)
    assert copy.tried(elsewhere, tests, 60.0).result == "unreached"
    assert copy.tried(of_a_margin, [], 60.0).result == "unreached"  # the whole suite is not near
    retained = (tmp_path / "shared/safedpa/safety/margins/conformal.py").read_text(encoding="utf-8")
    assert retained == (tree / "shared/safedpa/safety/margins/conformal.py").read_text(encoding="utf-8")


@pytest.mark.long
@pytest.mark.slow
def test_a_fault_after_which_nothing_ends_is_noticed(tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from safedpa_lab.planted_faults import working_copy as copied
    from safedpa_lab.planted_faults.fault_classes import Fault

    source = (tree / "shared/safedpa/safety/margins/conformal.py").read_text(encoding="utf-8")
    copy, first = copied.Copy(tree, tmp_path), source.index("largest / 1000.0")
    monkeypatch.setattr(copied, "_ROOM_SECONDS", 2.0)  # next to five times what a sound run takes
    after = "next(_ for _ in iter(int, 1) if _)"
    fault = Fault(
        "", "shared/safedpa/safety/margins/conformal.py", 0, "margin", "largest / 1000.0", after, first, first + 16
    )
    found = copy.tried(fault, ["tests/safety/test_margin.py"], 60.0)
    assert found.by == "tests/safety/test_margin.py::test_the_margin (does not end)"
