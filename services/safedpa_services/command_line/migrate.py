"""``safedpa migrate``: converts files of an earlier format to the current one."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa_services.command_line.json_answer import answers_json, report_progress


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder; default: next to each file.")
@answers_json
def command(files: tuple[Path, ...], out: Path | None) -> None:
    """Convert FILES of format 1 to format 2.

    Converts filter settings, robot files, margins and recordings. Models and column maps are the same in both formats
    and are copied. The result is written to DIR/NAME, or without --out to NAME.format2.SUFFIX next to the file. No file
    is overwritten.
    """
    from safedpa.errors import InputError
    from safedpa.records.earlier_format import FORMAT, migrate

    failed: list[str] = []
    for path in files:
        target = path.with_suffix(f".format{FORMAT}{path.suffix}") if out is None else out / path.name
        try:
            line = f"{path}: {migrate(path, target)}, written to {target}"
            report_progress(line, facts={"written": [str(target)]})
        except InputError as error:
            failed.append(str(error))
    if failed:  # one line, whatever the number of files; the first reason stands for the others
        more = f" ({len(failed)} of {len(files)} files were not converted)" if len(files) > 1 else ""
        raise InputError(f"{failed[0]}{more}")
