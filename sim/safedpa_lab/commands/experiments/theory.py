"""``safedpa experiment theory``: the constants of the theory's bound, measured in a training simulator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.provenance.record import write_result
from safedpa_services.command_line.names import complete_models

__all__ = ["command"]


@click.command(name="theory")
@click.argument("model", shell_complete=complete_models)
@click.option("--simulator", default="car", show_default=True, help="training configuration: a file or a name")
@click.option("--states", type=click.IntRange(min=1), default=4000, show_default=True, help="to measure them at")
@click.option("--coverage", type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True), default=0.99)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(
    model: str, simulator: str, states: int, coverage: float, seed: int, out: Path | None, as_json: bool
) -> None:
    """The constants of the theory's bound for a learned MODEL, next to what measuring the error itself gives.

    Both are counted on fresh states of the training simulator.
    """
    from safedpa.dynamics import LearnedBase, load_model
    from safedpa_lab.experiments.theory import theory_experiment
    from safedpa_sim.training.configuration import load_configuration

    base = load_model(model).base
    if not isinstance(base, LearnedBase):
        raise InputError(f"model '{model}': it has no networks, wanted a learned one, such as car_simulated")
    found = theory_experiment(base.weights, load_configuration(simulator), states, coverage, seed)
    if out is not None:
        write_result(out, found)
    click.echo(json.dumps(found) if as_json else "\n".join(_lines(found)))


def _lines(found: dict[str, Any]) -> list[str]:
    lines = [f"{found['states']} states and as many fresh ones, coverage {found['coverage']:g}, scaled"]
    for name, pair in found["constants"].items():
        lines.append(f"  epsilon_{name:<12} {pair['at_coverage']:8.4f}   largest seen {pair['largest']:.4f}")
    for name, pair in found["lipschitz"].items():
        lines.append(f"  lipschitz_{name:<10} {pair['bound']:8.4f}   largest slope seen {pair['largest_slope']:.4f}")
    for name, value in (("bound", found["bound"]["at_coverage"]), ("conformal", found["conformal"])):
        lines.append(f"  {name:<20} {value:8.4f}   covers {100 * found['covered'][name]:.2f} % of fresh steps")
    return lines
