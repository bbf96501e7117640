"""``safedpa export``: a recording of the bus as a table for other programs."""

from __future__ import annotations

from pathlib import Path

import click

__all__ = ["command"]


@click.command()
@click.argument("recording", type=click.Path(path_type=Path), metavar="RECORDING.mcap")
@click.option(
    "--format",
    "kind",
    type=click.Choice(["csv", "parquet"]),
    required=True,
    help="csv: text, every digit kept; parquet: binary, smaller and faster.",
)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="PATH", help="The file to write.")
@click.option("--robot", metavar="NAME", help="Which robot, when the recording holds several.")
def command(recording: Path, kind: str, out: Path, robot: str | None) -> None:
    """Write one robot's drive from a recording as CSV or Parquet.

    One row per tick: t [s], the states, the actions in force until the next row, and what the safety filter decided at
    that tick: status, slack, h_now, h_next, margin.
    """
    from safedpa.records.export import export_recording

    exported = export_recording(recording, out, kind, robot)
    for finding in exported.findings:
        click.echo(f"{finding.kind}: {finding.message}", err=True)
    click.echo(f"{out}: {exported.rows} rows of robot '{exported.robot}'")
