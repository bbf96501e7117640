"""The systemd units are valid, and each service accepts the options of its options file."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[2] / "deploy" / "systemd"
UNIT = (FOLDER / "safedpa@.service").read_text(encoding="utf-8")
ROBOT = """
format = 2
robot = "car"
[odometry]
topic = "/odom"
[command]
topic = "/drive"
[surroundings]
field = [-4, 4, -4, 4]
footprint = [0.1, 0.4, 0.1]
"""
SERVICES = sorted(path.stem for path in FOLDER.glob("*.env") if path.stem != "loop")


def _values(name: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for line in (FOLDER / f"{name}.env").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            key, _, value = line.partition("=")
            (found[key],) = shlex.split(value)
    return found


def test_every_service_of_a_loop_has_its_options() -> None:
    wanted = ["adaptation", "diagnosis", "perception", "policy", "recorder", "ros_gateway", "router", "safety_filter"]
    assert wanted == SERVICES
    for name in SERVICES:
        options = _values(name)["OPTIONS"].split()
        assert name == "router" or options[:2] == ["--role", "robot.r1" if name == "ros_gateway" else name]


@pytest.mark.long
def test_every_service_understands_its_options(tmp_path: Path) -> None:
    started = {}
    (tmp_path / "robot.toml").write_text(ROBOT, encoding="utf-8")
    for name in SERVICES:
        values = _values("loop") | _values(name)
        phrase = re.sub("/(etc|var/lib)/safedpa", str(tmp_path), f"{values['LOOP']} {values['OPTIONS']}").split()
        phrase.remove("--realtime") if "--realtime" in phrase else None  # not on a machine that runs tests
        command = [sys.executable, "-m", f"safedpa_services.{name}", *phrase]
        started[name] = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    for name, process in started.items():
        notice, _ = process.communicate(timeout=60)
        assert process.returncode == 2, (name, notice)
        assert "usage:" not in notice, (name, notice)
        assert str(tmp_path / "certificates") in notice, (name, notice)  # what stops it is that no one made any


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
def test_systemd_itself_finds_nothing_wrong(tmp_path: Path) -> None:
    text = UNIT.replace("/opt/safedpa/bin/python", sys.executable).replace("User=safedpa", "User=root")
    (tmp_path / "safedpa@policy.service").write_text(text, encoding="utf-8")
    shutil.copy(FOLDER / "safedpa.target", tmp_path)
    units = [tmp_path / "safedpa@policy.service", tmp_path / "safedpa.target"]
    plain = {**os.environ, "SYSTEMD_LOG_LEVEL": "warning"}
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *units], capture_output=True, text=True, check=False, env=plain
    )
    about = [line for line in (done.stdout + done.stderr).splitlines() if "safedpa" in line]
    assert done.returncode == 0 or not about, about


def test_a_service_has_minimal_rights_and_is_restarted() -> None:
    wanted = "NoNewPrivileges=yes ProtectSystem=strict CapabilityBoundingSet= Restart=always User=safedpa"
    assert {*wanted.split()} <= {*UNIT.splitlines()}
