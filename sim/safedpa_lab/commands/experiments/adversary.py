"""``safedpa experiment adversary``: attacks on the safety filter, counted whatever comes out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs

__all__ = ["command"]


@click.command(name="adversary")
@click.option("--only", multiple=True, metavar="NAME", help="this attack alone; may be repeated")
@click.option("--small", is_flag=True, help="small sizes: seconds instead of minutes")
@click.option("--list", "listed", is_flag=True, help="print the attacks and run none")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="draws problems, states, nominal actions"
)
@click.option("--workers", type=int, default=2, show_default=True, help="processes")
@click.option(
    "--peers", multiple=True, metavar="PYTHON", help="another Python that has peers installed; may be repeated"
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="folder for adversary.json and adversary.md; parts run into it by the same code and seed are joined",
)
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Attacks on the safety filter, judged by what shares no code with it.

    Random programs in all units, small systems under hostile nominal actions, the car against a grid of actions, whole drives,
    bad inputs, and other projects' filters on the same problems. Peers that are not installed are named as missing.
    Whatever is found is counted, next to what was asked; the exit code is 0 all the same.
    """
    from safedpa_lab.experiments.adversary.campaign import adversary, all_attacks, attacks_named
    from safedpa_lab.experiments.adversary.report import adversary_markdown, with_parts_before, write_adversary
    from safedpa_services.progress import progress

    attacks = attacks_named(options["only"], options["peers"])
    if options["listed"]:
        for attack in attacks:
            click.echo(f"{attack.name:12}{attack.sentence}")
        return
    if options["workers"] < 1:
        raise InputError(f"--workers: got {options['workers']}, wanted at least 1")
    everything = [attack.name for attack in all_attacks()]

    def whole(found: dict[str, Any]) -> dict[str, Any]:
        if options["out"] is not None:
            found = with_parts_before(found, options["out"], everything)
        names = [part["name"] for part in found["attacks"]]
        return {"command": _command(options, () if names == everything else names), **found}

    def keep(found: dict[str, Any]) -> None:
        if options["out"] is not None:
            write_adversary(whole(found), options["out"])

    with progress("experiment adversary") as report_progress:
        found = adversary(attacks, options["seed"], options["small"], options["workers"], report_progress, keep)
    click.echo(json.dumps(whole(found), default=float) if options["as_json"] else adversary_markdown(whole(found)))


def _command(options: dict[str, Any], names: Sequence[str]) -> str:
    only = "".join(f" --only {name}" for name in names)
    return f"safedpa experiment adversary{only}{' --small' if options['small'] else ''} --seed {options['seed']}"
