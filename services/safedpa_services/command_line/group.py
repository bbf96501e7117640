"""The group of all commands: finds and loads commands, and turns errors into messages and exit codes."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import importlib
import os
import sys
from importlib.metadata import EntryPoint, entry_points, version
from importlib.util import find_spec
from pathlib import Path

import click

from safedpa.errors import InputError, MissingExtraError, SafedpaError, did_you_mean
from safedpa.extras import extra_of, need_linux
from safedpa.limits import readable

COMMANDS = (
    "accept", "add", "calibrate", "certificates", "check", "columns", "compare", "demo", "diagnose",
    "dismiss", "effects", "export", "go", "init", "migrate", "predict", "refit", "rehearse", "reject", "remove",
    "replay", "roll-back", "ros", "screenshot", "sense", "serve", "status", "stop", "train", "up", "workbench",
)  # fmt: skip
"""Each is the click command ``command`` of the module of its name in this package, imported when it is called."""
_IN_SHARED_MODULES = {
    "accept": "change_requests", "reject": "change_requests", "roll-back": "change_requests",
    "refit": "refit", "remove": "refit",
    "dismiss": "stop_orders", "go": "stop_orders", "stop": "stop_orders",
}  # fmt: skip
"""Commands of which several are in one module, each under its own name."""

_SERVICES = ("demo", "ros", "serve", "up")
"""Commands that start services."""

ENTRY_POINTS = "safedpa.commands"
"""Entry-point group with which other distributions add commands: name = "module:command"."""

LABORATORY = ("bench", "experiment", "results", "train-baselines")
"""Commands of the distribution safedpa-lab."""


START = """\
safedpa drives a robot behind a safety filter, and finds out what the robot's model lacks.

Start with:
  safedpa demo                        in two minutes: a fault during a drive, diagnosed, corrected with your click
  safedpa up                          drive the simulated car; prints the address of the live view; Ctrl-C ends it
  safedpa up --no-filter              the same without the safety filter, for comparison
  safedpa compare MODEL RUN...        how wrong is a model, and where? MODEL: a file, or a name such as car
  safedpa diagnose MODEL RUN...       which physical effect does the model lack?
  safedpa workbench MODEL RUN...      compare and diagnose on a web page
  safedpa effects                     list the known physical effects

All commands: safedpa --help. One command: safedpa up --help. Documentation: docs/index.md, or make docs."""
"""Printed by ``safedpa`` without arguments."""


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return sorted({*COMMANDS, *(point.name for point in entry_points(group=ENTRY_POINTS))})

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        found = super().resolve_command(ctx, args)
        if found[0] in _SERVICES:
            need_linux(f"'safedpa {found[0]}'")
        return found

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        if cmd_name in COMMANDS:
            name = cmd_name.replace("-", "_")
            module = importlib.import_module(f"{__package__}.{_IN_SHARED_MODULES.get(cmd_name, name)}")
            command: click.Command = getattr(module, name if cmd_name in _IN_SHARED_MODULES else "command")
            return command
        for point in entry_points(group=ENTRY_POINTS, name=cmd_name):
            return _load_command(point)
        if cmd_name in LABORATORY:
            raise MissingExtraError(
                f"'safedpa {cmd_name}' is part of the laboratory: pip install 'safedpa[lab]', or pip install ./sim"
            )
        raise click.UsageError(f"command '{cmd_name}': {did_you_mean(cmd_name, self.list_commands(ctx))}")

    def run(self, arguments: list[str]) -> int:
        """Runs a command and returns its exit code."""
        try:
            code = self.main(arguments, prog_name="safedpa", standalone_mode=False)
        except click.exceptions.NoArgsIsHelpError as error:
            click.echo(error.format_message() if arguments else START)
            return 0
        except click.ClickException as error:
            reason, code = _with_remedy(error), 2
        except (click.Abort, KeyboardInterrupt):
            reason, code = "interrupted", 1
        except SafedpaError as error:
            reason, code = str(error), 2 if isinstance(error, (InputError, MissingExtraError)) else 1
        except ModuleNotFoundError as error:  # of an extra that the command did not check
            extra = extra_of(error.name or "")
            if extra is None:
                raise
            reason, code = f"{arguments[0]} needs pip install 'safedpa[{extra}]'; not installed: {error.name}", 2
        except OSError as error:
            if error.filename is not None or error.errno not in _NOT_PRINTED:
                raise
            _give_up_output()
            reason, code = f"cannot print ({error.strerror}); redirect the output, or name a file with --out", 1
        else:
            return code if isinstance(code, int) else 0
        return _fail(reason, code)


def _load_command(point: EntryPoint) -> click.Command:
    """Loads a command of another distribution; if that fails, returns a command that reports why."""
    distribution = point.dist.name if point.dist else "an unknown distribution"
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and extra_of(error.name or "") is not None:
            raise
        return _broken(point.name, f"{distribution}: {point.value} cannot be loaded: {error}; reinstall {distribution}")
    if isinstance(found, click.Command):
        return found
    return _broken(point.name, f"{distribution}: got {type(found).__name__} at {point.value}, wanted a click command")


def _broken(name: str, reason: str) -> click.Command:
    def refuse(**_: object) -> None:
        raise InputError(f"command '{name}' of {reason}")

    return click.Command(name, callback=refuse, help=f"Broken: {reason}.", short_help=f"Broken: {reason}.")


def _with_remedy(error: click.ClickException) -> str:
    """Returns click's message; adds a hint to the help unless the message already suggests something."""
    message = error.format_message().rstrip()
    asked = getattr(error, "ctx", None)
    if asked is None or "did you mean" in message.lower() or "known:" in message:
        return message
    return f"{message.rstrip('.')}; '{asked.command_path} --help' lists the options"


_NOT_PRINTED = (errno.ENOSPC, errno.EIO, errno.EBADF, errno.EPIPE, errno.EFBIG, errno.EDQUOT)
"""Errors of a standard output that is full, closed, or a terminal that is gone."""


def _give_up_output() -> None:
    """Sends the rest of the standard output nowhere: the interpreter writes what is buffered when it ends."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


_LONGEST_MESSAGE = 2000
"""Characters; the message may contain text from untrusted files or messages."""


def _fail(message: str, code: int) -> int:
    with contextlib.suppress(OSError):  # the standard error can be full or closed as well
        click.echo(f"safedpa: {readable(' '.join(message.split()), _LONGEST_MESSAGE)}", err=True)
    return code


def _print_version(context: click.Context, option: click.Parameter, wanted: bool) -> None:
    """Prints the version, a digest of the source, and whether the filter's decisions are compiled."""
    del option
    if wanted and not context.resilient_parsing:
        from safedpa.native.library import why_not_compiled

        reason = why_not_compiled()
        kind = f"Python ({reason})" if reason else "compiled"
        click.echo(f"safedpa, version {version('safedpa')}; source {_source_digest()}; the filter's decisions: {kind}")
        context.exit()


def _source_digest() -> str:
    """Returns twelve hex digits of a SHA-256 over the source and settings of this installation.

    A checkout and a wheel that was built from it have the same digest.
    """
    digest = hashlib.sha256()
    for package in ("safedpa", "safedpa_services", "safedpa_sim"):
        found = find_spec(package)
        for folder in map(Path, (found.submodule_search_locations or ()) if found else ()):
            for path in sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".toml", ".c")):
                digest.update(f"{package}/{path.relative_to(folder).as_posix()}|".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


@click.command(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show the version and exit.",
)
def safedpa() -> None:
    """Safe deep policy adaptation: drive safely, compare the model with measurements, find missing effects."""
