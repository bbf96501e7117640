"""The group of commands: names, one-line helps, and how errors become exit codes."""

from __future__ import annotations

import importlib
from importlib.metadata import EntryPoint, entry_points, version

import click

from safedpa.errors import InputError, MissingExtraError, SafedpaError, did_you_mean
from safedpa.extras import extra_of
from safedpa.limits import readable

__all__ = ["COMMANDS", "safedpa"]

COMMANDS = (
    "accept", "add", "calibrate", "certificates", "check", "columns", "compare", "demo", "diagnose",
    "effects", "export", "go", "migrate", "predict", "rehearse", "reject", "replay", "roll-back", "ros", "screenshot",
    "sense", "serve", "status", "stop", "train", "up", "workbench",
)  # fmt: skip
"""One file next to this one each, with a click command named ``command``; imported when it is called."""

ENTRY_POINTS = "safedpa.commands"
"""The group under which other distributions bring commands: name = "module:command"."""

LABORATORY = ("bench", "experiment", "results", "train-baselines")
"""What safedpa-lab brings."""


START = """\
safedpa drives a robot behind a safety filter, and finds out what its model of the robot lacks.

What to do first:
  safedpa demo                        two minutes: a fault while it drives, found, corrected by your click
  safedpa up                          drive the simulated car; prints the address of the live view; Ctrl-C ends it
  safedpa up --no-filter              the same without the filter, to see what it is for
  safedpa compare MODEL RUN...        how wrong is a model, and where? MODEL: a file, or a name such as car
  safedpa diagnose MODEL RUN...       which physical effect does it lack?
  safedpa workbench MODEL RUN...      the same by looking and clicking
  safedpa effects                     the effects that it knows

Every command: safedpa --help. One of them: safedpa up --help. Pages: docs/index.md, or make docs."""
"""What ``safedpa`` alone says."""


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return sorted({*COMMANDS, *(point.name for point in entry_points(group=ENTRY_POINTS))})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        if cmd_name in COMMANDS:
            module = importlib.import_module(f"safedpa_services.command_line.{cmd_name.replace('-', '_')}")
            command: click.Command = module.command
            return command
        for point in entry_points(group=ENTRY_POINTS, name=cmd_name):
            return _brought(point)
        if cmd_name in LABORATORY:
            raise MissingExtraError(
                f"'safedpa {cmd_name}' belongs to the laboratory: pip install 'safedpa[lab]', or pip install ./sim"
            )
        raise click.UsageError(f"command '{cmd_name}': {did_you_mean(cmd_name, self.list_commands(ctx))}")

    def run(self, arguments: list[str]) -> int:
        """Runs one command; returns its exit code."""
        try:
            code = self.main(arguments, prog_name="safedpa", standalone_mode=False)
        except click.exceptions.NoArgsIsHelpError as error:
            click.echo(error.format_message() if arguments else START)
            return 0
        except click.ClickException as error:
            return _fail(_with_cure(error), 2)
        except (click.Abort, KeyboardInterrupt):
            return _fail("interrupted", 1)
        except SafedpaError as error:
            return _fail(str(error), 2 if isinstance(error, (InputError, MissingExtraError)) else 1)
        except ModuleNotFoundError as error:  # of a part that no command names beforehand
            extra = extra_of(error.name or "")
            if extra is None:
                raise
            return _fail(f"{arguments[0]} needs pip install 'safedpa[{extra}]'; not installed: {error.name}", 2)
        return code if isinstance(code, int) else 0


def _brought(point: EntryPoint) -> click.Command:
    """The command of another distribution; where none is behind its entry point, one that says so when it runs."""
    distribution = point.dist.name if point.dist else "an unknown distribution"
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and extra_of(error.name or "") is not None:
            raise
        return _broken(point.name, f"{distribution}: {point.value} cannot be loaded: {error}; reinstall {distribution}")
    if isinstance(found, click.Command):
        return found
    return _broken(
        point.name, f"{distribution}: got {type(found).__name__} behind {point.value}, wanted a click command"
    )


def _broken(name: str, reason: str) -> click.Command:
    def refuse(**_: object) -> None:
        raise InputError(f"command '{name}' of {reason}")

    return click.Command(name, callback=refuse, help=f"Broken: {reason}.", short_help=f"Broken: {reason}.")


def _with_cure(error: click.ClickException) -> str:
    """The message, and where it says no more than that something is missing or unknown, what to look at."""
    message = error.format_message().rstrip()
    asked = getattr(error, "ctx", None)
    if asked is None or "did you mean" in message.lower() or "known:" in message:
        return message
    return f"{message.rstrip('.')}; '{asked.command_path} --help' says what it takes"


_LONGEST_MESSAGE = 2000
"""Letters; names and values in it may come from anybody."""


def _fail(message: str, code: int) -> int:
    click.echo(f"safedpa: {readable(' '.join(message.split()), _LONGEST_MESSAGE)}", err=True)
    return code


def _reported(context: click.Context, option: click.Parameter, asked: bool) -> None:
    """The version, and what the filter's innermost modules are; they are imported only for this."""
    del option
    if asked and not context.resilient_parsing:
        from safedpa.compiled import compiled_modules

        road = "compiled" if compiled_modules() else "Python source"
        click.echo(f"safedpa, version {version('safedpa')}; the filter's innermost modules: {road}")
        context.exit()


@click.command(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_reported, help="Show the version and exit."
)
def safedpa() -> None:
    """Safe deep policy adaptation: drive safely, compare the model with measurements, find what it lacks."""
