"""``export``: recordings and models as files of other tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

from safedpa.api.inputs import Model, files_of, model_of
from safedpa.comparison.output import refuse_inputs, require_writable_folder
from safedpa.dynamics.simulator_export import SimulatorExport, export_table
from safedpa.dynamics.user_files import load_user_files
from safedpa.errors import InputError
from safedpa.extras import need
from safedpa.result import AbstractResult
from safedpa.systems.robots import robot_named


@final
@dataclass(frozen=True, repr=False, eq=False)
class ExportedFiles(AbstractResult):
    """Files for other tools.

    ``format`` is that of ``export``, ``written`` are the files, or the folder of a bag. ``robot`` is the robot whose
    ``count`` rows or messages were exported. ``notices`` are findings about a recording, or the effects of a model that
    a format cannot express.

    Example:

        >>> files = safedpa.export("pendulum", "elsewhere", format="simulators")
        >>> [path.name for path in files.written]
        ['parameters.json', 'pendulum.mjcf.xml', 'pendulum.urdf']
    """

    format: str
    written: tuple[Path, ...]
    robot: str
    count: int
    notices: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa export --json`` prints."""
        of_model = self.format == "simulators"
        document: dict[str, Any] = {"written": [str(path) for path in self.written]}
        if not of_model:
            document |= {"messages" if self.format == "ros2" else "rows": self.count, "robot": self.robot}
        return document | ({"unexpressed" if of_model else "findings": list(self.notices)} if self.notices else {})

    def _facts(self) -> dict[str, object]:
        names = ", ".join(path.name for path in self.written)
        return {"robot": self.robot, "written": names, "count": self.count, "notices": len(self.notices)}

    def _columns(self) -> dict[str, Sequence[Any]]:
        return {"written": [str(path) for path in self.written]}


def export(
    source: Model,
    out: str | Path,
    *,
    format: Literal["csv", "parquet", "ros2", "simulators"],  # noqa: A002 - the name of the command's option
    robot: str | None = None,
) -> ExportedFiles:
    """Exports a recording of the bus, or a model, to files of other tools.

    ``csv`` and ``parquet`` are tables with one row per tick of a recording: t [s], states, actions and decisions.
    ``ros2`` is a rosbag2 folder with standard messages. ``simulators`` is a folder for a model: all parameters as JSON,
    and files for other simulators. ``robot`` chooses one of several in a recording. Raises InputError and RunError for
    sources that cannot be used, RecordingError if ``out`` cannot be written.

    Example:

        >>> safedpa.export("drive.mcap", "drive.csv", format="csv").robot
        'r1'
    """
    target = Path(out)
    if format == "simulators":
        return _export_model(source, target)
    if not isinstance(source, (str, Path)):
        raise InputError(f"format '{format}': got a model, wanted a recording; use format='simulators'")
    refuse_inputs([target], [source])
    load_user_files()
    if format == "ros2":
        need("ros", what=f"export to {format}")
        from safedpa.replay.ros2_bag import export_bag

        bag = export_bag(Path(source), target, robot)
        return ExportedFiles(format, (target,), bag.robot, bag.messages, tuple(bag.findings))
    need("diagnosis", what=f"export to {format}")
    from safedpa.records.writers.tables import export_recording

    table = export_recording(Path(source), target, format, robot)
    notices = tuple(f"{finding.kind}: {finding.message}" for finding in table.findings)
    return ExportedFiles(format, (target,), table.robot, table.rows, notices)


def _export_model(source: Model, out: Path) -> ExportedFiles:
    model = model_of(source)
    found = robot_named(model.system.name).simulator_export(model) or SimulatorExport()
    texts = {"parameters.json": export_table(model, found), **found.documents}
    require_writable_folder(out, create=True)
    refuse_inputs([out / name for name in texts], files_of(source))
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
    notices = [
        f"{name}: {effect}: {why}" for name, cannot in found.unexpressed.items() for effect, why in cannot.items()
    ]
    return ExportedFiles("simulators", tuple(out / name for name in texts), model.system.name, 0, tuple(notices))
