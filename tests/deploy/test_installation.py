"""Builds wheel and source distribution, and tests a plain installation in an empty environment."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "deploy"))

from install_size import size_of
from python_versions import interpreters

pytestmark = [pytest.mark.long, pytest.mark.slow]

FOREIGN = ("torch", "plotly", "rerun", "pymunk", "pyarrow", "jinja2", "nicegui", "matplotlib", "gymnasium")
"""What the core must not bring. Of scipy nothing is imported; it comes because piqp's metadata ask for it."""
PYTHONS = list(interpreters().values())
MOST_MEGABYTES = 200
"""Largest installation of the filter alone, next to pip."""


PIP = (sys.executable, "-m", "pip", "--quiet", "--no-input")


def _run(*command: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    plain |= {"SAFEDPA_COMPILE": "0", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    phrase = [str(part) for part in command]
    return subprocess.run(phrase, capture_output=True, text=True, check=False, cwd=cwd, env=plain)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> tuple[Path, Path]:
    """(wheel, source distribution) of the working tree; skips the test if hatchling is not available."""
    folder = tmp_path_factory.mktemp("built")
    tools, out = folder / "tools", folder / "out"
    hatchling = re.search(r"hatchling==[\d.]+", (repository / "pyproject.toml").read_text(encoding="utf-8"))
    assert hatchling
    done = _run(*PIP, "install", "--target", tools, hatchling[0])
    if done.returncode != 0:
        pytest.skip(f"no package index answers: {done.stderr.strip().splitlines()[-1]}")
    build = (
        "import sys; sys.path.insert(0, sys.argv[1]); del sys.argv[1]; from hatchling.cli import hatchling; hatchling()"
    )
    done = _run(sys.executable, "-c", build, tools, "build", "-d", out, cwd=repository)
    assert done.returncode == 0, done.stderr
    (wheel,), (source,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, source


def test_the_wheel_holds_all_three_packages_and_what_ships_with_them(built: tuple[Path, Path]) -> None:
    names = zipfile.ZipFile(built[0]).namelist()
    packages = {name.split("/")[0] for name in names if not name.startswith("safedpa-")}
    assert packages == {"safedpa", "safedpa_services", "safedpa_sim"}
    assert {".toml", ".safetensors", ".typed", ".py"} <= {Path(name).suffix for name in names}
    assert "safedpa/native/module.c" in names
    assert not [name for name in names if "__pycache__" in name or name.endswith((".pyc", ".so"))]


def test_the_source_distribution_can_be_built_from(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[1]) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    assert {"pyproject.toml", "hatch_build.py", "README.md", "LICENSE", "constraints.txt"} <= names
    assert not [name for name in names if name.startswith((".venv", "runs/", "build/"))]


@pytest.mark.parametrize("interpreter", PYTHONS)
def test_the_core_installs_into_an_empty_environment_and_the_readme_runs(interpreter, built, repository, tmp_path):
    done = _run(interpreter, "-m", "venv", "--without-pip", tmp_path / "empty")
    if done.returncode != 0:
        pytest.skip(f"{interpreter}: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
    python = tmp_path / "empty" / "bin" / "python"
    pip = (*PIP, "--python", python)
    done = _run(*pip, "install", "--no-compile", "--constraint", repository / "constraints.txt", built[0])
    if done.returncode != 0 and re.search(r"No matching distribution|Could not fetch|Connection", done.stderr):
        pytest.skip(f"no package index answers: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    listed = _run(python, "-c", f"import importlib.util as u; print([n for n in {FOREIGN!r} if u.find_spec(n)])")
    assert listed.stdout.strip() == "[]"
    assert _run(*pip, "uninstall", "--yes", "scipy").returncode == 0

    code = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    filtered = _run(python, "-c", "import safedpa.safety\n" + code[0], cwd=tmp_path)
    assert filtered.stdout.startswith("corrected"), filtered.stderr
    program = python.with_name("safedpa")
    assert "steering_offset" in _run(program, "effects", "--robot", "car", cwd=tmp_path).stdout
    asked = _run(program, "up", cwd=tmp_path)
    assert (asked.returncode, asked.stderr.count("\n")) == (2, 1), asked.stderr
    assert "pip install 'safedpa[sim]'" in asked.stderr
    for service in ("adaptation", "policy", "safety_filter", "recorder"):
        assert _run(python, "-m", f"safedpa_services.{service}", "--help").returncode == 0, service


def test_the_filter_alone_installs_in_200_megabytes_and_its_guide_runs(built, repository, tmp_path):
    python = tmp_path / "empty" / "bin" / "python"
    assert _run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "empty").returncode == 0
    pinned = ("--constraint", repository / "constraints.txt")
    packages = ("--requirement", repository / "deploy" / "filter-only.txt", built[0])
    done = _run(*PIP, "--python", python, "install", "--no-compile", "--no-deps", *pinned, *packages)
    if done.returncode != 0 and re.search(r"No matching distribution|Could not fetch|Connection", done.stderr):
        pytest.skip(f"no package index answers: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    absent = (*FOREIGN, "scipy", "zenoh", "mcap", "cryptography")
    listed = _run(python, "-c", f"import importlib.util as u; print([n for n in {absent!r} if u.find_spec(n)])")
    assert listed.stdout.strip() == "[]"
    assert size_of(tmp_path / "empty" / "lib") < MOST_MEGABYTES

    guide = (repository / "docs" / "guides" / "safety.md").read_text(encoding="utf-8")
    code = re.findall(r"```python\n(.*?)```", guide, re.DOTALL)
    filtered = _run(python, "-c", "\n".join(code[:2]), cwd=tmp_path)
    assert (filtered.returncode, filtered.stdout[:9]) == (0, "corrected"), filtered.stderr
    three = (  # actions, which piqp decides
        "import numpy as np; from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter\n"
        "low = (-1.0,) * 3; wall = FunctionBarrier(lambda x: 1.0 - x[0] - x[1])\n"
        "settings = FilterSettings(action_low=low, action_high=(1.0,) * 3, backup_action=low, eta=0.1, epsilon=0.0)\n"
        "safe = SafetyFilter(lambda x: (x, 0.1 * np.eye(3)), [wall], settings)\n"
        "print(safe.decide(np.array([0.5, 0.45, 0.0]), np.ones(3)).status.value)"
    )
    decided = _run(python, "-c", three, cwd=tmp_path)
    assert decided.stdout.strip() == "corrected", decided.stderr
