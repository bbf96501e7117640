"""Documents, tables and lines of results have the parts that were recorded: none is lost on the way to the user.

``forms.json`` has them; after a change that is meant, the failing test prints the new one.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import safedpa
from safedpa.result import AbstractResult

MODEL, OTHER, LOG, BUS = "frictionless.toml", "friction.toml", "log.csv", "drive.mcap"
FORMS = Path(__file__).with_name("forms.json")
RESULTS: dict[str, Callable[[], Any]] = {
    "compare": lambda: safedpa.compare(MODEL, LOG, before=OTHER),
    "runs of compare": lambda: safedpa.compare(MODEL, LOG).runs,
    "details of compare": lambda: safedpa.compare(MODEL, LOG).details,
    "check_data": lambda: safedpa.check_data(MODEL, LOG),
    "add": lambda: safedpa.add(MODEL, "viscous_friction", LOG),
    "predict": lambda: safedpa.predict(MODEL, LOG, 0.5),
    "calibrate": lambda: safedpa.calibrate(BUS, coverage=0.9),
    "columns": lambda: safedpa.columns("degrees.csv", "pendulum"),
    "list_effects": lambda: safedpa.list_effects("pendulum"),
    "export": lambda: safedpa.export(BUS, "t.csv", format="csv"),
    "check": lambda: safedpa.check("incomplete.py"),
    "init": lambda: safedpa.init("degrees.csv", "my_pendulum", actions={"torque": "torque"}),
    "run": lambda: safedpa.read_log(LOG, "pendulum"),
    "model": lambda: safedpa.load_model(OTHER),
    "base": lambda: safedpa.load_model(OTHER).base,
    "effect": lambda: safedpa.load_model(OTHER).effects[0],
    "system": lambda: safedpa.load_model(OTHER).system,
    "settings": lambda: safedpa.settings_named("pendulum"),
    "filter": lambda: safedpa.SafetyFilter.for_model(
        safedpa.load_model("pendulum"), safedpa.settings_named("pendulum"), [safedpa.CorridorBarrier(-0.3, 0.3, 0.25)]
    ),
    "barrier": lambda: safedpa.CorridorBarrier(-0.3, 0.3, 0.25),
}


def parts(document: Any) -> Any:
    """The names in a document; of a list, those of its first entry."""
    if isinstance(document, dict):
        return {name: parts(value) for name, value in document.items()}
    return [parts(document[0])] if isinstance(document, list) and document else ""


def form(result: Any) -> dict[str, Any]:
    found: dict[str, Any] = {"line": re.findall(r"(\w+)=", repr(result))}
    if isinstance(result, AbstractResult):
        table = result.to_arrow()
        document = json.loads(json.dumps(result.to_dict()))
        found |= {"document": parts(document), "columns": table.column_names, "rows": table.num_rows}
    return found


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_has_the_recorded_parts(name: str, user_folder: Path) -> None:
    wanted = json.loads(FORMS.read_text(encoding="utf-8"))
    assert form(RESULTS[name]()) == wanted[name]
