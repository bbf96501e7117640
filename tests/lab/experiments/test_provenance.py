"""A figure says how it was made, and the check says when its code has become another one."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa_lab.commands.results import command as results
from safedpa_lab.provenance import code, record
from safedpa_lab.provenance.check import standings
from safedpa_lab.provenance.record import KEY, command_line, write_result
from safedpa_services.command_line.group import safedpa

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a small experiment writes; nobody changes it here."""
    out = tmp_path_factory.mktemp("written") / "theory.json"
    assert (
        safedpa.run(["experiment", "theory", "car_learned", "--states", "2000", "--seed", "4", "--out", str(out)]) == 0
    )
    return out


@pytest.fixture
def kept(written: Path, tmp_path: Path) -> Path:
    """A folder with a copy of it, to be changed."""
    shutil.copy(written, tmp_path)
    return tmp_path


def test_a_result_holds_how_to_make_it_again(written: Path) -> None:
    told = json.loads(written.read_text())[KEY]
    assert told["command"] == "safedpa experiment theory car_learned --states 2000 --seed 4"
    assert told["date"][:2] == "20"
    assert told["machine"]["cores"] >= 1
    assert {"safedpa.safety", "safedpa.dynamics", "safedpa.robots.car", "shipped models"} <= set(told["code"])
    assert str(written.parent) not in json.dumps(told)


def test_the_check_names_the_package_that_has_changed(kept: Path) -> None:
    (now,) = standings(kept)
    assert (now.changed, now.told) == ((), "made by the code of today")
    path = kept / "theory.json"
    document = json.loads(path.read_text())
    document[KEY]["code"]["safedpa.safety"] = "0" * 12
    path.write_text(json.dumps(document))
    (then,) = standings(kept)
    assert then.changed == ("safedpa.safety",)
    assert then.told == f"older than its code in 1 of {then.rooms} rooms"
    shown = CliRunner().invoke(results, ["check", str(kept), "--strict"], standalone_mode=False)
    assert "differ: safedpa.safety" in shown.output
    assert shown.return_value == 1


def test_a_result_without_provenance_is_not_called_current(tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text('{"date": "2026-11-21", "rows": []}')
    (old,) = standings(tmp_path)
    assert (old.date, old.rooms, old.told) == ("2026-11-21", 0, "made before its code was written down")
    assert CliRunner().invoke(results, ["check", str(tmp_path)], standalone_mode=False).return_value == 0
    assert CliRunner().invoke(results, ["check", str(tmp_path), "--strict"], standalone_mode=False).return_value == 1


def test_each_row_of_a_benchmark_is_checked_by_itself(kept: Path) -> None:
    told = json.loads((kept / "theory.json").read_text())[KEY]
    (kept / "theory.json").write_text(json.dumps({"rows": {"new": {KEY: told}, "old": {"name": "old"}}}))
    assert [(each.name, bool(each.rooms)) for each in standings(kept)] == [
        ("theory.json: new", True),
        ("theory.json: old", False),
    ]


def test_no_results_and_no_json_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="name the folder"):
        list(standings(tmp_path))
    (tmp_path / "torn.json").write_text("{")
    with pytest.raises(InputError, match="make it anew"):
        list(standings(tmp_path))


@pytest.mark.parametrize(
    "text",
    [
        "[1, 2]", "null", f'{{"{KEY}": null}}', f'{{"{KEY}": [1]}}', f'{{"{KEY}": {{"code": {{"a": "b"}}}}}}',
        f'{{"{KEY}": {{"code": ["a"], "module": "safedpa_lab"}}}}', '{"rows": {"one": 3}}',
        f'{{"{KEY}": {{"code": {{"a": "b"}}, "module": null, "date": 3}}}}',
    ],
)  # fmt: skip
def test_a_malformed_provenance_counts_as_unknown(tmp_path: Path, text: str) -> None:
    (tmp_path / "odd.json").write_text(text)
    (told,) = standings(tmp_path)
    assert (told.rooms, told.changed, told.date) == (0, (), None)
    assert CliRunner().invoke(results, ["check", str(tmp_path)], standalone_mode=False).return_value == 0


def test_every_package_differs_if_the_module_is_gone(kept: Path) -> None:
    path = kept / "theory.json"
    document = json.loads(path.read_text())
    document[KEY]["module"] = "safedpa_lab.of.long.ago"
    document[KEY]["code"] = {"safedpa_lab.of": "0" * 12}
    path.write_text(json.dumps(document))
    (then,) = standings(kept)
    assert "safedpa_lab.of" in then.changed
    assert len(then.changed) == then.rooms


