"""Plants small faults in what keeps robots safe, judges or identifies, one at a time: do the tests notice?

    python deploy/mutation/run.py [--report] [MODULE ...]

Each mutant runs in a forked process at low priority, judged by the tests that run its line first (``trial.py``). What
came out is kept in ``build/mutation`` as it comes (``kept.py``): a run that is cut goes on there, and so does one after
tests were added. Writes ``summary.json`` and ``summary.md`` beside this file; a run of some modules renews their part.
With ``--report`` nothing runs: the summary is renewed by what is kept, where that is whole. Exit code 0: every mutant
was killed, or its survival is explained in ``survivors.md``, which then holds "module: `name`"; 1: some survivor is
unexplained; 2: the tests fail without any fault.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path[:0] = [str(HERE), *(str(ROOT / folder) for folder in ("shared", "services", "sim"))]

from kept import LATER, SURVIVED, Kept  # noqa: E402 - found beside this file
from mutants import mutants  # noqa: E402
from registered import MODULES  # noqa: E402
from trial import Trial, judged  # noqa: E402

PACKAGE = "safedpa.safety"

LABORATORY = "safedpa_lab"

TOOLS = ("cryptography.x509", "gymnasium", "hypothesis", "msgspec", "numpy", "piqp", "pytest", "quadprog")
"""What the modules under test stand on; of the house's own modules none, since any may be the one that is judged."""


def import_what_is_not_mutated() -> None:
    """So that a forked process has it at once."""
    for name in (*TOOLS, "scipy.optimize", "scipy.stats"):
        if importlib.util.find_spec(name.partition(".")[0]):  # some come with an extra alone
            importlib.import_module(name)
    if early := [name for name in sys.modules if name.partition(".")[0] in ("safedpa", LABORATORY)]:
        raise RuntimeError(f"{early[0]} is imported already: no fault planted there would be seen")


def path_of(module: str) -> Path:
    """The file of a registered module."""
    name = name_of(module)
    folder = "sim" if name.startswith(f"{LABORATORY}.") else "shared"
    return ROOT / folder / Path(*name.split(".")).with_suffix(".py")


def name_of(module: str) -> str:
    """As it is imported."""
    if module.startswith(f"{LABORATORY}."):
        return module
    return f"safedpa.{module}" if "." in module else f"safedpa.safety.{module}"


def source_of(module: str) -> str:
    """Which text of the module it is, in twelve digits: a row of the summary with others is older than its code."""
    return hashlib.sha256(path_of(module).read_bytes()).hexdigest()[:12]


def commit() -> str:
    """Of the working tree, short."""
    words = ["git", "rev-parse", "--short=9", "HEAD"]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def trial_of(module: str) -> Trial:
    """The module's mutants, and what is known of them."""
    source, tests = path_of(module).read_text(encoding="utf-8"), ROOT / "tests" / "safety"
    names = [name for name in MODULES[module] if not name.startswith("-")]
    files = [(tests / name.partition("::")[0]).resolve() for name in names]
    arguments = [f"--rootdir={ROOT}", *[str(tests / name) for name in names]]
    left_out = [name[1:] for name in MODULES[module] if name.startswith("-")]
    arguments += [f"--deselect={os.path.normpath(f'tests/safety/{name}')}" for name in left_out]
    today, path = datetime.date.today().isoformat(), ROOT / "build" / "mutation" / f"{module}.jsonl"
    kept = Kept(path, ROOT, source, files, today, commit())
    return Trial(name_of(module), path_of(module), mutants(source), tuple(arguments), kept)


def main(arguments: list[str]) -> int:
    """Runs every mutant of the wanted modules (default: all) and writes the summary."""
    only_report, wanted = asked(arguments)
    os.nice(10)
    os.chdir(ROOT)
    if not only_report:
        import_what_is_not_mutated()
    rows, survivors, start = list[dict[str, Any]](), list[dict[str, Any]](), time.monotonic()
    text, open_ones = report([], [])
    for module in wanted:
        trial = trial_of(module)
        if not only_report and not judged(trial):
            sys.stderr.write(f"{module}: its tests fail without any fault; repair them first\n")
            return 2
        found = trial.kept.valid()
        known = [found[mutant.name] for mutant in trial.mutants if mutant.name in found]
        if len(known) < len(trial.mutants) or any(entry.outcome == LATER for entry in known):
            continue
        left = [mutant for mutant in trial.mutants if found[mutant.name].outcome == SURVIVED]
        last = max(known, key=lambda entry: entry.date, default=None)
        row = {"module": module, "mutants": len(known), "survived": len(left), "source": source_of(module)}
        rows.append(row | {"date": last.date if last else "", "commit": last.commit if last else ""})
        survivors += [{"module": module, "line": mutant.line, "name": mutant.name} for mutant in left]
        seconds = time.monotonic() - start
        sys.stderr.write(f"{module}: {len(known)} mutants, {len(left)} survived, {seconds:.0f} s\n")
        text, open_ones = report([*rows], [*survivors])  # after each: a run that is cut keeps what it did
    sys.stdout.write(text)
    return 1 if open_ones else 0


