"""What a plain installation leaves out is named in one line by every command that needs it."""

import json
import re
import sqlite3
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from safedpa.errors import MissingExtraError
from safedpa.extras import EXTRAS, INCLUDED, extra_of, missing, need

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MODULES = {"rerun-sdk": "rerun", "mujoco-core": "mujoco", "eclipse-zenoh": "zenoh", "Pillow": "PIL"}
"""Distributions whose modules bear another name."""
HEAVY = ("torch", "plotly", "rerun", "pymunk", "pyarrow", "scipy", "jinja2", "nicegui", "prometheus_client", "ray")
HEAVY += ("rosbags", "pyulog")
HEAVY += ("gymnasium", "matplotlib", "mujoco", "onnx", "onnxruntime", "sb3_contrib", "stable_baselines3")

CASES = (  # a command line, and the extra that it must name; None: it runs
    ("effects", None),
    ("--version", None),
    ("up --help", None),
    ("experiment car --help", None),
    ("up --headless", "sim"),
    ("add car steering_offset {log} --out {out}.toml", "diagnosis"),
    ("compare car {log}", "diagnosis"),
    ("diagnose car {log}", "diagnosis"),
    ("diagnose car {log} --check", "diagnosis"),
    ("predict car {log} --horizon 1 --out {out}.csv", "diagnosis"),
    ("rehearse car {log}", "diagnosis"),
    ("export {log} --format csv --out {out}.csv", "diagnosis"),
    ("export {log} --onnx {out}", "train"),
    ("replay {log} --rrd {out}.rrd", "view"),
    ("screenshot {log} --out {out}.png", "view"),
    ("workbench", "workbench"),
    ("columns {bag}", "ros"),
    ("train car", "train"),
    ("train-baselines", "train"),
    ("bench latency --seconds 1", "sim"),
    ("experiment theory car_simulated", "train"),
    *((f"experiment {name}", "sim") for name in ("controllers", "faults", "live", "safety")),
    *(
        (f"experiment {name}", "diagnosis")
        for name in ("bad-data {log} --out {out}", "point-story", "real-logs --data {log}")
    ),
    *((f"experiment {name}", "sim,diagnosis") for name in ("fleet-diagnosis", "hidden-effects", "safety-pays")),
    *((f"experiment {name}", "train") for name in ("car", "pendulum", "point", "point-heat-map", "point-learning")),
)

PROGRAM = """
import contextlib, io, json, sys
for name in {heavy!r}:
    sys.modules[name] = None  # as if it were not installed
from safedpa.records.readers.own_process import in_this_process
from safedpa_services.command_line.group import safedpa
for line in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), in_this_process():
        try:
            code = safedpa.run(line.split())
        except BaseException as error:
            code = repr(error)
    print(json.dumps([code, err.getvalue()]))
"""


def test_a_core_without_any_extra_names_the_extra_that_a_command_needs(tmp_path: Path) -> None:
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text("t,x\n0,0\n", encoding="utf-8")
    bag = tmp_path / "drive.db3"
    with sqlite3.connect(bag) as base:
        base.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        base.execute("CREATE TABLE messages (topic_id INTEGER, timestamp INTEGER, data BLOB)")
        base.execute("INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr')")
        base.execute("INSERT INTO messages VALUES (1, 0, x'00')")
    lines = [line.format(log=log, out=out, bag=bag) for line, _ in CASES]
    program = [sys.executable, "-c", PROGRAM.format(heavy=HEAVY), json.dumps(lines)]
    done = subprocess.run(program, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    for (line, extra), (code, notice) in zip(CASES, answers, strict=True):
        if extra is None:
            assert (code, notice) == (0, ""), line
            continue
        assert code == 2, (line, code, notice)
        assert notice.count("\n") == 1, (line, notice)
        named = re.search(r"pip install 'safedpa\[([a-z,]+)\]'", notice)
        assert named, (line, notice)
        assert named[1] == extra, (line, notice)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.db3", "log.csv"]


def _modules(requirements: list[str]) -> set[str]:
    plain = [re.split(r"[<>=\[ ]", item)[0] for item in requirements if not item.startswith("safedpa[")]
    return {MODULES.get(name, name).replace("-", "_") for name in plain}


@pytest.mark.parametrize("extra", sorted(EXTRAS))
def test_the_table_says_what_the_project_file_says(extra: str) -> None:
    requirements = PROJECT["optional-dependencies"][extra]
    assert _modules(requirements) == set(EXTRAS[extra])
    included = [name for item in requirements for name in re.findall(r"^safedpa\[(.*)\]$", item)]
    assert sorted(name for names in included for name in names.split(",")) == sorted(INCLUDED.get(extra, ()))


def test_all_is_every_extra_of_the_table_and_the_core_has_none_of_their_modules() -> None:
    (everything,) = PROJECT["optional-dependencies"]["all"]
    assert sorted(everything.removeprefix("safedpa[").removesuffix("]").split(",")) == sorted(EXTRAS)
    assert not _modules(PROJECT["dependencies"]) & {name for names in EXTRAS.values() for name in names}


def test_what_is_missing_is_named_with_a_way_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setitem(sys.modules, "pymunk", None)
    assert (missing("workbench"), missing("workbench", alone=True)) == (("rerun",), ())
    phrase = r"^the view needs pip install 'safedpa\[sim,view\]', or go without; not installed: pymunk, rerun$"
    with pytest.raises(MissingExtraError, match=phrase):
        need("sim", "view", "metrics", what="the view", instead="go without")
    need("metrics")
    assert (extra_of("rerun.blueprint"), extra_of("numpy")) == ("view", None)


def test_the_filter_needs_numpy_and_its_solver_alone() -> None:
    program = (
        "import sys, pathlib, re\n"
        "known = {'numpy', 'piqp', 'safedpa'} | set(sys.stdlib_module_names) | {'__main__', '_distutils_hack'}\n"
        "text = pathlib.Path(sys.argv[1]).read_text()\n"
        "code, *_ = re.findall(r'```python\\n(.*?)```', text, re.DOTALL)\n"
        "before = set(sys.modules)\n"
        "exec(compile(code, 'README.md', 'exec'), {})\n"
        "print(sorted({name.split('.')[0] for name in set(sys.modules) - before} - known))\n"
    )
    command = [sys.executable, "-c", program, ROOT / "README.md"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
    assert done.stdout.startswith("corrected")
