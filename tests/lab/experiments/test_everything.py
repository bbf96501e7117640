"""All experiments by one command, what each refuses before hours of work, and how a figure was made."""

import json
import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa_lab.commands.experiment import EXPERIMENTS, command
from safedpa_lab.commands.experiment import command as experiment
from safedpa_lab.commands.results import command as results
from safedpa_lab.experiments.run_all import ELSEWHERE, PARTS, Part, chosen, make
from safedpa_lab.provenance import code, record
from safedpa_lab.provenance.check import standings
from safedpa_lab.provenance.record import CONTENT, KEY, command_line, content_digest, write_result
from safedpa_services.command_line.group import safedpa

QUICK = Part("controllers", 2, "controllers --seeds 1 --controller goal_seeker", "--seconds 1")
"""One of the experiments that need no torch: what is looked at is how they are made, not which."""
BAD = Part("bad", 1, "controllers --controller no_such_controller", "")


def test_every_experiment_is_a_part_or_has_a_reason_not_to_be() -> None:
    asked = {part.phrase.split()[0] for part in PARTS}
    assert asked | set(ELSEWHERE) == set(EXPERIMENTS)
    assert not asked & set(ELSEWHERE)
    assert len({part.name for part in PARTS}) == len(PARTS)


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_each_part_is_asked_for_as_its_command_wants(part: Part, small: bool, tmp_path: Path) -> None:
    first, name, *phrase = part.command(tmp_path, tmp_path, small=small)
    assert first == "experiment"
    with click.Context(experiment) as context:
        found = experiment.get_command(context, name)  # type: ignore[attr-defined]
        found.make_context(name, phrase)  # raises for an option that there is not, or a value of another kind


def test_no_part_writes_into_another_one_s_place(tmp_path: Path) -> None:
    places = {part.result(tmp_path) for part in PARTS}
    assert len(places) == len(PARTS)
    assert all(place.parent == tmp_path / part.name for part in PARTS for place in [part.result(tmp_path)])


def test_unknown_names_and_missing_recordings_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"--only safty: .*safety"):
        chosen(("safty",), None)
    with pytest.raises(InputError, match="real-logs: got no --data"):
        chosen(("real-logs",), None)
    with pytest.raises(
        InputError, match="car-paper: no learned/car_paper; 'safedpa train car --configuration car_paper'"
    ):
        chosen(("car-paper",), None)
    left_out = {part.name for part in PARTS} - {part.name for part in chosen((), None)}
    assert left_out == {"real-logs", "car-paper", "car-planner", "car-curves-paper", "tuning-real"}
    (tmp_path / "learned" / "car_paper").mkdir(parents=True)
    assert chosen((), tmp_path) == list(PARTS)


@pytest.mark.long
def test_a_result_of_the_current_code_is_not_made_again(tmp_path: Path) -> None:
    notice: list[str] = []

    def report_progress(part: Part, phrase: str) -> None:
        notice.append(f"{part.name} {re.sub(r'[0-9.]+', 'N', phrase)}")

    runs, done, old = (f"{QUICK.name} {phrase}" for phrase in ("runs; about N minutes", "done in N s", "is up to date"))
    first = make([QUICK], tmp_path, small=True, report_progress=report_progress)
    assert notice == [runs, done]
    assert first["controllers"]["exit_code"] == 0
    assert json.loads((tmp_path / "all.json").read_text()) == first
    assert make([QUICK], tmp_path, small=True, report_progress=report_progress) == first
    assert notice[2:] == [old]

    result = QUICK.result(tmp_path)
    document: dict[str, Any] = json.loads(result.read_text())
    document[KEY]["code"]["safedpa.safety"] = "0" * 12
    result.write_text(json.dumps(document))
    make([QUICK], tmp_path, small=True, report_progress=report_progress)
    assert notice[3:] == [runs, done], "its code is another one by now"

    result.unlink()
    make([QUICK], tmp_path, small=True, report_progress=report_progress)
    assert notice[5:] == [runs, done], "it is gone"


@pytest.mark.long
def test_a_small_result_does_not_replace_the_whole_experiment(tmp_path: Path) -> None:
    part = Part("controllers", 2, f"{QUICK.phrase} --seconds 2", "--seconds 1")
    make([part], tmp_path, small=True)
    make([part], tmp_path)
    assert "--seconds 2" in json.loads(part.result(tmp_path).read_text())[KEY]["command"]


