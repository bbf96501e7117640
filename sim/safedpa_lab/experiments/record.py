"""The record of an experiment: its command-line parameters, how it is run, and what it writes."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Final, TypeVar, final

import click

from safedpa.errors import InputError, did_you_mean

T = TypeVar("T")
Options = Mapping[str, Any]
"""The parameters of a run by their names."""
Result = dict[str, Any]
"""The JSON document of a run."""
ReportProgress = Callable[[int, int], None]
"""Called with the number of finished and of all parts."""


def silent(done: int, everything: int) -> None:
    """Reports no progress."""


@final
class Parameter(click.Option):
    """An option of an experiment that also checks the values that click cannot check.

    ``known`` names a container of the allowed values as "module:name". It is imported only when the experiment runs, so
    that ``--help`` stays fast. ``positive`` excludes 0, negative and infinite numbers, ``least`` is an inclusive bound.
    ``writes`` is the kind of output at that path: "json", "markdown", "figure", or a "folder" with all three. A
    "record" is a file, and "records" a folder, that the run writes itself while it works.
    """

    def __init__(
        self,
        *names: str,
        positive: bool = False,
        least: float | None = None,
        known: str = "",
        writes: str = "",
        **settings: Any,
    ) -> None:
        super().__init__(list(names), **settings)
        self.positive, self.least, self.known, self.writes = positive, least, known, writes

    def check(self, value: Any) -> None:
        """Raises InputError for a value that is out of range, unknown, or a file in a folder that does not exist."""
        option = self.opts[0]
        if value is None:
            return
        if self.positive and not 0 < value < inf:
            raise InputError(f"{option}: got {value}, wanted more than 0")
        if self.least is not None and not self.least <= value < inf:
            raise InputError(f"{option}: got {value}, wanted at least {self.least:g}")
        if self.known:
            known = tuple(resolve(self.known))
            for given in value if self.multiple else (value,):
                if given not in known:
                    raise InputError(f"{option}: got '{given}'; {did_you_mean(given, known)}")
        if self.writes in ("json", "markdown", "figure", "record") and not value.absolute().parent.is_dir():
            raise InputError(f"{option} {value}: folder {value.parent} does not exist; create it")


def integer(name: str, default: int | None = None, text: str | None = None, **settings: Any) -> Parameter:
    """A whole number."""
    return number(name, default, text, type=int, **settings)


def number(name: str, default: float | None = None, text: str | None = None, **settings: Any) -> Parameter:
    """A real number."""
    settings = {"type": float, "show_default": default is not None, **settings}
    return Parameter(name, default=default, help=text, **settings)


def scenes(count: int, first: int, what: str, drive: str, seconds: float = 20.0) -> tuple[Parameter, ...]:
    """``--seeds``, ``--first-seed`` and ``--seconds`` of each ``drive``; ``what`` says of what there are so many."""
    return (
        integer("--seeds", count, what, positive=True),
        integer("--first-seed", first),
        number("--seconds", seconds, f"simulated time per {drive}", positive=True),
    )


def text(name: str, default: str | None = None, text: str | None = None, **settings: Any) -> Parameter:
    """A text."""
    return Parameter(name, default=default, show_default=default is not None, help=text, **settings)


def repeated(name: str, plural: str, text: str, **settings: Any) -> Parameter:
    """An option that may be given several times; ``plural`` is its name among the options of a run."""
    return Parameter(name, plural, multiple=True, help=text, **settings)


def switch(name: str, text: str, *names: str, **settings: Any) -> Parameter:
    """A flag."""
    return Parameter(name, *names, is_flag=True, help=text, **settings)


def path(name: str, text: str | None = None, *names: str, **settings: Any) -> Parameter:
    """A file or folder. A folder is refused where the experiment writes a file."""
    is_file = settings.get("writes") in ("json", "markdown", "figure", "record")
    return Parameter(name, *names, type=click.Path(path_type=Path, dir_okay=not is_file), help=text, **settings)


FILE_OUT: Final = path("--out", "also write the result to this JSON file", writes="json")
FOLDER_OUT: Final = path("--out", "folder for tables, JSON and figures", writes="folder")
PAGE_OUT: Final = path("--page", "also write the tables to this Markdown file", writes="markdown")
PROCESSES: Final = integer("--processes", 2, positive=True)
RECORD: Final = path("--record", "keep each drive in this file; drives that it holds are not repeated", writes="record")
MODEL: Final = text("--model", "car", "model file, or the name of a shipped model")
SETTINGS: Final = text("--settings", "car", "settings of the filter: a file or a name")
JSON: Final = switch("--json", "print one JSON document and nothing else", "as_json")


@final
@dataclass(frozen=True)
class Experiment:
    """One experiment: ``safedpa experiment NAME``.

    Functions are named as "module:function" and imported when they are needed: the list of all experiments is read for
    every ``--help``, which has to work without the optional packages.
    """

    name: str
    help: str
    """The first sentence is the one-line description."""
    run: str
    """Called with the options and a function that reports progress; returns the result."""
    parameters: tuple[click.Parameter, ...]
    report: str
    """Called with the result; returns the tables as Markdown."""
    figures: str = ""
    """Called with the result and the folder, or the figure file, to draw into."""
    document: str = ""
    """Called with the result; returns what its JSON file keeps of it. Default: everything."""
    verdict: str = ""
    """Called with the result after it was written; raises SafedpaError where the experiment failed."""
    listing: str = ""
    """Called with the options for ``--list``; returns the lines to print."""
    extras: tuple[str, ...] = ()
    """Optional dependencies of the distribution that it needs."""
    small: tuple[str, ...] = ()
    """Options of a version that takes seconds. It shows that the experiment runs; its figures mean nothing."""
    stem: str = ""
    """Name of the files in the output folder. Default: the name of the experiment."""

    @property
    def module(self) -> str:
        """The module whose code the results depend on."""
        return self.run.partition(":")[0]

    @property
    def summary(self) -> str:
        """One line: the first sentence of the help text."""
        return self.help.partition("\n\n")[0].replace("\n", " ").partition(". ")[0].rstrip(".")

    def check(self, options: Options) -> None:
        """Raises InputError for the first parameter that is out of range."""
        for parameter in self.parameters:
            if isinstance(parameter, Parameter):
                parameter.check(options[parameter.name or ""])

    def outputs(self, options: Options) -> dict[str, Path]:
        """The files and folders that this run writes, by kind."""
        written = [item for item in self.parameters if isinstance(item, Parameter) and item.writes]
        return {item.writes: value for item in written if (value := options[item.name or ""]) is not None}


def with_options(call: Callable[..., T], options: Options, **known: Any) -> T:
    """Calls a function or class with the options of its parameters' names; what was not given keeps its default."""
    names = inspect.signature(call).parameters
    given = {name: value for name, value in options.items() if name in names and value not in (None, ())}
    return call(**{**given, **known})


def resolve(name: str) -> Any:
    """The object that "module:name" names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def named_folder(option: str, folder: Path, default: Path = Path()) -> None:
    """Raises InputError for a folder that the user named and that does not exist: shipped models would replace it."""
    if folder != default and not folder.is_dir():
        raise InputError(
            f"{option} {folder}: got no folder that exists, wanted one; without {option} what ships is taken"
        )
