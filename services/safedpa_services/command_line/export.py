"""``safedpa export``: a recording of the bus as a table, or learned networks as ONNX, for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa.extras import need
from safedpa_services.command_line.answering import answers_json, tell
from safedpa_services.command_line.names import Choice

__all__ = ["command"]


@click.command()
@click.argument("source", type=click.Path(path_type=Path), metavar="RECORDING.mcap|WEIGHTS.safetensors")
@click.option(
    "--format",
    "kind",
    type=Choice(["csv", "parquet"]),
    help="Of a recording. csv: text, every digit kept; parquet: binary, smaller and faster.",
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
    """Write one robot's drive from a recording as CSV or Parquet, or learned networks as ONNX.

    A recording gives one row per tick: t [s], the states, the actions in force until the next row, and what the safety
    filter decided at that tick: status, slack, h_now, h_next, margin. Of networks every graph takes and gives SI units.
    """
    if folder is not None:
        if kind or out or robot:
            raise InputError("--onnx: got options of a recording too; leave --format, --out and --robot out")
        _export_networks(source, folder)
        return
    if kind is None or out is None:
        raise InputError("export: wanted --format and --out for a recording, or --onnx DIR for a weights file")
    need("diagnosis", what=f"--format {kind}")
    from safedpa.records.export import export_recording

    exported = export_recording(source, out, kind, robot)
    for finding in exported.findings:
        tell(f"{finding.kind}: {finding.message}", err=True, facts={"findings": [f"{finding.kind}: {finding.message}"]})
    told = {"written": [str(out)], "rows": exported.rows, "robot": exported.robot}
    tell(f"{out}: {exported.rows} rows of robot '{exported.robot}'", facts=told)


def _export_networks(source: Path, folder: Path) -> None:
    need("train", what="--onnx")
    from safedpa.networks import load_weights
    from safedpa_sim.training.onnx_export import export_onnx

    for path in export_onnx(load_weights(source), folder):
        tell(f"{path}: {path.stat().st_size} bytes", facts={"written": [str(path)]})
