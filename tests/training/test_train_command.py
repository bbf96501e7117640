"""``safedpa train``: phases in order, existing results are skipped, user robots, one line per error."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from safedpa.dynamics import LearnedBase, load_model
from safedpa.networks import Weights, load_weights
from safedpa.systems.robots import forget_robot
from safedpa_services.command_line.group import safedpa
from safedpa_sim.training import pipeline
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.networks.modules import HistoryNetwork, tensors_of
from safedpa_sim.training.pipeline import run_pipeline

FEW = ["train", "car", "--small", "--pairs", "4096"]


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    torch.set_num_threads(1)
    code = safedpa.run([*arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def trained(capsys: pytest.CaptureFixture[str], out: Path, *more: str) -> dict[str, Any]:
    code, printed, error = run(capsys, *FEW, "--phases", "1a", "--out", str(out), "--json", *more)
    assert (code, error) == (0, ""), "no bar in a pipe"
    return json.loads(printed)["1a"]


def test_training_writes_a_model_that_every_command_accepts(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    record = trained(capsys, tmp_path / "new" / "car")
    assert (record["file"], record["pairs"], len(record["explained"])) == ("car_simulated.safetensors", 4096, 4)
    model = load_model(tmp_path / "new" / "car" / "car_simulated.toml")
    assert model.latent_names == ("base.latent_0", "base.latent_1", "base.latent_2", "base.latent_3")
    retained = json.loads((tmp_path / "new" / "car" / "progress.json").read_text())["1a"]
    assert retained == record
    assert retained["seconds"] > 0.0
    assert retained["seed"] == 0


def test_existing_results_are_not_computed_again(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    first = trained(capsys, tmp_path)
    assert "skipped" not in first
    assert trained(capsys, tmp_path) == {**first, "skipped": True}
    other = trained(capsys, tmp_path, "--seed", "5")
    assert "skipped" not in other
    assert other["digest"] != first["digest"]
    (tmp_path / "car_simulated.safetensors").unlink()
    assert "skipped" not in trained(capsys, tmp_path, "--seed", "5")


def test_a_person_sees_a_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, printed, _ = run(capsys, *FEW, "--phases", "1a", "--out", str(tmp_path))
    assert code == 0
    assert "1a" in printed
    assert "speed " in printed
    code, printed, _ = run(capsys, *FEW, "--phases", "1a", "--out", str(tmp_path))
    assert "skipped" in printed


MISTAKES = [
    (["--phases", "1a,4"], "phase '4': known: 1a, 1b, 2, 3, ablations"),
    (["--phases", ""], "--phases: got none, wanted one or more of 1a, 1b, 2, 3, ablations"),
    (["--phases", "2"], "phase 2: no "),
    (["--device", "abacus"], "--device abacus: no such kind of device; wanted cpu or cuda"),
    (["--configuration", "car"], "--small, --configuration: got both, wanted one"),
    (["--pairs", "0"], "Invalid value for '--pairs'"),
    (["a.csv"], "RUN, --weights, --columns: got them without --tune"),
    (["--weights", "w.safetensors"], "RUN, --weights, --columns: got them without --tune"),
    (["--tune"], "--tune: wanted RUN... and --weights FILE"),
    (["--tune", "a.csv"], "--tune: wanted RUN... and --weights FILE"),
    (["--what", "all", "--tune", "a.csv", "--weights", "none.safetensors"], "none.safetensors: "),
]


@pytest.mark.parametrize(("options", "message"), MISTAKES, ids=[" ".join(item[0]) for item in MISTAKES])
def test_a_mistake_gets_one_line(options, message, capsys, tmp_path) -> None:
    code, printed, error = run(capsys, *FEW, "--out", str(tmp_path / "out"), *options)
    assert (code, printed) == (2, "")
    assert error.startswith(f"safedpa: {message}")
    assert error.count("\n") == 1


def test_a_damaged_record_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "progress.json").write_text("{")
    code, _, error = run(capsys, *FEW, "--phases", "1a", "--out", str(tmp_path))
    assert code == 2
    assert "progress.json: cannot be read" in error


def adding(name: str, calls: list[str]) -> Any:
    """A fake phase that adds one tensor under its network's name and records its input."""

    def train(configuration: Any, weights: Weights, out: Path, report_progress: Any, device: str, **options: Any):
        del configuration, out, report_progress, device
        calls.append(
            " ".join([name, *sorted(n for n in ("mu", "phi", "policy") if weights.has(n)), *map(str, options)])
        )
        shapes: dict[str, dict[str, Any]] = {
            "policy": {"policy.0.weight": [[1.0]], "policy.0.bias": [0.0]},
            "phi": dict(tensors_of(HistoryNetwork(9, weights.description.history, 4))),
        }
        return weights.with_tensors(shapes[name]), {"loss": 0.5}

    return train


