"""The commands of the experiments; tests/architecture/test_abilities.py compares their options with a list."""

import json
import sys
from pathlib import Path
from subprocess import run
from typing import Any

import click
import pytest
from click.testing import CliRunner

from safedpa.errors import InputError, SafedpaError
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand
from safedpa_lab.experiments.record import FILE_OUT, FOLDER_OUT, Experiment, integer, text
from safedpa_lab.provenance.record import KEY


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_every_experiment_shows_its_help(name: str) -> None:
    shown = CliRunner().invoke(ExperimentCommand(EXPERIMENTS[name]), ["--help"])
    assert shown.exit_code == 0
    assert EXPERIMENTS[name].summary in " ".join(shown.output.split())


def test_the_table_is_read_without_the_optional_packages() -> None:
    code = "import sys; import safedpa_lab.experiments.table; print({'numpy', 'torch', 'scipy'} & set(sys.modules))"
    assert run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


def example(options: dict[str, Any], report_progress: Any) -> dict[str, Any]:
    report_progress(1, 1)
    if options["word"] == "bad":
        raise InputError("word: got bad")
    return {"word": options["word"], "count": options["count"], "points": [1, 2]}


def tables(result: dict[str, Any]) -> str:
    return f"{result['word']} x {result['count']}, by `{result[KEY]['module']}`"


def without_points(result: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in result.items() if key != "points"}


def figures(result: dict[str, Any], out: Path) -> None:
    (out / "figure.txt").write_text(str(result["points"]), encoding="utf-8")


def verdict(result: dict[str, Any]) -> None:
    if result["word"] == "failed":
        raise SafedpaError("it failed")


def command(out: click.Parameter) -> ExperimentCommand:
    options = (text("--word", "a"), integer("--count", 2, positive=True), out)
    functions = {name: f"{__name__}:{name}" for name in ("figures", "verdict")}
    return ExperimentCommand(
        Experiment(
            "example",
            "An example.",
            f"{__name__}:example",
            options,
            f"{__name__}:tables",
            document=f"{__name__}:without_points",
            **functions,
        )
    )


def test_a_folder_gets_tables_json_and_figures(tmp_path: Path) -> None:
    done = CliRunner().invoke(command(FOLDER_OUT), ["--word", "b", "--out", str(tmp_path / "new" / "out")])
    assert done.exit_code == 0, done.output
    out = tmp_path / "new" / "out"
    assert sorted(path.name for path in out.iterdir()) == ["example.json", "example.md", "figure.txt"]
    document = json.loads((out / "example.json").read_text("utf-8"))
    assert (document["word"], "points" in document, document[KEY]["module"]) == ("b", False, __name__)
    assert (out / "example.md").read_text("utf-8") == done.output == f"b x 2, by `{__name__}`\n"


def test_a_file_gets_the_json_document(tmp_path: Path) -> None:
    done = CliRunner().invoke(command(FILE_OUT), ["--json", "--out", str(tmp_path / "a.json")])
    printed, written = json.loads(done.output), json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert printed == {"word": "a", "count": 2, "points": [1, 2]}
    assert written["count"] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--count", "0"], "--count: got 0, wanted more than 0"),
        (["--word", "bad"], "word: got bad"),
        (["--word", "failed"], "it failed"),
    ],
)
def test_refusals_and_failures_are_raised(arguments: list[str], message: str) -> None:
    done = CliRunner().invoke(command(FILE_OUT), arguments)
    assert str(done.exception) == message


def test_a_refused_run_leaves_no_folder(tmp_path: Path) -> None:
    CliRunner().invoke(command(FOLDER_OUT), ["--word", "bad", "--out", str(tmp_path / "new" / "out")])
    assert list(tmp_path.iterdir()) == []
