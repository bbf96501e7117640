"""``safedpa export``: a recording of the bus as a table or a bag of ROS 2, or learned networks as ONNX."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa.extras import need
from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.names import SuggestingChoice

__all__ = ["command"]


@click.command()
@click.argument("source", type=click.Path(path_type=Path), metavar="RECORDING.mcap|MODEL.toml|WEIGHTS.safetensors")
@click.option(
    "--format",
    "kind",
    type=SuggestingChoice(["csv", "parquet", "ros2", "simulators"]),
    help="csv: text, every digit kept; parquet: smaller, faster; ros2: a rosbag2 (MCAP); simulators: of a model.",
)
@click.option("--out", type=click.Path(path_type=Path), metavar="PATH", help="The file to write a recording to.")
@click.option("--robot", metavar="NAME", help="Which robot, when the recording holds several.")
@click.option(
    "--onnx",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write the networks of a weights file there: mu, f, g, phi and policy, one .onnx each.",
)
@answers_json
def command(source: Path, kind: str | None, out: Path | None, robot: str | None, folder: Path | None) -> None:
    """Write a recorded drive as CSV, Parquet or rosbag2, a model for other simulators, or learned networks as ONNX.

    A recording gives one row per tick: t [s], the states, the actions in force until the next row, and what the safety
    filter decided at that tick: status, slack, h_now, h_next, margin. A rosbag2 is a folder of standard messages:
    odometry, tf, nominal action and command, diagnostics, markers; Foxglove, Rerun and ROS 2 open it.

    Of a model (a file, or the name of one that ships) --out is a folder: parameters.json with every parameter, and
    files of other simulators (MJCF, URDF, Gazebo) as far as they can say it; what they cannot is told.

    Of networks every graph takes and gives SI units.
    """
    if folder is not None:
        if kind or out or robot:
            raise InputError("--onnx: got options of a recording too; leave --format, --out and --robot out")
        _export_networks(source, folder)
        return
    from safedpa.comparison.output import refuse_inputs

    if kind is None or out is None:
        raise InputError("export: wanted --format and --out for a recording, or --onnx DIR for a weights file")
    if kind == "simulators":
        _export_model(source, out)
        return
    refuse_inputs([out], [source])
    if kind == "ros2":
        _export_bag(source, out, robot)
        return
    need("diagnosis", what=f"--format {kind}")
    from safedpa.records.writers.tables import export_recording

    exported = export_recording(source, out, kind, robot)
    for finding in exported.findings:
        report_progress(
            f"{finding.kind}: {finding.message}", err=True, facts={"findings": [f"{finding.kind}: {finding.message}"]}
        )
    reported = {"written": [str(out)], "rows": exported.rows, "robot": exported.robot}
    report_progress(f"{out}: {exported.rows} rows of robot '{exported.robot}'", facts=reported)


def _export_model(source: Path, out: Path) -> None:
    from safedpa.comparison.output import refuse_inputs, require_writable_folder
    from safedpa.dynamics import load_model
    from safedpa.dynamics.elsewhere import SimulatorExport, export_table
    from safedpa.robot import robot_named

    model = load_model(source)
    found = robot_named(model.system.name).elsewhere(model) or SimulatorExport()
    texts = {"parameters.json": export_table(model, found), **found.documents}
    require_writable_folder(out, create=True)
    refuse_inputs([out / name for name in texts], [source])
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
        report_progress(str(out / name), facts={"written": [str(out / name)]})
    for name, cannot in found.unexpressed.items():
        for effect, why in cannot.items():
            report_progress(
                f"{name}: {effect} is not in it: {why}", err=True, facts={"unexpressed": [f"{name}: {effect}: {why}"]}
            )


def _export_bag(source: Path, out: Path, robot: str | None) -> None:
    need("ros", what="--format ros2")
    from safedpa.replay.ros2_bag import export_bag

    exported = export_bag(source, out, robot)
    for line in exported.findings:
        report_progress(line, err=True, facts={"findings": [line]})
    reported = {"written": [str(out)], "messages": exported.messages, "robot": exported.robot}
    report_progress(
        f"{out}: {exported.messages} messages of robot '{exported.robot}'; ros2 bag play {out}", facts=reported
    )


def _export_networks(source: Path, folder: Path) -> None:
    need("train", what="--onnx")
    from safedpa.networks import load_weights
    from safedpa_sim.training.onnx_export import export_onnx

    for path in export_onnx(load_weights(source), folder):
        report_progress(f"{path}: {path.stat().st_size} bytes", facts={"written": [str(path)]})
