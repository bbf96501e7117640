"""SafeDPA: a safety filter that never fails open, and a diagnosis of what its model lacks.

``import safedpa`` gives the functions of the Python API; each is imported when it is first used, so that importing it
starts no process and loads nothing heavy. The subpackages hold what they are made of: read ``safety`` for the filter,
``dynamics`` and ``effects`` for the models, ``diagnosis`` for the search of missing effects, ``bus`` for the services.

Example:

    >>> found = safedpa.diagnose("frictionless.toml", "log.csv")
    >>> found.added
    ('viscous_friction',)
"""

TYPE_CHECKING = False  # not typing's: importing it would take most of the time of importing this package

if TYPE_CHECKING:
    from safedpa.api.calibrating import CalibratedMargins, calibrate
    from safedpa.api.comparing import ComparisonResult, compare
    from safedpa.api.diagnosing import Diagnosis, SavedDiagnosis, diagnose
    from safedpa.api.effect_table import EffectTable, list_effects
    from safedpa.api.exporting import ExportedFiles, export
    from safedpa.api.fitting import FittedModel, add, refit, remove
    from safedpa.api.inputs import read_log
    from safedpa.api.log_columns import ProposedColumns, columns
    from safedpa.api.planning import DataCheck, Rehearsal, check_data, rehearse
    from safedpa.api.predicting import PredictedRun, predict
    from safedpa.api.robot_check import RobotCheck, check
    from safedpa.api.starting import StartedModel, init
    from safedpa.dynamics import PhysicsModel, load_model, save_model
    from safedpa.errors import InputError, SafedpaError
    from safedpa.records.run import Run
    from safedpa.result import Plot, Rows
    from safedpa.safety import (
        AbstractBarrier,
        AbstractEquationBarrier,
        CorridorBarrier,
        DistanceFieldBarrier,
        FilterReport,
        FilterSession,
        FilterSettings,
        FunctionBarrier,
        HigherOrderBarrier,
        LipschitzBarrier,
        LookAheadBarrier,
        RolloutBarrier,
        SafetyFilter,
        SpeedBarrier,
        StateLimits,
        Status,
        Verdict,
        check_filter,
        distance_to_occupied,
    )
    from safedpa.safety.defaults import settings_named
    from safedpa.systems import System, Variable

    __version__: str

__all__ = [
    "AbstractBarrier",
    "AbstractEquationBarrier",
    "CalibratedMargins",
    "ComparisonResult",
    "CorridorBarrier",
    "DataCheck",
    "Diagnosis",
    "DistanceFieldBarrier",
    "EffectTable",
    "ExportedFiles",
    "FilterReport",
    "FilterSession",
    "FilterSettings",
    "FittedModel",
    "FunctionBarrier",
    "HigherOrderBarrier",
    "InputError",
    "LipschitzBarrier",
    "LookAheadBarrier",
    "PhysicsModel",
    "Plot",
    "PredictedRun",
    "ProposedColumns",
    "Rehearsal",
    "RobotCheck",
    "RolloutBarrier",
    "Rows",
    "Run",
    "SafedpaError",
    "SafetyFilter",
    "SavedDiagnosis",
    "SpeedBarrier",
    "StartedModel",
    "StateLimits",
    "Status",
    "System",
    "Variable",
    "Verdict",
    "__version__",
    "add",
    "calibrate",
    "check",
    "check_data",
    "check_filter",
    "columns",
    "compare",
    "diagnose",
    "distance_to_occupied",
    "export",
    "init",
    "list_effects",
    "load_model",
    "predict",
    "read_log",
    "refit",
    "rehearse",
    "remove",
    "save_model",
    "settings_named",
]

_HOMES = {
    "api.calibrating": "CalibratedMargins calibrate",
    "api.comparing": "ComparisonResult compare",
    "api.diagnosing": "Diagnosis SavedDiagnosis diagnose",
    "api.effect_table": "EffectTable list_effects",
    "api.exporting": "ExportedFiles export",
    "api.fitting": "FittedModel add refit remove",
    "api.inputs": "read_log",
    "api.log_columns": "ProposedColumns columns",
    "api.planning": "DataCheck Rehearsal check_data rehearse",
    "api.predicting": "PredictedRun predict",
    "api.robot_check": "RobotCheck check",
    "api.starting": "StartedModel init",
    "dynamics": "PhysicsModel load_model save_model",
    "errors": "InputError SafedpaError",
    "records.run": "Run",
    "result": "Plot Rows",
    "safety": "AbstractBarrier AbstractEquationBarrier CorridorBarrier DistanceFieldBarrier FilterReport "
    "FilterSession FilterSettings FunctionBarrier HigherOrderBarrier LipschitzBarrier LookAheadBarrier RolloutBarrier "
    "SafetyFilter SpeedBarrier StateLimits Status Verdict check_filter distance_to_occupied",
    "safety.defaults": "settings_named",
    "systems": "System Variable",
}
"""Public names by module of this package."""
_HOME = {name: f"safedpa.{module}" for module, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    """Imports a name when it is first used."""
    import importlib

    if name == "__version__":
        from importlib.metadata import version

        found: object = version("safedpa")
    elif name in _HOME:
        found = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
