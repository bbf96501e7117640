"""``safedpa export``: converts recordings, models and learned networks to formats of other tools."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa.extras import need
from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.names import SuggestingChoice
from safedpa_services.command_line.options import PATH


@click.command()
@click.argument("source", type=PATH, metavar="RECORDING.mcap|MODEL.toml|WEIGHTS.safetensors")
@click.option(
    "--format",
    "kind",
    type=SuggestingChoice(["csv", "parquet", "ros2", "simulators"]),
    help="csv: text with full precision; parquet: smaller, faster; ros2: a rosbag2 (MCAP); simulators: for a model.",
)
@click.option("--out", type=PATH, metavar="PATH", help="The file, or for ros2 and simulators the folder, to write.")
@click.option("--robot", metavar="NAME", help="The robot to export, if the recording has several.")
@click.option(
    "--onnx",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write the networks of a weights file to DIR: mu, f, g, phi and policy, one .onnx file each.",
)
@answers_json
def command(source: Path, kind: str | None, out: Path | None, robot: str | None, folder: Path | None) -> None:
    """Export a recording, a model or networks to other tools.

    Recordings become CSV, Parquet or rosbag2 files, models files of other simulators, networks ONNX files.

    A table has one row per tick: t [s], the states, the actions in force until the next row, and the safety filter's
    decision: status, slack, h_now, h_next, margin. A rosbag2 is a folder with standard messages: odometry, tf, nominal
    action and command, diagnostics, markers. Foxglove, Rerun and ROS 2 can open it.

    For a model (a file, or the name of a shipped one) --out is a folder: parameters.json with all parameters, and files
    for other simulators (MJCF, URDF, Gazebo). Effects that these formats cannot express are listed.

    Inputs and outputs of the ONNX graphs are in SI units.
    """
    if folder is not None:
        if kind or out or robot:
            raise InputError(
                "--onnx: got it together with --format, --out or --robot, which are for recordings; leave them out"
            )
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
    facts = {"written": [str(out)], "rows": exported.rows, "robot": exported.robot}
    report_progress(f"{out}: {exported.rows} rows of robot '{exported.robot}'", facts=facts)


def _export_model(source: Path, out: Path) -> None:
    from safedpa.comparison.output import refuse_inputs, require_writable_folder
    from safedpa.dynamics import load_model
    from safedpa.dynamics.simulator_export import SimulatorExport, export_table
    from safedpa.systems.robots import robot_named

    model = load_model(source)
    found = robot_named(model.system.name).simulator_export(model) or SimulatorExport()
    texts = {"parameters.json": export_table(model, found), **found.documents}
    require_writable_folder(out, create=True)
    refuse_inputs([out / name for name in texts], [source])
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
        report_progress(str(out / name), facts={"written": [str(out / name)]})
    for name, cannot in found.unexpressed.items():
        for effect, why in cannot.items():
            report_progress(
                f"{name}: cannot express {effect}: {why}", err=True, facts={"unexpressed": [f"{name}: {effect}: {why}"]}
            )


def _export_bag(source: Path, out: Path, robot: str | None) -> None:
    need("ros", what="--format ros2")
    from safedpa.replay.ros2_bag import export_bag

    exported = export_bag(source, out, robot)
    for line in exported.findings:
        report_progress(line, err=True, facts={"findings": [line]})
    facts = {"written": [str(out)], "messages": exported.messages, "robot": exported.robot}
    report_progress(
        f"{out}: {exported.messages} messages of robot '{exported.robot}'; ros2 bag play {out}", facts=facts
    )


def _export_networks(source: Path, folder: Path) -> None:
    need("train", what="--onnx")
    from safedpa.networks import load_weights
    from safedpa_sim.training.export.onnx import export_onnx

    for path in export_onnx(load_weights(source), folder):
        report_progress(f"{path}: {path.stat().st_size} bytes", facts={"written": [str(path)]})