def test_a_result_is_json_whatever_was_measured(tmp_path: Path) -> None:
    odd = {"a": math.nan, "b": [np.float32("inf"), np.int64(3)], "c": {"d": (-math.inf, 1.5, None, True)}}
    write_result(tmp_path / "odd.json", odd)
    document = json.loads((tmp_path / "odd.json").read_text(), parse_constant=pytest.fail)
    assert {key: document[key] for key in odd} == {"a": None, "b": [None, 3.0], "c": {"d": [None, 1.5, None, True]}}


def test_an_environment_within_another_project_bears_no_commit_of_that_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "env" / "safedpa"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (tmp_path / ".gitignore").write_text("env\n")
    own = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "."), (*own, "commit", "-q", "-m", "theirs")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True, capture_output=True)
    monkeypatch.setattr(record.safedpa, "__file__", str(package / "__init__.py"))
    write_result(tmp_path / "odd.json", {})
    assert json.loads((tmp_path / "odd.json").read_text())[KEY]["commit"] is None


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--seed", "7", "--only", "box", "--only", "large chair", "--quick", "--processes", "1", "--out", "/x/y"],
         "drive --only box --only 'large chair' --seed 7 --quick"),
        (["--no-peers"], "drive --no-peers"),
        (["--place", "1", "2"], "drive --place 1.0 2.0"),
        (["--only", "it's $HOME"], "drive --only 'it'\"'\"'s $HOME'"),
        (["--model", "/home/someone/private/m.toml"], "drive --model m.toml"),
        (["--when", "now"], "drive"),
    ],
)  # fmt: skip
def test_a_command_is_recorded_as_typed_without_folders(words: list[str], told: str) -> None:
    said: list[str] = []

    @click.command(name="drive")
    @click.option("--peers/--no-peers", default=True)
    @click.option("--place", nargs=2, type=float)
    @click.option("--only", multiple=True)
    @click.option("--model")
    @click.option("--when", default=lambda: "now")
    @click.option("--seed", type=int, default=0)
    @click.option("--quick", is_flag=True)
    @click.option("--processes", type=int, default=2)
    @click.option("--out", type=click.Path(path_type=Path))
    def drive(**_: object) -> None:
        said.append(command_line(click.get_current_context()))

    CliRunner().invoke(drive, words, prog_name="drive")
    assert said == [told]


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ('"""One."""\na = 1\n', "# two\n\na = 1\n", True),
        ('def f():\n    """One."""\n    return 1\n', "def f():\n    return 1\n", True),
        ('if a:\n    """One."""\n    b()\n', "if a:\n    b()\n", True),
        ("a = 1\n", "a = 2\n", False),
        ("a = b < c\n", "a = b <= c\n", False),
        ('a = "one"\n', 'a = "two"\n', False),
        ('a = """\n# one\n"""\n', 'a = """\n# two\n"""\n', False),
        ('a = f"""\n# one {b}\n"""\n', 'a = f"""\n# two {b}\n"""\n', False),
    ],
)
def test_comments_and_layout_do_not_count_and_all_else_does(before: str, after: str, same: bool) -> None:
    assert (code.without_words(before) == code.without_words(after)) is same


def test_code_that_is_only_named_counts_as_well() -> None:
    """Imports within functions, processes started by a module's name, robots found by theirs."""
    faults = set(code.code_behind("safedpa_lab.commands.experiments.faults"))
    assert {"safedpa.robots.car.barriers", "safedpa.safety.decision", "safedpa_lab.faults.report"} <= faults
    assert {"safedpa_services.safety_filter.__main__", "safedpa_services.recorder.__main__"} <= faults


def test_a_result_written_outside_a_command_names_none(tmp_path: Path) -> None:
    write_result(tmp_path / "plain.json", {"a": 1})
    document = json.loads((tmp_path / "plain.json").read_text())
    assert (document["a"], document[KEY]["command"], document[KEY]["code"]) == (1, None, {})


def test_every_experiment_that_writes_a_result_writes_its_provenance() -> None:
    """No file of results is written past the one place that adds it."""
    bare = []
    for path in sorted((ROOT / "sim" / "safedpa_lab").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "commands" in path.parts or "report" in path.name or path.name.endswith("_record.py"):
            bare += [str(path.relative_to(ROOT))] if "write_text(json.dumps(" in text else []
    assert bare == []
