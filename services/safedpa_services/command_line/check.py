"""``safedpa check``: checks that a user's own robot is declared completely and can be filtered safely."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa_services.command_line.options import as_json_option

__all__ = ["command"]


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="FILE.py")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="seed of the test drive")
@as_json_option
def command(file: Path, seed: int, as_json: bool) -> int:
    """Check a robot of your own. Prints one line per part: fine, missing or wrong; exit code 2 if any is not fine.

    FILE.py declares the robot, a class derived from AbstractRobot. For the test, its simulation is driven by random
    nominal actions through its filter.
    """
    from safedpa.check_robot import check_robot
    from safedpa.dynamics import load_user_file
    from safedpa.systems.robots import robots

    names = [name for name in load_user_file(file) if name in robots()]
    if not names:
        raise InputError(f"{file}: got no robot, wanted a class derived from AbstractRobot")
    found = {name: check_robot(robots()[name], seed) for name in names}
    if as_json:
        click.echo(json.dumps({name: [asdict(one) for one in parts] for name, parts in found.items()}))
    else:
        for name, parts in found.items():
            click.echo(f"robot '{name}'")
            for one in parts:
                click.echo(f"  {one.verdict:<8}{one.part}: {one.sentence}")
    return 0 if all(one.ends_well for parts in found.values() for one in parts) else 2
