"""``safedpa experiment hostile``: mutated input against everything that reads what others sent."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa_services.command_line.options import as_json_option

__all__ = ["command"]


@click.command(name="hostile")
@click.option("--seconds", type=click.FloatRange(0.1), default=60.0, show_default=True, help="For so long.")
@click.option("--seed", type=int, default=1000, show_default=True, help="The same one gives the same inputs.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Keep what opened a hole there.")
@as_json_option
def command(seconds: float, seed: int, out: Path | None, as_json: bool) -> None:
    """Attack codec, loaders, pages' handlers and a loop that drives with mutated input.

    Each input is taken or refused in one line; anything else, or more time than the table of limits gives, is a hole,
    and the exit code is 1.
    """
    from safedpa.errors import SafedpaError
    from safedpa_lab.commands.experiments.hostile_pages import page_targets
    from safedpa_lab.experiments.hostile.fuzz import fuzz
    from safedpa_services.progress import progress

    with progress("attacking") as tell, page_targets() as pages:
        tallies = fuzz(seconds, seed, out, lambda share: tell(round(100.0 * share), 100), pages)
    if as_json:
        click.echo(
            json.dumps({"format": 1, "seconds": seconds, "seed": seed, "targets": [t.as_row() for t in tallies]})
        )
    else:
        for tally in tallies:
            holes = f"; HOLES: {'; '.join(tally.holes)}" if tally.holes else ""
            click.echo(
                f"{tally.name:<22} {tally.inputs:>9} inputs, {tally.refused:>9} refused, "
                f"slowest {1e3 * tally.worst_seconds:8.2f} ms{holes}"
            )
    if any(tally.holes for tally in tallies):
        raise SafedpaError(f"hostile: {sum(len(tally.holes) for tally in tallies)} holes; see above")