def asked(arguments: list[str]) -> tuple[bool, list[str]]:
    """Whether nothing is to run, and the modules; ends with one line and exit code 2 where one is not registered."""
    parser = argparse.ArgumentParser(prog="run.py", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--report", action="store_true", help="run nothing: renew the summary by what is kept")
    parser.add_argument("modules", nargs="*", metavar="MODULE", help="of registered.py; default: all")
    options = parser.parse_args(arguments)
    for module in options.modules:
        if module not in MODULES:
            parser.error(f"{module}: wanted a module of registered.py, for example {next(iter(MODULES))}")
    return options.report, options.modules or list(MODULES)


def report(rows: list[dict[str, Any]], survivors: list[dict[str, Any]]) -> tuple[str, int]:
    """Renews these modules' part of the summaries; the text of ``summary.md``, and how many survivors are open."""
    path, renewed = HERE / "summary.json", {row["module"] for row in rows}
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"modules": [], "survivors": []}
    rows += [row for row in before["modules"] if row["module"] not in renewed and row["module"] in MODULES]
    survivors += [entry for entry in before["survivors"] if entry["module"] not in renewed]
    survivors = [entry for entry in survivors if entry["module"] in MODULES]
    explained = (HERE / "survivors.md").read_text(encoding="utf-8") if (HERE / "survivors.md").exists() else ""
    for entry in survivors:
        entry["explained"] = f"{entry['module']}: `{entry['name']}`" in explained
    order = list(MODULES)
    rows.sort(key=lambda row: order.index(row["module"]))
    survivors.sort(key=lambda entry: (order.index(entry["module"]), entry["line"]))
    total = sum(row["mutants"] for row in rows)
    document = {"mutants": total, "killed": total - len(survivors), "modules": rows, "survivors": survivors}
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    text = "\n".join(table(rows, survivors, explained)) + "\n"
    (HERE / "summary.md").write_text("# Mutation run\n\n" + text, encoding="utf-8")
    return text, sum(not entry["explained"] for entry in survivors)


def table(rows: list[dict[str, Any]], survivors: list[dict[str, Any]], explained: str) -> list[str]:
    """The lines of ``summary.md``: noticed are the killed ones among those that are not explained as equivalent."""
    equivalent = Counter(entry["module"] for entry in survivors if entry["explained"])
    equivalent["all"] = sum(equivalent.values())
    total = {"module": "all", "mutants": sum(row["mutants"] for row in rows), "survived": len(survivors)}
    lines = ["| module | mutants | killed | survived | of them equivalent | noticed | run on | commit |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for row in [*rows, total]:
        killed, same = row["mutants"] - row["survived"], equivalent[row["module"]]
        noticed = f"{100.0 * killed / (row['mutants'] - same):.1f} %" if row["mutants"] > same else ""
        numbers = f"{row['mutants']} | {killed} | {row['survived']} | {same} | {noticed}"
        lines.append(f"| {row['module']} | {numbers} | {row.get('date', '')} | {row.get('commit', '')} |")
    missing = [module for module in MODULES if module not in {row["module"] for row in rows}]
    older = [row["module"] for row in rows if row.get("source") != source_of(row["module"])]
    open_ones = [survivor for survivor in survivors if not survivor["explained"]]
    alive = {f"- {entry['module']}: `{entry['name']}`" for entry in survivors}
    needless = [line for line in explained.splitlines() if line.startswith("- ") and line not in alive]
    lines += ["", f"Not run yet: {', '.join(missing) or 'none'}."]
    lines += [f"Changed since they were run: {', '.join(older) or 'none'}."]
    lines += ["", f"Explanations of what survives no more: {len(needless)}.", *needless]
    lines += ["", f"Survivors without an explanation: {len(open_ones)}."]
    lines += [f"- line {entry['line']}, {entry['module']}: `{entry['name']}`" for entry in open_ones]
    return lines


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
