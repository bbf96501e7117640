"""Every Python block of the README, the tutorials and the guides runs in some test; those of several pages run here."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import Setting, load_model, save_model
from safedpa.effects import effect
from safedpa.records import Run, Stretch, write_csv

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
ELSEWHERE = {
    "README.md": "deploy/test_installation.py, tests/architecture/test_extras.py, tests/docs/test_notebooks.py",
    "docs/guides/barriers.md": "tests/safety/test_safety_docs.py",
    "docs/guides/column-maps.md": "tests/records/test_column_maps_page.py",
    "docs/guides/gymnasium.md": "tests/safety/test_safety_docs.py",
    "docs/guides/margins.md": "tests/safety/test_safety_docs.py",
    "docs/guides/replay.md": "tests/replay/test_recorded_files.py",
    "docs/guides/safety.md": "tests/safety/test_safety_docs.py",
}
HERE = ("compare", "fleet-diagnosis", "implausible-states", "own-system", "sensing", "workbench")
FEW = ("quadratic_drag", "rolling_resistance", "steering_offset")


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def run(page: str, names: dict[str, Any]) -> dict[str, Any]:
    for number, block in enumerate(blocks(DOCS / "guides" / f"{page}.md")):
        exec(compile(block, f"docs/guides/{page}.md, block {number}", "exec"), names)
    return names


def test_each_page_with_code_is_run_by_a_test() -> None:
    pages = [ROOT / "README.md", *(DOCS / "tutorials").glob("*.md"), *(DOCS / "guides").glob("*.md")]
    with_code = {str(page.relative_to(ROOT)) for page in pages if any("(..." not in block for block in blocks(page))}
    assert with_code == {*ELSEWHERE, *(f"docs/guides/{name}.md" for name in HERE)}
    for page, tests in ELSEWHERE.items():
        for test in tests.split(", "):
            text = (ROOT / "tests" / test.removeprefix("tests/")).read_text(encoding="utf-8")
            assert page.rpartition("/")[2].removesuffix(".md") in text, test


def driven(seed: int, seconds: float = 20.0) -> Run:
    """A car with a bent steering, which its model does not know."""
    draw, given = np.random.default_rng(seed), load_model("car")
    model = given.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.06)})
    rows = round(seconds / model.period)
    actions = np.repeat(draw.uniform((0.3, -0.3), (1.8, 0.3), (rows // 10 + 1, 2)), 10, axis=0)[:rows]
    states = np.zeros((rows, 4))
    memory = model.initial_memory(actions[0])
    for row in range(rows - 1):
        states[row + 1], memory = model.advance(
            states[row], actions[row], memory, period=model.period, time=row * model.period
        )
    measured = states + draw.normal(0.0, 1.0, states.shape) * (0.002, 0.002, 0.003, 0.015)
    return Run(f"run{seed}", given.system, model.period * np.arange(rows), measured, actions, (Stretch(0, rows),))


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """``drive.csv`` in the working directory."""
    monkeypatch.chdir(tmp_path)
    found = driven(1)
    write_csv(found, tmp_path / "drive.csv")
    return found


def test_the_blocks_about_implausible_states_latch_and_confirm_as_their_remarks_say() -> None:
    found = run("implausible-states", {})
    session = found["session"]
    assert session.latched == ""
    assert session.decide([0.0, 0.4], [0.0]).status.value == "passed", "what a person vouched for is believed"


def test_the_blocks_about_comparing_print_a_summary_and_errors(drive: Run, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is an extra")
    pytest.importorskip("pandas", reason="pandas is an extra")
    found = run("compare", {"runs": [drive], "candidates": [load_model("car")] * 2})
    assert "The state predicted worst is" in capsys.readouterr().out
    assert found["errors"][0] == found["errors"][1] > 0.0


def test_the_blocks_about_a_system_of_ones_own_declare_it() -> None:
    from safedpa.effects import general_effects
    from safedpa.systems import System, Variable

    found = run("own-system", {"System": System, "Variable": Variable, "general_effects": general_effects})
    assert found["BALL"].name == "ball"
    assert len(found["EFFECTS"]) > 5


def test_the_block_about_the_body_of_a_robot_prints_its_motion(capsys: pytest.CaptureFixture[str]) -> None:
    found = run("sensing", {})
    assert capsys.readouterr().out == f"{found['body'].motion.name}\n"
    assert f"    {found['body'].motion.name}\n" in (DOCS / "guides" / "sensing.md").read_text(encoding="utf-8")


@pytest.mark.long
def test_the_block_of_the_workbench_adds_the_effect(
    drive: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    del drive
    library = [effect("car", name) for name in FEW]
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: library)
    run("workbench", {})
    assert [item.name for item in load_model(tmp_path / "model.toml").effects][-1] == "steering_offset"


@pytest.mark.long
@pytest.mark.processes
def test_the_block_of_a_fleet_prints_its_groups(tmp_path: Path) -> None:
    """As a script: its processes import it again."""

    save_model(load_model("car"), tmp_path / "car.toml")
    for robot in ("r1", "r2"):
        folder = tmp_path / "recordings" / robot
        folder.mkdir(parents=True)
        write_csv(driven(int(robot[1:]), 8.0), folder / "drive.csv")
    (tmp_path / "script.py").write_text(blocks(DOCS / "guides" / "fleet-diagnosis.md")[0], encoding="utf-8")
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.fullmatch(r"\[.*\]\n", done.stdout), done.stdout
    assert (tmp_path / "out" / "fleet.json").exists()
