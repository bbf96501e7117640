"""``safedpa experiment long-logs``: diagnosis of hours of logs, with its seconds and its memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result
from safedpa_services.command_line.names import SuggestingChoice

__all__ = ["command"]

_KINDS = ("csv", "parquet", "mcap")


@click.command(name="long-logs")
@click.option("--runs", type=int, default=10, show_default=True)
@click.option("--seconds", type=float, default=3600.0, show_default=True, help="of each run")
@click.option("--period", type=float, default=0.01, show_default=True, help="seconds between rows")
@click.option(
    "--kind", "kinds", type=SuggestingChoice(_KINDS), multiple=True, help="of file; may be repeated; default csv"
)
@click.option("--seed", type=int, default=0, show_default=True, help="draws drives and noise")
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim", "diagnosis")
def command(**options: Any) -> None:
    """How long a diagnosis of hours takes, and how much memory.

    Writes logs of a car with air drag that the given model lacks into a temporary folder, and runs `safedpa diagnose`
    and `safedpa compare` on them as processes of their own, whose time and largest memory are measured.
    """
    from safedpa_lab.experiments.long_logs import HIDDEN, LongLogs, write_long_logs
    from safedpa_services.progress import progress

    check_positive(options, "runs", "seconds", "period")
    out, kinds = options["out"], options["kinds"] or ("csv",)
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    logs = LongLogs(options["runs"], options["seconds"], options["period"], seed=options["seed"])
    with (
        tempfile.TemporaryDirectory(prefix="safedpa-long-") as name,
        progress("experiment long-logs") as report_progress,
    ):
        folder = Path(name)
        paths = write_long_logs(logs, folder, kinds, report_progress)
        rows = [_row(folder, kind, paths[kind], what) for kind in kinds for what in ("diagnose", "compare")]
    shape = {key: options[key] for key in ("runs", "seconds", "period", "seed")}
    result = {"experiment": "long-logs", **shape, "hidden": dict(HIDDEN), "rows": rows}
    if out is not None:
        write_result(out, result)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _row(folder: Path, kind: str, paths: list[Path], what: str) -> dict[str, Any]:
    """Runs one command on the files; Raises SafedpaError when it fails."""
    arguments = [what, str(folder / "model.toml"), *map(str, paths), "--out", str(folder / kind), "--json"]
    begin = time.perf_counter()
    with (folder / "answer.json").open("wb") as answer, (folder / "words.txt").open("wb") as phrase:
        process = subprocess.Popen([sys.executable, "-m", "safedpa_services", *arguments], stdout=answer, stderr=phrase)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SafedpaError(f"{what} of {kind}: {(folder / 'phrase.txt').read_text(encoding='utf-8').strip()}")
    document = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
    return {
        "kind": kind,
        "command": what,
        "megabytes_read": round(sum(path.stat().st_size for path in paths) / 1e6, 1),
        "seconds": round(time.perf_counter() - begin, 1),
        "processor_seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "memory_mebibytes": round(usage.ru_maxrss / 1024),
        "added": document.get("added"),
        "parameters": document.get("parameters"),
    }


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in ("files", "command", "MB read", "s", "s of processor", "MiB at most", "added"):
        table.add_column(name, justify="left" if name in ("files", "command", "added") else "right")
    for row in result["rows"]:
        numbers = [row[key] for key in ("megabytes_read", "seconds", "processor_seconds", "memory_mebibytes")]
        table.add_row(row["kind"], row["command"], *map(str, numbers), ", ".join(row["added"] or ()))
    Console(highlight=False).print(table)
