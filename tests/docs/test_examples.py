"""The examples of the gallery run, and do what their pages say."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
EXAMPLES = DOCS / "examples"
GALLERY = (DOCS / "tutorials" / "gallery.md").read_text(encoding="utf-8")


def run(name: str, *arguments: Any, **named: Any) -> str:
    return str(runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]([str(a) for a in arguments], **named))


@pytest.mark.long
def test_a_plain_distance_stalls_the_unicycle_and_a_point_ahead_lets_it_pass(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is an extra")
    plain, ahead, _, issue, note = run("unicycle_among_discs", tmp_path / "a.png").strip().split("\n")
    assert float(re.findall(r"ends at ([\d.]+)", plain)[0]) < 1.0
    assert float(re.findall(r"ends at ([\d.]+)", ahead)[0]) > 2.9
    assert issue.startswith("- stall:")
    assert note.startswith("Note (decision):")
    assert f"    {plain}\n    {ahead}\n" in GALLERY
    assert (tmp_path / "a.png").stat().st_size > 5000


@pytest.mark.long
def test_a_learner_behind_the_filter_never_collides() -> None:
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is an extra")
    without, behind = run("train_behind_the_filter", steps=500).splitlines()
    assert not without.startswith("no filter: 0 ")
    assert behind.startswith("filter: 0 collisions")


def test_each_environment_of_a_vector_is_filtered() -> None:
    pytest.importorskip("gymnasium", reason="gymnasium is an extra")
    printed = run("vector_environment")
    assert float(re.findall(r"position ([\d.]+) m", printed)[0]) < 1.0
    assert "'corrected'" in printed


@pytest.mark.long
def test_a_bag_leads_to_the_wrong_track(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is an extra")
    printed = run("read_a_bag", tmp_path)
    assert printed.startswith("The model lacks track_error.")
    assert float(re.findall(r"ratio ([\d.]+)", printed)[0]) == pytest.approx(1.15, abs=0.01)


@pytest.mark.long
def test_both_robots_in_a_file_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is an extra")
    drawing = runpy.run_path(str(DOCS / "draw_examples.py"))
    for name in ("cleaner", "quadrotor", "notebook"):
        drawing[f"draw_{name}"](tmp_path / f"{name}.png")
    states, _ = drawing["path_of"]("quadrotor/quadrotor.py", "Quadrotor", 3.0, (12.0, 0.0, 0.0, 0.0))
    assert states[:, 2].max() < 3.0
    assert all(path.stat().st_size > 5000 for path in tmp_path.glob("*.png"))


def test_each_example_of_the_gallery_has_its_picture() -> None:
    shown = set(re.findall(r"\(\.\./pictures/examples/(\w+)\.png\)", GALLERY))
    assert shown == {path.stem for path in (DOCS / "pictures" / "examples").glob("*.png")}


@pytest.mark.long
def test_the_picture_of_the_readme_is_drawn_by_its_command(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is an extra")
    drawing = runpy.run_path(str(DOCS / "draw_drives.py"))
    drawing["animate"](tmp_path / "drives.gif", seconds=2.0)
    assert (tmp_path / "drives.gif").read_bytes()[:3] == b"GIF"
    assert (DOCS / "pictures" / "drives.gif").stat().st_size < 2_000_000
