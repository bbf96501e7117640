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

    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    failures = 0
    for path in files:
        target = path.with_suffix(f".format{FORMAT}{path.suffix}") if out is None else out / path.name
        try:
            line = f"{path}: {migrate(path, target)}, written to {target}"
            report_progress(line, facts={"written": [str(target)]})
        except InputError as error:
            failures += 1
            click.echo(f"safedpa: {error}", err=True)
    if failures:
        raise InputError(f"{failures} of {len(files)} files were not converted; see the lines above")
