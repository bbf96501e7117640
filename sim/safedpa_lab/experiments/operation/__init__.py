"""Operation over a long time and on a full disk, measured on the real processes of ``safedpa up``.

Read ``soak.py`` first: memory, page and disk of a fleet with its dashboard open in a browser. ``full_disk.py`` fills
the disk of a run in each phase, ``silences.py`` hangs or kills its processes.
"""

from __future__ import annotations

from safedpa_lab.experiments.record import FILE_OUT, Experiment, integer, number, path, repeated, switch

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (
    Experiment(
        name="soak",
        help="""Run a fleet for an hour with its dashboard open in a browser.

    Measures the memory of each process and of the page, and the growth of the files. Exit code 1 if a process grows
    by more than 5 MB after ten minutes, or the browser takes more than 1 GB, or the dashboard's file grows faster than
    the recording, a process restarts or a robot collides. A run of less than an hour is extrapolated to an hour, which
    the report states. Needs Chromium.""",
        run=f"{__name__}.soak:run",
        parameters=(
            number("--minutes", 60.0, "of driving", least=1.0),
            integer("--robots", 3, positive=True),
            integer("--seed", 1),
            path("--samples", "also append each sample to this file, of which a stopped run can be judged"),
            FILE_OUT,
        ),
        report=f"{__name__}.soak:report",
        verdict=f"{__name__}.soak:verdict",
        extras=("sim", "view", "workbench"),
        small=("--minutes", "1", "--robots", "1"),
    ),
    Experiment(
        name="full-disk",
        help="""Fill the disk of a run before it starts, while it drives, and at its end.

    Each run has a small file system in memory, which only the superuser can create. Another program takes the free
    space within seconds. Exit code 1 if a run does not end in time, restarts its robot, does not report the disk, or
    leaves an unreadable recording.""",
        run=f"{__name__}.full_disk:run",
        parameters=(number("--seconds", 12.0, "of driving per run", positive=True), integer("--seed", 1), FILE_OUT),
        report=f"{__name__}.full_disk:report",
        verdict=f"{__name__}.full_disk:verdict",
        extras=("sim",),
        small=("--seconds", "4"),
    ),
    Experiment(
        name="silences",
        help="""Hang each process of a run, and measure when status, terminal, headline and metrics report it.

    With --kill, kill each instead. Exit code 1 if a place takes more than 2 s, is right only for a time, or does not
    recover, or if a killed process is not replaced within 10 s. Alerts follow the metrics after the delay that their
    rule states. The supervisor replaces a service that hangs for 10 s.""",
        run=f"{__name__}.silences:run",
        parameters=(
            number("--seconds", 8.0, "for which each process hangs, or its end is observed", positive=True),
            repeated("--victim", "victims", "repeatable; default: all", known=f"{__name__}.silences:VICTIMS"),
            switch("--kill", "kill each process; a supervisor's end is the run's"),
            FILE_OUT,
        ),
        report=f"{__name__}.silences:report",
        verdict=f"{__name__}.silences:verdict",
        extras=("sim", "metrics"),
        small=("--seconds", "3"),
    ),
)
