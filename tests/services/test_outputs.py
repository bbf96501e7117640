"""A command ends without a traceback, whatever its outputs are; what it writes is on disk before it prints."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HEADER = "t,x,y,yaw,speed,target_speed,steer,°ψ速"
ROWS = "".join(f"{k / 20},{k / 20},0,0,1,1,{0.1 * (k // 20 % 2)},0\n" for k in range(200))
COMPARE = ("compare", "car", "drive.csv", "--out", "report")


def run(folder: Path, *arguments: str, stdout: int | None = subprocess.PIPE, **settings: str):
    (folder / "drive.csv").write_text(f"{HEADER}\n{ROWS}", encoding="utf-8")
    command = [sys.executable, "-m", "safedpa_services", *arguments]
    environment = {**os.environ, **settings}
    return subprocess.run(command, cwd=folder, env=environment, stdout=stdout, stderr=subprocess.PIPE, check=False)


@pytest.mark.parametrize(
    "settings",
    [{"PYTHONIOENCODING": name} for name in ("latin-1", "cp1252", "ascii")] + [{"COLUMNS": "0"}, {"COLUMNS": "40"}],
    ids=lambda settings: "".join(settings.values()),
)
def test_any_terminal_shows_the_names_of_a_file(settings: dict[str, str], tmp_path: Path) -> None:
    done = run(tmp_path, "columns", "drive.csv", **settings)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"# Columns of the log: t, x")
    assert run(tmp_path, "columns", "速度.csv", **settings).stderr.count(b"\n") == 1


@pytest.mark.parametrize("arguments", [COMPARE, ("effects",), ("--help",)], ids=lambda arguments: arguments[0])
@pytest.mark.parametrize("kind", ["full", "closed"])
def test_an_output_that_takes_nothing_ends_the_command_in_one_line(kind: str, arguments, tmp_path: Path) -> None:
    if kind == "full":
        output = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, output = os.pipe()
        os.close(reading)
    try:
        done = run(tmp_path, *arguments, stdout=output)
    finally:
        os.close(output)
    assert done.returncode == 1
    assert done.stderr.count(b"\n") <= 1
    assert b"Traceback" not in done.stderr
    assert (b"cannot print" in done.stderr) is (kind == "full")
    if arguments is COMPARE:
        assert (tmp_path / "report" / "compare.html").is_file()
        assert (tmp_path / "report" / "compare.json").is_file()
