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
    from safedpa.api.exporting import export

    if kind is None or out is None:
        raise InputError("export: wanted --format and --out for a recording, or --onnx DIR for a weights file")
    found = export(source, out, format=kind, robot=robot)  # type: ignore[arg-type] # one of the option's choices
    for notice in found.notices:
        name, _, rest = notice.partition(": ")
        report_progress(f"{name}: cannot express {rest}" if kind == "simulators" else notice, err=True)
    if kind == "simulators":
        report_progress("\n".join(map(str, found.written)))
    elif kind == "ros2":
        report_progress(f"{out}: {found.count} messages of robot '{found.robot}'; ros2 bag play {out}")
    else:
        report_progress(f"{out}: {found.count} rows of robot '{found.robot}'")
    report_progress(facts=found.to_dict())


def _export_networks(source: Path, folder: Path) -> None:
    need("train", what="--onnx")
    from safedpa.networks import load_weights
    from safedpa_sim.training.export.onnx import export_onnx

    for path in export_onnx(load_weights(source), folder):
        report_progress(f"{path}: {path.stat().st_size} bytes", facts={"written": [str(path)]})
