"""The group of commands: names, one-line helps, and how errors become exit codes."""

from __future__ import annotations

import importlib
from importlib.metadata import version

import click

from safedpa.errors import InputError, SafedpaError, did_you_mean
from safedpa.limits import readable

__all__ = ["COMMANDS", "safedpa"]

COMMANDS = (
    "accept", "add", "bench", "calibrate", "certificates", "compare", "diagnose", "effects", "experiment", "export",
    "go", "predict", "rehearse", "reject", "replay", "roll-back", "screenshot", "status", "stop", "train",
    "train-baselines", "up", "workbench",
)  # fmt: skip
"""One file beside this one each, with a click command named ``command``; imported when it is called."""


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        del ctx
        if cmd_name not in COMMANDS:
            raise click.UsageError(f"command '{cmd_name}': {did_you_mean(cmd_name, COMMANDS)}")
        module = importlib.import_module(f"safedpa_services.command_line.{cmd_name.replace('-', '_')}")
        command: click.Command = module.command
        return command

    def run(self, arguments: list[str]) -> int:
        """Runs one command; returns its exit code."""
        try:
            code = self.main(arguments, prog_name="safedpa", standalone_mode=False)
        except click.exceptions.NoArgsIsHelpError as error:
            click.echo(error.format_message())
            return 0
        except click.ClickException as error:
            return _fail(error.format_message(), 2)
        except (click.Abort, KeyboardInterrupt):
            return _fail("interrupted", 1)
        except InputError as error:
            return _fail(str(error), 2)
        except SafedpaError as error:
            return _fail(str(error), 1)
        return code if isinstance(code, int) else 0


_LONGEST_MESSAGE = 2000
"""Letters; names and values in it may come from anybody."""


def _fail(message: str, code: int) -> int:
    click.echo(f"safedpa: {readable(' '.join(message.split()), _LONGEST_MESSAGE)}", err=True)
    return code


def _told(context: click.Context, option: click.Parameter, asked: bool) -> None:
    """The version, and what the filter's innermost modules are; they are imported only for this."""
    del option
    if asked and not context.resilient_parsing:
        from safedpa.compiled import compiled_modules

        road = "compiled" if compiled_modules() else "Python source"
        click.echo(f"safedpa, version {version('safedpa')}; the filter's innermost modules: {road}")
        context.exit()


@click.command(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_told, help="Show the version and exit."
)
def safedpa() -> None:
    """Safe deep policy adaptation: drive safely, compare the model with measurements, find what it lacks."""