@pytest.mark.long
def test_later_phases_start_from_the_results_of_earlier_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    known = {"train_policy": "policy", "train_history_encoder": "phi", "tune": "phi"}
    monkeypatch.setattr(pipeline, "phase_function", lambda _module, name: adding(known[name], calls))
    configuration = load_configuration("car_small")
    torch.set_num_threads(1)
    records = run_pipeline(configuration, tmp_path, ("3", "2", "1b", "1a"))
    assert calls == ["policy mu", "phi mu policy", "phi mu phi policy"]
    assert not any("skipped" in record for record in records.values())
    calls.clear()
    again = run_pipeline(configuration, tmp_path)
    assert calls == ["policy mu phi name penalty with_filter"], "RMA-P alone is new, and does not see the other policy"
    assert [name for name, record in again.items() if "skipped" not in record] == ["fix", "mix", "rma_p"]
    assert load_weights(tmp_path / "car_rma_p.safetensors").has("policy")
    assert load_weights(tmp_path / "car_learned.safetensors").has("phi")
    # a longer history invalidates phase 2 only
    calls.clear()
    longer = run_pipeline(replace(configuration, history=68), tmp_path, ("1a", "1b", "2"))
    assert calls == ["phi mu policy"]
    assert [name for name, record in longer.items() if "skipped" in record] == ["1a", "1b"]
    assert load_weights(tmp_path / "car_simulated.safetensors").description.history == 68
    # a new policy invalidates the history encoder, which was trained on drives of the old one
    calls.clear()
    longer = replace(configuration, phase_1b=replace(configuration.phase_1b, steps=1 + configuration.phase_1b.steps))
    run_pipeline(longer, tmp_path, ("1b",))
    assert calls == ["policy mu"]
    assert not load_weights(tmp_path / "car_simulated.safetensors").has("phi")


EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "cleaner"
OWN = [
    "train", "cleaner", "--robot-file", str(EXAMPLE / "cleaner.py"),
    "--configuration", str(EXAMPLE / "learned.toml"), "--json",
]  # fmt: skip


@pytest.fixture(autouse=True)
def _strangers_leave():
    torch.set_num_threads(1)
    yield
    forget_robot("cleaner")


@pytest.mark.long
def test_a_user_robot_trains_dynamics_and_history(capsys, tmp_path) -> None:
    code = safedpa.run([*OWN, "--out", str(tmp_path)])
    printed = capsys.readouterr()
    assert (code, printed.err) == (0, "")
    records = json.loads(printed.out)
    assert set(records) == {"1a", "2"}
    ahead, _, turned = records["1a"]["explained"]  # it hardly moves sideways
    assert min(ahead, turned) > 0.98
    assert min(records["2"]["explained"]) > 0.3
    model = load_model(tmp_path / "cleaner_learned.toml")
    assert isinstance(model.base, LearnedBase)
    assert model.base.weights.has("phi")


def test_what_is_missing_is_reported_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments, reported in (
        ([*OWN, "--phases", "1b"], "1b"),
        (["train", "cleane", *OWN[2:4]], "did you mean 'cleaner'"),
        (["train", "cleaner", *OWN[2:4]], "wanted a configuration"),
        (["train", "drone"], "--robot-file FILE.py loads one of your own"),
    ):
        code = safedpa.run([*arguments, "--out", str(tmp_path)])
        error = capsys.readouterr().err
        assert code == 2
        assert reported in error
        assert len(error.strip().splitlines()) == 1
