"""One good log, corrupted in twenty ways."""

from __future__ import annotations

from safedpa.errors import InputError
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.hidden.bad_data import BAD, write_bad_files


def run(options: Options, _report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment bad-data``. Raises InputError for a log that does not exist."""
    if not options["log"].is_file():
        raise InputError(f"{options['log']}: no such file; wanted a good log of a car as CSV")
    files = write_bad_files(options["log"], options["out"])
    rows = [{"file": str(path), "kind": BAD[name].kind, "notice": BAD[name].notice} for name, path in files.items()]
    return {"format": 1, "files": rows}


def report(result: Result) -> str:
    """One line per file: the kind of message, and a part of its text."""
    return "\n".join(f"{row['file']}: {row['kind']}, '... {row['notice']} ...'" for row in result["files"])
