"""What ``import safedpa`` gives: the commands as functions, results that a cell can show, and tables for others."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import polars
import pyarrow
import pytest
from IPython.core.formatters import DisplayFormatter

import safedpa
from safedpa.errors import ColumnMapError, InputError, RunError
from safedpa.result import AbstractPlottedResult, AbstractResult
from safedpa_services.command_line.group import safedpa as command_line

MODEL, OTHER, LOG, BUS = "frictionless.toml", "friction.toml", "log.csv", "drive.mcap"
FRICTION = "viscous_friction"
LONG = pytest.mark.long

# A command without --json, and the function that gives the same.
COMMANDS: list[Any] = [
    (f"compare {MODEL} {LOG} --before {OTHER} --out out", lambda: safedpa.compare(MODEL, LOG, before=OTHER)),
    pytest.param(
        f"diagnose {MODEL} {LOG} --out out --force", lambda: safedpa.diagnose(MODEL, LOG, out="out"), marks=LONG
    ),
    (f"diagnose {MODEL} {LOG} --check", lambda: safedpa.check_data(MODEL, LOG)),
    (f"add {MODEL} {FRICTION} {LOG} --out out.toml", lambda: safedpa.add(MODEL, FRICTION, LOG, out="out.toml")),
    (f"predict {MODEL} {LOG} --horizon 0.5 --out out.csv", lambda: safedpa.predict(MODEL, LOG, 0.5, out="out.csv")),
    pytest.param(
        f"rehearse {MODEL} {LOG} --effect {FRICTION} --size 2",
        lambda: safedpa.rehearse(MODEL, LOG, effect=FRICTION, size=2.0),
        marks=LONG,
    ),
    (f"calibrate {BUS} --coverage 0.9 --out m.toml", lambda: safedpa.calibrate(BUS, coverage=0.9, out="m.toml")),
    ("columns degrees.csv --robot pendulum", lambda: safedpa.columns("degrees.csv", "pendulum")),
    ("effects --robot car", lambda: safedpa.list_effects("car")),
    (f"export {BUS} --format csv --out t.csv", lambda: safedpa.export(BUS, "t.csv", format="csv")),
    ("export car --format simulators --out sims", lambda: safedpa.export("car", "sims", format="simulators")),
    ("check incomplete.py", lambda: safedpa.check("incomplete.py")),
]  # fmt: skip


@pytest.mark.parametrize(
    ("command", "function"), COMMANDS, ids=[str(getattr(case, "values", case)[0]) for case in COMMANDS]
)
def test_a_function_gives_what_the_command_prints(
    command: str, function: Callable[[], AbstractResult], user_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = function()
    assert command_line.run([*command.split(), "--json"]) == (2 if command == "check incomplete.py" else 0)
    assert json.loads(json.dumps(result.to_dict())) == json.loads(capsys.readouterr().out)
    shown = repr(result)
    assert len(shown) <= 400
    assert "\n" not in shown
    assert " at 0x" not in shown
    cell = DisplayFormatter().format(result)[0]
    text = re.sub("<[^>]*>", "", cell["text/html"])
    assert 20 < len(text) <= 400
    table = result.to_arrow()
    assert table.to_pydict().keys() == dict.fromkeys(result.to_dataframe().columns).keys()
    assert polars.DataFrame(result).height == table.num_rows
    assert result.to_html(user_folder / "page.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    if isinstance(result, AbstractPlottedResult):
        assert DisplayFormatter().format(result.plot())[0]["image/png"]


@pytest.fixture(scope="module")
def found(user_files: Path) -> safedpa.Diagnosis:
    return safedpa.diagnose(user_files / MODEL, user_files / LOG)


def test_a_diagnosis_names_the_effect_and_gives_the_corrected_model(found: safedpa.Diagnosis, tmp_path: Path) -> None:
    assert (found.verdict, found.added, [stage.effects for stage in found.stages]) == (
        "effect_missing", (FRICTION,), [(), (FRICTION,)],
    )  # fmt: skip
    assert {item.effect for item in found.candidates if item.decision == "accepted"} == {FRICTION}
    assert found.candidates.to_dataframe().shape[0] == len(found.candidates) == len(found.report.candidates)
    assert list(found.findings) == []
    fitted = found.parameters[f"{FRICTION}.coefficient"]
    assert fitted.value == pytest.approx(0.2, abs=0.01)
    assert "viscous_friction: coefficient 0.20" in str(found)
    safedpa.save_model(found.model, tmp_path / "corrected.toml")
    again = safedpa.load_model(tmp_path / "corrected.toml")
    assert again.settings[f"{FRICTION}.coefficient"].value == fitted.value


def test_no_public_object_prints_an_address(found: safedpa.Diagnosis, user_files: Path) -> None:
    settings = safedpa.settings_named("pendulum")
    corridor = safedpa.CorridorBarrier(-0.3, 0.3, 0.25)
    safe = safedpa.SafetyFilter.for_model(safedpa.load_model("pendulum"), settings, [corridor])
    objects: list[Any] = [found, found.report, found.stages, found.candidates, found.model, found.model.base]
    objects += [*found.model.effects, found.model.system, found.given_runs[0], found.plot(), settings, safe, corridor]
    objects += [
        safe.decide([0.0, 0.0], [0.5], safedpa.load_model("pendulum").latent),
        safedpa.load_model("car_learned"),
    ]
    objects += [safedpa.FunctionBarrier(lambda x: x[0]), safedpa.check_filter(safe, [0.0, 0.0], latent=[0.0, 0.0])]
    objects += [safedpa.compare(user_files / MODEL, user_files / LOG).details]
    for item in objects:
        assert len(repr(item)) <= 400
        assert not re.search(r"0x[0-9a-f]{5}", repr(item)), item


def test_refit_and_remove_change_a_model_and_say_what_that_does_to_its_error(user_folder: Path) -> None:
    again = safedpa.refit("friction.toml", LOG, free=FRICTION, out="again.toml")
    assert again.parameters[f"{FRICTION}.coefficient"].value == pytest.approx(0.2, abs=0.01)
    assert again.after < again.before
    assert not again.model.latent_names, "a parameter that was fixed is fixed again"
    assert safedpa.load_model("again.toml").settings == again.model.settings
    without = safedpa.remove("again.toml", FRICTION, LOG)
    assert (without.model.effects, without.before < without.after) == ((), True)
    for wrong in (
        lambda: safedpa.refit(MODEL, LOG),
        lambda: safedpa.refit("friction.toml", LOG, free="viscos_friction"),
        lambda: safedpa.remove(MODEL, FRICTION, LOG),
        lambda: safedpa.add(MODEL, FRICTION, LOG, where="circle", varies="gain with time"),
        lambda: safedpa.rehearse(MODEL, LOG, size=0.0),
        lambda: safedpa.compare(MODEL, []),
        lambda: safedpa.refit("friction.toml", LOG, free=FRICTION, out=LOG),
    ):
        with pytest.raises(InputError):
            wrong()


NAMES = {"t": "time", "angle": {"from": "theta_deg", "unit": "deg"}}


@pytest.mark.parametrize("library", [dict, pandas.DataFrame, polars.DataFrame, pyarrow.table])
def test_a_data_frame_of_any_library_becomes_the_run_of_its_file(
    library: Callable[[dict[str, Any]], Any], user_files: Path
) -> None:
    columns = pandas.read_csv(user_files / "degrees.csv").to_dict("list")
    run = safedpa.Run.from_dataframe(library(columns), "pendulum", NAMES, name="degrees")
    for log, given in (
        ("degrees.csv", NAMES),
        ("degrees.csv", safedpa.columns(user_files / "degrees.csv", "pendulum")),
    ):
        file = safedpa.read_log(user_files / log, "pendulum", given)
        np.testing.assert_array_equal(run.states, file.states)
        np.testing.assert_array_equal(run.actions, file.actions)
        assert (run.findings, run.stretches, run.name) == (file.findings, file.stretches, file.name)
    same = safedpa.Run.from_arrays(run.t, run.states, run.actions, "pendulum", name="drive.1")
    assert same.name == "drive.1"
    np.testing.assert_array_equal(same.states, run.states)
    np.testing.assert_array_equal(run.to_dataframe()["angle"], run.states[:, 0])


def test_dates_are_seconds_and_missing_cells_are_cut_out() -> None:
    t = pandas.to_datetime(np.arange(100) * 0.05 + 1.7e9, unit="s")
    frame = pandas.DataFrame({"t": t, "angle": 0.1, "rate": 0.0, "torque": np.sin(np.arange(100))})
    frame = frame.astype({"torque": "Float64"})
    frame.loc[50, "torque"] = pandas.NA
    run = safedpa.Run.from_dataframe(frame, safedpa.load_model("pendulum"))
    assert run.t[0] == 1.7e9
    assert [len(part) for part in run.stretches] == [50, 49]
    assert "not_a_number" in [finding.kind for finding in run.findings]


@pytest.mark.parametrize(
    ("make", "error", "phrase"),
    [
        (lambda: safedpa.Run.from_dataframe({"t": [0.0]}, "pendulum"), RunError, "column 'angle' is missing"),
        (lambda: safedpa.Run.from_dataframe(3, "pendulum"), RunError, "frame: got int, wanted a data frame"),
        (lambda: safedpa.Run.from_dataframe({}, "pendulum", {"angel": "x"}), ColumnMapError, "no 'angel'"),
        (lambda: safedpa.Run.from_dataframe({}, "penduluum"), InputError, "robot 'penduluum': did you mean"),
        (lambda: safedpa.Run.from_arrays([0.0], [[0.0]], [[0.0]], "pendulum"), RunError, "states: got shape"),
        (lambda: safedpa.Run.from_arrays(["a"], [[0.0]], [[0.0]], "pendulum"), RunError, "wanted numbers"),
        (
            lambda: safedpa.Run.from_arrays([0.0], [[0.0]], [[0.0]], 3),
            InputError,
            "wanted a System, a model or the name",
        ),
    ],
)
def test_data_that_are_no_run_are_refused(make: Callable[[], Any], error: type[InputError], phrase: str) -> None:
    with pytest.raises(error, match=phrase):
        make()


def test_importing_loads_nothing_and_a_missing_name_is_an_attribute_error() -> None:
    program = (
        "import sys, time; begin = time.perf_counter(); import safedpa\n"
        "print(time.perf_counter() - begin, sorted(sys.modules.keys() & {'numpy', 'typing', 'safedpa.api'}))\n"
        "print(safedpa.__version__, safedpa.compare.__name__, 'diagnose' in dir(safedpa), hasattr(safedpa, 'compere'))"
    )
    answers = [
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.splitlines()
        for _ in range(3)
    ]
    assert min(float(lines[0].split()[0]) for lines in answers) <= 0.05
    assert answers[0][0].endswith(" []")
    assert answers[0][1].endswith(" compare True False")
