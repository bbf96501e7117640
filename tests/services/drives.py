"""Drives in real processes, started by the command line in this process, whose modules are already imported."""

import io
import json
from contextlib import redirect_stdout

from safedpa_services.command_line import safedpa


def run(*phrase):
    """Returns the JSON document that a command prints."""
    notice = io.StringIO()
    with redirect_stdout(notice):
        assert safedpa.run([*phrase, "--json"]) == 0
    assert notice.getvalue().count("\n") == 1
    return json.loads(notice.getvalue())


def drive(folder, *options):
    """Returns the summary of a drive in lockstep."""
    return run("up", "--headless", "--lockstep", "--out", str(folder), *options)