@pytest.mark.long
def test_an_experiment_that_fails_is_reported_and_the_others_run(tmp_path: Path) -> None:
    account = make([BAD, QUICK], tmp_path, small=True)
    assert account["bad"]["exit_code"] != 0
    assert "no_such_controller" in account["bad"]["last_text"]
    assert account["controllers"]["exit_code"] == 0
    notice: list[str] = []
    make([BAD], tmp_path, small=True, report_progress=lambda _part, phrase: notice.append(phrase))
    assert notice[0].startswith("runs"), "what failed is tried again"


@pytest.mark.long
def test_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["experiment", "all", "--list"]) == 0
    listed = capsys.readouterr().out
    assert all(f"safedpa experiment {part.phrase}" in listed for part in PARTS)
    assert safedpa.run(["experiment", "all"]) == 2
    assert "wanted a folder" in capsys.readouterr().err
    phrase = ["experiment", "all", "--small", "--only", "controllers", "--out", str(tmp_path / "new" / "all"), "--json"]
    assert safedpa.run(phrase) == 0
    reported = capsys.readouterr()
    assert json.loads(reported.out)["controllers"]["exit_code"] == 0
    assert "1 of 1: controllers: done" in reported.err


def reported(*phrase: str) -> str:
    found = CliRunner().invoke(command, list(phrase))
    assert isinstance(found.exception, InputError), found.output
    return str(found.exception)


