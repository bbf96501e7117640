"""``safedpa check``: checks that a user's own robot is declared completely and can be filtered safely."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa_services.command_line.options import as_json_option


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="FILE.py")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="seed of the test drive")
@as_json_option
def command(file: Path, seed: int, as_json: bool) -> int:
    """Check a robot of your own. Prints one line per part: fine, missing or wrong; exit code 2 if any is not fine.

    FILE.py declares the robot, a class derived from AbstractRobot. The file is executed: check only files that you
    trust. For the test, its simulation is driven by random
    nominal actions through its filter.
    """
    from safedpa.api.robot_check import check

    found = check(file, seed=seed)
    click.echo(json.dumps(found.to_dict()) if as_json else str(found))
    return 0 if found.passed else 2
