"""The generated modules are those of today's sources, and the product works without them.

That their functions equal the equations is tested in tests/dynamics/test_recorded_step.py (steps) and
tests/safety/test_equation_stack.py (barriers).
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from safedpa.compiled import MODULES
from safedpa.equations.generated import generated
from safedpa.generate import GENERATORS, generate

SHARED = Path(__file__).resolve().parents[2] / "shared"


def test_generating_twice_gives_the_same_bytes_and_those_on_disk(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": str(SHARED)}
    subprocess.run([sys.executable, "-m", "safedpa.generate", tmp_path], check=True, env=environment)
    for module, source in GENERATORS.items():
        file = Path(*module.split(".")).with_suffix(".py")
        assert (tmp_path / file).read_text(encoding="utf-8") == source()
        assert (SHARED / file).read_text(encoding="utf-8") == source(), "run make environment"


def test_a_file_that_is_up_to_date_stays_untouched(tmp_path: Path) -> None:
    first = {path: path.stat().st_mtime_ns for path in generate(tmp_path)}
    assert {path: path.stat().st_mtime_ns for path in generate(tmp_path)} == first
    outdated = next(iter(first))
    outdated.write_text("outdated", encoding="utf-8")
    generate(tmp_path)
    assert outdated.read_text(encoding="utf-8") != "outdated"


def test_generated_modules_are_ignored_by_git_and_compiled() -> None:
    assert set(GENERATORS) <= set(MODULES)
    assert "\ngenerated_*.py\n" in (SHARED.parent / ".gitignore").read_text(encoding="utf-8")
    assert all(name.rpartition(".")[2].startswith("generated_") for name in GENERATORS)


def test_without_generated_modules_models_and_barriers_record_their_equations() -> None:
    code = """
import sys
sys.modules.update({"safedpa.dynamics.generated_steps": None, "safedpa.robots.car.generated_barriers": None})
from safedpa.dynamics import load_model
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings
from safedpa.safety.barriers.equation import pattern_of, rows_of
car = load_model("car")
car.record_scalar_step()
print(car.scalar_step(0.05)([0.1, 0.2, 0.3, 1.0], [1.0, 0.1], car.latent.tolist(), 0.0))
parts = car_barriers(FilterSettings.for_robot("car"), (0.1, 0.4, 0.1), [(1.0, 1.0, 0.2)])
print(rows_of(pattern_of(parts), 4).__module__)
"""
    blocked = code.splitlines()[2]
    answers = []
    for text in (code, code.replace(blocked, "")):
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        answers.append(done.stdout.splitlines())
    assert answers[0][0] == answers[1][0]
    assert answers[0][1] != answers[1][1] == "safedpa.robots.car.generated_barriers"


def test_a_generated_module_that_cannot_import_something_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "generated_broken.py").write_text("import no_such_module", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert generated("generated_nowhere") == {}
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        generated("generated_broken")
