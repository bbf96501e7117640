"""The pendulum's loop as the user starts it, and compare and diagnose with its recording."""

import pytest
from tests.services.drives import drive, run

from safedpa.dynamics import Setting, load_model, save_model
from safedpa.effects import effect


@pytest.mark.processes
@pytest.mark.long
def test_the_pendulum_is_safe_and_its_recording_compares_and_is_diagnosed(tmp_path, monkeypatch):
    """With a library of two effects, to save time."""
    two = [effect("pendulum", name) for name in ("coulomb_friction", "viscous_friction")]
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: two)
    swing = ("--robot", "pendulum", "--wind", "4", "--wind-direction", "135", "--seed", "1", "--seconds", "6")
    summary = drive(tmp_path, *swing)
    assert summary["ticks"] == 600
    assert summary["collisions"] == 0
    assert summary["task"] == "balance"
    assert set(summary["verdicts"]) == {"corrected", "passed"}
    assert summary["verdicts"]["corrected"] > 100
    recording, report = summary["recording"], tmp_path / "report"
    still = run("compare", "pendulum", recording, "--horizon", "0.2", "--out", str(report))
    model, blown = load_model("pendulum"), tmp_path / "blown.toml"
    blowing = {"wind.speed": Setting(-(8**0.5)), "wind.upward": Setting(8**0.5)}
    save_model(model.with_settings({**model.settings, **blowing}), blown)
    reported = run("compare", str(blown), recording, "--horizon", "0.2", "--out", str(report), "--force")
    assert still["runs"][0]["windows"] == reported["runs"][0]["windows"] > 40
    assert reported["runs"][0]["error"] < 0.01
    assert still["runs"][0]["error"] > 0.5
    diagnosed = run("diagnose", "pendulum", recording, "--horizon", "0.2", "--out", str(report))
    assert diagnosed["robot"] == "pendulum"
    assert (report / "report.html").stat().st_size > 1000
    unfiltered = drive(tmp_path, *swing, "--no-filter")
    assert unfiltered["collisions"] > 0
    assert unfiltered["collision_list"][0]["what"] in ("lower edge", "upper edge")