@pytest.mark.parametrize("name", ["point", "point-heat-map", "point-relinearised", "point-story", "pendulum"])
def test_an_out_that_cannot_be_made_is_refused_before_anything_is_driven(name, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("safedpa.progress.progress", lambda *_: pytest.fail("work was begun"))
    monkeypatch.setattr(
        "safedpa_lab.experiments.point.heat_map.heat_map", lambda *_, **__: pytest.fail("work was begun")
    )
    (tmp_path / "file").touch()
    assert reported(name, "--out", str(tmp_path / "file" / "in")).startswith(
        f"--out {tmp_path / 'file' / 'in'}: cannot be"
    )


@pytest.mark.parametrize(
    "named", ["point --models", "point --baselines", "point-heat-map --models", "point-relinearised --models"]
)
def test_a_folder_that_is_named_and_not_there_is_not_replaced_by_what_ships(named, tmp_path) -> None:
    name, option = named.split()
    assert reported(name, option, str(tmp_path / "mistyped")) == (
        f"{option} {tmp_path / 'mistyped'}: got no folder that exists, wanted one; without {option} what ships is taken"
    )


ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a small experiment writes; no one changes it here."""
    out = tmp_path_factory.mktemp("written") / "theory.json"
    assert (
        safedpa.run(["experiment", "theory", "car_learned", "--states", "2000", "--seed", "4", "--out", str(out)]) == 0
    )
    return out


@pytest.fixture
def retained(written: Path, tmp_path: Path) -> Path:
    """A folder with a copy of it, to be changed."""
    shutil.copy(written, tmp_path)
    return tmp_path


def test_a_result_holds_how_to_make_it_again(written: Path) -> None:
    reported = json.loads(written.read_text())[KEY]
    assert reported["command"] == "safedpa experiment theory car_learned --states 2000 --seed 4"
    assert reported["date"][:2] == "20"
    assert reported["machine"]["cores"] >= 1
    assert {"safedpa.safety", "safedpa.dynamics", "safedpa.robots.car", "shipped models"} <= set(reported["code"])
    assert str(written.parent) not in json.dumps(reported)


def test_the_check_names_the_package_that_has_changed(retained: Path) -> None:
    (now,) = standings(retained)
    assert (now.changed, now.reported) == ((), "made by the current code")
    path = retained / "theory.json"
    document = json.loads(path.read_text())
    document[KEY]["code"]["safedpa.safety"] = "0" * 12
    document[KEY][CONTENT] = content_digest(document)
    path.write_text(json.dumps(document))
    (then,) = standings(retained)
    assert then.changed == ("safedpa.safety",)
    assert then.reported == f"older than its code in 1 of {then.rooms} packages"
    shown = CliRunner().invoke(results, ["check", str(retained), "--strict"], standalone_mode=False)
    assert "differ: safedpa.safety" in shown.output
    assert shown.return_value == 1


@pytest.mark.parametrize("place", ["figure", "command", "code"])
def test_a_result_that_was_edited_is_not_called_current(retained: Path, place: str) -> None:
    path = retained / "theory.json"
    document = json.loads(path.read_text())
    if place == "figure":
        document["seed"] = 5
    elif place == "command":
        document[KEY]["command"] += " --seed 5"
    else:
        document[KEY]["code"] = dict(document[KEY]["code"], **{"safedpa.safety": "0" * 12})
    path.write_text(json.dumps(document))
    (found,) = standings(retained)
    assert (found.reported, found.is_current) == ("edited since it was made", False)
    assert CliRunner().invoke(results, ["check", str(retained), "--strict"], standalone_mode=False).return_value == 1


def test_the_check_names_the_oldest_result(retained: Path) -> None:
    (retained / "old.json").write_text('{"date": "2026-11-21", "rows": []}')
    shown = CliRunner().invoke(results, ["check", str(retained)], standalone_mode=False)
    assert "the oldest is old.json, of 2026-11-21" in shown.output


def test_a_result_without_provenance_is_not_called_current(tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text('{"date": "2026-11-21", "rows": []}')
    (old,) = standings(tmp_path)
    assert (old.date, old.rooms, old.reported) == ("2026-11-21", 0, "made before provenance was recorded")
    assert CliRunner().invoke(results, ["check", str(tmp_path)], standalone_mode=False).return_value == 0
    assert CliRunner().invoke(results, ["check", str(tmp_path), "--strict"], standalone_mode=False).return_value == 1


def test_each_row_of_a_benchmark_is_checked_by_itself(retained: Path) -> None:
    reported = json.loads((retained / "theory.json").read_text())[KEY]
    (retained / "theory.json").write_text(json.dumps({"rows": {"new": {KEY: reported}, "old": {"name": "old"}}}))
    assert [(each.name, bool(each.rooms)) for each in standings(retained)] == [
        ("theory.json: new", True),
        ("theory.json: old", False),
    ]


def test_no_results_and_no_json_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="name the folder"):
        list(standings(tmp_path))
    (tmp_path / "torn.json").write_text("{")
    with pytest.raises(InputError, match="make it again"):
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
    (reported,) = standings(tmp_path)
    assert (reported.rooms, reported.changed, reported.date) == (0, (), None)
    assert CliRunner().invoke(results, ["check", str(tmp_path)], standalone_mode=False).return_value == 0


def test_every_package_differs_if_the_module_is_gone(retained: Path) -> None:
    path = retained / "theory.json"
    document = json.loads(path.read_text())
    document[KEY]["module"] = "safedpa_lab.of.long.ago"
    document[KEY]["code"] = {"safedpa_lab.of": "0" * 12}
    path.write_text(json.dumps(document))
    (then,) = standings(retained)
    assert "safedpa_lab.of" in then.changed
    assert len(then.changed) == then.rooms


def test_a_result_is_json_whatever_was_measured(tmp_path: Path) -> None:
    odd = {"a": math.nan, "b": [np.float32("inf"), np.int64(3)], "c": {"d": (-math.inf, 1.5, None, True)}}
    write_result(tmp_path / "odd.json", odd)
    document = json.loads((tmp_path / "odd.json").read_text(), parse_constant=pytest.fail)
    assert {key: document[key] for key in odd} == {"a": None, "b": [None, 3.0], "c": {"d": [None, 1.5, None, True]}}


def test_an_environment_within_another_project_bears_no_commit_of_that_project(tmp_path, monkeypatch) -> None:
    package = tmp_path / "env" / "safedpa"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (tmp_path / ".gitignore").write_text("env\n")
    own = ("-c", "user.name=a", "-c", "user.email=a@b")
    for phrase in (("init", "-q"), ("add", "."), (*own, "commit", "-q", "-m", "theirs")):
        subprocess.run(["git", *phrase], cwd=tmp_path, check=True, capture_output=True)
    monkeypatch.setattr(record.safedpa, "__file__", str(package / "__init__.py"))
    write_result(tmp_path / "odd.json", {})
    assert json.loads((tmp_path / "odd.json").read_text())[KEY]["commit"] is None


@pytest.mark.parametrize(
    ("phrase", "reported"),
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
def test_a_command_is_recorded_as_typed_without_folders(phrase: list[str], reported: str) -> None:
    notice: list[str] = []

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
        notice.append(command_line(click.get_current_context()))

    CliRunner().invoke(drive, phrase, prog_name="drive")
    assert notice == [reported]


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
    assert (code.without_text(before) == code.without_text(after)) is same


def test_code_that_is_only_named_counts_as_well() -> None:
    """Imports within functions, processes started by a module's name, robots found by theirs."""
    faults = set(code.code_behind("safedpa_lab.faults.experiment"))
    assert {"safedpa.robots.car.barriers.obstacles", "safedpa.safety.decision", "safedpa_lab.faults.campaign"} <= faults
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


CAR = "--models TMP/none --out TMP/results/car"


@pytest.mark.parametrize(
    ("phrase", "reported"),
    [
        ("safty", "did you mean 'safety'"), ("safety --suite none", "--suite"), ("safety --seeds 0", "more than 0"),
        ("adversary --only programms", "did you mean 'programs'"), ("adversary --workers 0", "wanted at least 1"),
        ("adversary --seed -1", "--seed"),
        ("hidden-effects --cases 0", "--cases"), ("hidden-effects --suite no", "--suite"),
        ("hidden-effects --seed -1", "--seed"), ("hidden-effects --out /no/where", "--out"),
        ("hidden-effects --horizons --suite none --page TMP/page.md", "--page"),
        ("safety-pays --hidden chairs", "--hidden"), ("safety-pays --seeds 0", "--seeds"),
        ("safety-pays --out /no/where/x.json", "--out"),
        (f"car {CAR} --method safdpa", "did you mean 'safedpa'"), (f"car {CAR} --method safedpa", "safedpa train car"),
        (f"car {CAR} --load sofa", "sofa"), (f"car {CAR} --part tables", "did you mean 'table'"),
        (f"car {CAR} --episodes 0", "wanted at least 1"), (f"car {CAR} --first-seed 4950", "wanted seeds from 0"),
        (f"car {CAR} --margin wide", "wanted 'conformal', 'theorem' or a number"),
        (f"car {CAR} --drive-ticks 30", "at least 120"), (f"car {CAR} --settings nowhere.toml", "nowhere.toml"),
        (f"car {CAR} --method physics --part equal-margin", "equal-margin"),
        (f"car {CAR} --family paper", "car_learned.toml is not in"),
        (f"car {CAR} --family papr", "family 'papr': did you mean 'paper'"),
        ("car --models TMP --out /proc/no/where", "choose another folder"),
        (f"car-curves {CAR} --sweep frictoin", "did you mean 'friction'"),
        (f"car-curves {CAR} --method safdpa", "did you mean 'safedpa'"),
        (f"car-curves {CAR} --family paper", "car_learned.toml is not in"),
        (f"car-curves {CAR} --episodes 0", "wanted at least 1"),
        (f"car-curves {CAR} --first-seed 4950", "wanted seeds from 0"),
        ("meeting --robots 9", "--robots: got 9, wanted 2 to 8"), ("meeting --seconds 0", "--seconds: got 0.0"),
        ("meeting --guard safe", "did you mean"), ("meeting --load sofa", "--load: got 'sofa'"),
        ("meeting --fastest 0", "--fastest: got 0.0"), ("meeting --out /nowhere/at/all.json", "create it"),
        ("margins --robot carr --out TMP/out", "--robot"), ("margins --kind both --out TMP/out", "--kind"),
        ("margins --drives 0 --out TMP/out", "--drives"), ("margins --minutes -1 --out TMP/out", "--minutes"),
        ("pendulum --directions=1", "--directions"), ("pendulum --episodes=0", "--episodes"),
        ("pendulum --seed=-1", "--seed"), ("pendulum --seed=200000", "seeds for evaluation"),
        ("pendulum --drives=20", "--drives"),
        ("pendulum --sweep-episodes=-1", "--sweep-episodes"), ("pendulum-story --hidden ghost", "--hidden"),
        ("point --methods cppo", "did you mean"),
    ],
)  # fmt: skip
def test_what_no_experiment_can_do_is_refused_in_one_line_and_leaves_no_folder(phrase, reported, tmp_path, capsys):
    assert safedpa.run(["experiment", *phrase.replace("TMP", str(tmp_path)).split()]) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert reported.lower() in shown.err.lower()
    assert list(tmp_path.iterdir()) == []
