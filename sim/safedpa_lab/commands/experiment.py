"""``safedpa experiment NAME``: the commands of all experiments, generated from their records."""

from __future__ import annotations

import json
from typing import Any, final

import click

from safedpa.errors import did_you_mean
from safedpa.extras import need
from safedpa_lab.experiments.record import JSON, Experiment, resolve
from safedpa_lab.experiments.table import EXPERIMENTS


@final
class ExperimentCommand(click.Command):
    """The command of one experiment: checks its options, runs it, writes and prints its report."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__(
            experiment.name, params=[*experiment.parameters, JSON], callback=self._run, help=experiment.help
        )
        self.experiment = experiment

    def _run(self, as_json: bool, **options: Any) -> None:
        from safedpa.progress import progress
        from safedpa_lab.experiments.report import output_folder, report_text, write_report

        experiment = self.experiment
        need(*experiment.extras)
        experiment.check(options)
        if options.get("listed"):
            click.echo("\n".join(resolve(experiment.listing)(options)))
            return
        run = resolve(experiment.run)
        with output_folder(experiment.outputs(options).get("folder")):
            with progress(f"experiment {self.name}") as report_progress:
                result = run(options, report_progress)
            write_report(experiment, result, options)
        click.echo(json.dumps(result, default=float) if as_json else report_text(experiment, result), nl=as_json)
        if experiment.verdict:
            resolve(experiment.verdict)(result)


class _Experiments(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return list(EXPERIMENTS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        del ctx
        if cmd_name not in EXPERIMENTS:
            raise click.UsageError(f"experiment '{cmd_name}': {did_you_mean(cmd_name, EXPERIMENTS)}")
        return ExperimentCommand(EXPERIMENTS[cmd_name])


@click.command(name="experiment", cls=_Experiments)
def command() -> None:
    """Run an experiment: what the product shows, measured."""
