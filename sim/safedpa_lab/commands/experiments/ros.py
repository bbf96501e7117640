"""``safedpa experiment ros``: a ROS 2 car through the gateway."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="ros")
@click.option("--drives", type=int, default=10, show_default=True, help="with the filter, and as many without")
@click.option("--first-seed", type=int, default=0, show_default=True, help="of the scenes kept for evaluation")
@click.option("--seconds", type=float, default=10.0, show_default=True, help="of driving in each")
@click.option("--fault", "faults", multiple=True, metavar="NAME", help="this one alone; 'none' for none; default: all")
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--page", type=click.Path(path_type=Path), help="write a page there as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("ros", "sim")
def command(**options: Any) -> None:
    """A simulated ROS 2 car, driven by a policy of its own through the gateway: collisions, sense to act, faults.

    The car speaks by another implementation of the wire (zenoh-ros2-sdk). In real time, so let the machine do nothing
    else.
    """
    from safedpa_lab.experiments.ros_report import page_of

    check_positive(options, "drives", "seconds")
    for name in ("out", "page"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
    result = _measured(options)
    if options["out"] is not None:
        write_result(options["out"], result)
    if options["page"] is not None:
        options["page"].write_text(page_of(result), encoding="utf-8")
    click.echo(json.dumps(result) if options["as_json"] else page_of(result), nl=options["as_json"])


def _measured(options: dict[str, Any]) -> dict[str, Any]:
    from safedpa.errors import did_you_mean
    from safedpa_lab.experiments.ros_faults import FAULTS
    from safedpa_lab.experiments.seeds import seeds_for
    from safedpa_services.progress import progress

    faults = tuple(FAULTS) if not options["faults"] else tuple(one for one in options["faults"] if one != "none")
    for fault in faults:
        if fault not in FAULTS:
            raise InputError(f"--fault '{fault}': {did_you_mean(fault, FAULTS)}")
    seeds = seeds_for("evaluation", options["drives"], options["first_seed"])
    try:
        from safedpa_lab.experiments.ros import ros_experiment
    except ModuleNotFoundError as error:
        raise InputError(f"module {error.name} is missing; install safedpa-lab with its extra 'ros'") from error
    asked = f"safedpa experiment ros --drives {options['drives']} --seconds {options['seconds']:g}"
    asked += f" --first-seed {options['first_seed']}" if options["first_seed"] else ""
    with progress("experiment ros") as report_progress:
        return {
            "experiment": "ros",
            "command": asked,
            **ros_experiment(seeds, options["seconds"], faults, report_progress),
        }
