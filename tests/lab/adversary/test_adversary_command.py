"""``safedpa experiment adversary``: it reports what it finds, repeats by its seed, and names what it ran."""

import json

import pytest

from safedpa_lab.experiments.adversary.campaign import adversary, adversary_markdown, all_attacks, attacks_named
from safedpa_lab.experiments.adversary.linear.problem import LinearProblem
from safedpa_lab.experiments.adversary.programs import Programs
from safedpa_services.command_line.group import safedpa


def run(*arguments):
    return safedpa.run(["experiment", "adversary", *map(str, arguments)])


def test_the_attacks_are_listed(capsys):
    assert run("--list") == 0
    shown = capsys.readouterr().out
    assert [line.split()[0] for line in shown.splitlines()] == [attack.name for attack in all_attacks()]


def test_one_attack_is_reported_as_a_document_and_in_files(tmp_path, capsys):
    out = tmp_path / "found"
    assert run("--only", "programs", "--small", "--seed", 4, "--workers", 1, "--out", out, "--json") == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert shown.err == ""
    kept = json.loads((out / "adversary.json").read_text())
    assert kept.pop("provenance")["command"] == "safedpa experiment adversary --only programs --small --seed 4"
    assert (found, found["command"]) == (kept, "safedpa experiment adversary --only programs --small --seed 4")
    assert (found["seed"], found["small"], len(found["code"])) == (4, True, 12)
    (attack,) = found["attacks"]
    assert attack["name"] == "programs"
    assert attack["held"] + attack["failed"] == sum(row["held"] is not None for row in attack["rows"])
    assert sum(row["measured"] for row in attack["rows"] if row["what"].startswith("answers ")) == 330
    page = (out / "adversary.md").read_text()
    assert "| passed or corrected, condition broken |" in page
    assert found["code"] in page


@pytest.fixture
def _few_programs(monkeypatch):
    """The tests below look at what becomes of figures: 40 problems are enough."""
    monkeypatch.setattr(Programs, "pieces", lambda _self, seed, _small: [(seed, 0, 40)])


@pytest.mark.long
@pytest.mark.usefixtures("_few_programs")
def test_parts_run_into_one_folder_become_one_page(tmp_path, capsys):
    out = tmp_path / "found"
    for name in ("programs", "inputs", "programs"):
        assert run("--only", name, "--small", "--seed", 4, "--workers", 1, "--out", out) == 0
    found = json.loads((out / "adversary.json").read_text())
    assert [attack["name"] for attack in found["attacks"]] == ["inputs", "programs"], "in the order of the list"
    assert found["command"] == "safedpa experiment adversary --only inputs --only programs --small --seed 4"
    assert run("--only", "inputs", "--small", "--seed", 5, "--workers", 1, "--out", out) == 0
    found = json.loads((out / "adversary.json").read_text())
    assert [attack["name"] for attack in found["attacks"]] == ["inputs"], "another seed is another page"
    capsys.readouterr()


@pytest.mark.long
@pytest.mark.usefixtures("_few_programs")
def test_finished_attacks_are_kept_if_a_run_is_interrupted(tmp_path, monkeypatch, capsys):
    def ended(self, answers):
        raise KeyboardInterrupt

    monkeypatch.setattr(Programs, "reported", ended)
    names = ("--only", "inputs", "--only", "programs")
    assert run(*names, "--small", "--seed", 4, "--workers", 1, "--out", tmp_path) != 0
    found = json.loads((tmp_path / "adversary.json").read_text())
    assert [attack["name"] for attack in found["attacks"]] == ["inputs"]
    capsys.readouterr()


@pytest.mark.long
def test_the_same_seed_finds_the_same_with_any_number_of_processes():
    def figures(workers, seed):
        found = adversary(attacks_named(["programs"]), seed, small=True, workers=workers)
        return [(row["what"], row["measured"]) for row in found["attacks"][0]["rows"]]

    found = figures(1, 2)
    assert found == figures(2, 2)
    assert found != figures(1, 3)


def test_findings_do_not_change_the_exit_code(monkeypatch, capsys):
    def raises(self):
        raise RuntimeError("planted")

    monkeypatch.setattr(LinearProblem, "decide", raises)
    assert run("--only", "programs", "--small", "--workers", 1) == 0
    assert "| raised an exception | 330 | 330 | at most 0 | **not held** |" in capsys.readouterr().out


def test_a_page_says_which_figures_held():
    rows = [{"what": "a", "measured": 1.0, "of": 2000, "asked": "at most 0", "unit": "", "held": False}]
    attack = {"name": "n", "sentence": "what it is", "seconds": 1.0, "held": 0, "failed": 1, "rows": rows}
    page = adversary_markdown({"date": "d", "seed": 1, "small": False, "code": "c", "attacks": [attack]})
    assert "What it is. 0 of 1 figures are as asked (1 s)." in page
    assert "| a | 1 | 2,000 | at most 0 | **not held** |" in page
