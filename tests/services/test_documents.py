"""The documents of ``--json`` have the parts that were recorded: a program that reads them finds each of them.

``documents.json`` has them; after a change that is meant, the failing test prints the new one.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from safedpa_services.command_line.group import safedpa

RECORD = Path(__file__).with_name("documents.json")
ROOT = Path(__file__).resolve().parents[2]
DRIVE = ROOT / "tests" / "replay" / "golden" / "car_box.mcap"
COMMANDS = {
    "calibrate": "calibrate drive.mcap --coverage 0.9 --out margin.toml",
    "certificates": "certificates keys --robot r1",
    "check": "check drone.py",
    "columns": "columns drive.csv --robot car",
    "compare": "compare car drive.csv --out compared",
    "diagnose --check": "diagnose car drive.csv --check",
    "effects": "effects --robot point",
    "export": "export drive.mcap --format parquet --out drive.parquet",
    "export simulators": "export pendulum --format simulators --out simulators",
    "from-collision-monitor": "ros from-collision-monitor nav2.yaml --out robot.toml --endpoint tcp/robot:7447",
    "predict": "predict car drive.csv --horizon 0.5 --out predicted.csv",
    "replay": "replay drive.mcap",
    "results": "results check results",
}
NAV2 = """\
collision_monitor:
  ros__parameters:
    base_frame_id: "base_footprint"
    odom_frame_id: "odom"
    cmd_vel_in_topic: "cmd_vel_smoothed"
    cmd_vel_out_topic: "cmd_vel"
    polygons: ["Stop"]
    Stop:
      type: "circle"
      radius: 0.3
      action_type: "stop"
      min_points: 4
    observation_sources: ["scan"]
    scan:
      type: "scan"
      topic: "scan"
      source_timeout: 0.2
"""


def parts(document: Any) -> Any:
    """The names in a document; of a list, those of its first entry."""
    if isinstance(document, dict):
        return {name: parts(value) for name, value in document.items()}
    return [parts(document[0])] if isinstance(document, list) and document else ""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("documents")
    shutil.copy(DRIVE, place / "drive.mcap")
    for name in ("drone.py", "drone.toml"):
        shutil.copy(ROOT / "docs" / "examples" / "drone" / name, place)
    (place / "nav2.yaml").write_text(NAV2, encoding="utf-8")
    (place / "results").mkdir()
    shutil.copy(ROOT / "docs" / "evidence" / "results" / "tuning.json", place / "results")
    assert safedpa.run(["export", str(place / "drive.mcap"), "--format", "csv", "--out", str(place / "drive.csv")]) == 0
    return place


@pytest.mark.parametrize("name", COMMANDS)
def test_a_document_has_the_recorded_parts(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    safedpa.run([*COMMANDS[name].split(), "--json"])
    found = parts(json.loads(capsys.readouterr().out))
    assert found == json.loads(RECORD.read_text(encoding="utf-8"))[name]
