"""Attacks on processes and files: mutated input, oversized files, offers, silent connections, floods, and faults.

``campaign`` runs one kind of attack; ``targets`` lists what reads mutated input, ``roads`` what reads oversized files.
"""

from __future__ import annotations

import click

from safedpa_lab.experiments.record import Experiment, Parameter, integer, path, switch, text

EXPERIMENTS = (
    Experiment(
        name="faults",
        help="""Inject faults into a fleet of real processes that drives in real time.

    A car with a box drives behind router and filter. Processes are killed, paused and hung, networks are cut,
    delayed and made to lose messages, clocks are set, the disk is filled. Exit code 1 when an invariant did not hold:
    no collision, no stale action, and the loop drives again; with --minutes also when a process grew.""",
        run="safedpa_lab.faults.experiment:run",
        parameters=(
            text("--only", text="one fault by name, or all of a kind, such as kill", metavar="NAME"),
            switch("--small", "a few of them: half a minute"),
            Parameter(
                "--minutes",
                type=click.FloatRange(1.0, None),
                help="run for this time on one fleet, in random order; also report memory and open files",
                metavar="M",
            ),
            switch("--list", "list the faults without running them", "listed"),
            integer("--seed", 9, "seed of scenes and lost messages"),
            path("--keep", "folder that keeps logs, traces and recordings", metavar="DIR"),
            path("--out", "folder for faults.json and faults.md", writes="folder", metavar="DIR"),
        ),
        report="safedpa_lab.faults.experiment:markdown_of",
        verdict="safedpa_lab.faults.experiment:verdict",
        listing="safedpa_lab.faults.experiment:listing",
        extras=("sim",),
        small=("--small",),
    ),
    Experiment(
        name="hostile",
        help="""Attack codec, loaders, page handlers and a driving loop with mutated input, or whole drives.

    mutations: each input has to be accepted or refused in one line, within the table of limits.
    roads: small files that request much have to be refused by every command that reads a file: one line, exit code 2,
    little memory, nothing written. offers: no tick may be late because of offered models. silent: clients have to join
    within a second next to a thousand silent connections. flood: a flood may brake no robot for longer than it lasts.
    Exit code 1 if an attack succeeded.""",
        run=f"{__name__}.campaign:run",
        parameters=(
            Parameter(
                "--attack",
                type=click.Choice(("mutations", "roads", "offers", "silent", "flood")),
                default="mutations",
                show_default=True,
                help="kind of attack",
            ),
            Parameter(
                "--seconds",
                type=click.FloatRange(0.1, 1000000.0),
                help="duration; default: 60, silent 20, each flood 5",
            ),
            integer("--seed", 1000, "seed of the mutations"),
            path("--out", "folder that keeps inputs that opened a hole", metavar="DIR"),
            path("--page", "folder for hostile.json and hostile.md", writes="records", metavar="DIR"),
        ),
        report=f"{__name__}.campaign:report",
        verdict=f"{__name__}.campaign:verdict",
        extras=("sim",),
    ),
)
