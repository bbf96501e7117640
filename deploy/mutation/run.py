"""Plants small faults in the safety filter, one at a time, and asks whether the tests notice.

    python deploy/mutation/run.py [--jobs=N] [MODULE ...]

Each mutant runs in a forked process at low priority: numpy, PIQP and the test tools are imported once. Writes
``summary.json`` and ``summary.md`` beside this file; a run of some modules renews their part. Exit code 0: every mutant
was killed, or its survival is explained in ``survivors.md``, which then holds "module: `name`"; 1: some survivor is
unexplained; 2: the tests fail without any fault.
"""

from __future__ import annotations

import datetime
import importlib.abc
import importlib.util
import json
import os
import resource
import signal
import sys
import time
from importlib.machinery import ModuleSpec
from math import ceil
from pathlib import Path
from types import ModuleType
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PACKAGE = "safedpa.safety"
SECONDS = 600
"""After which a mutant counts as killed: it waits for ever."""
PATIENCE, ROOM = 3.0, 5
"""A mutant that computes for so many times what the sound module's tests took, and so many s, hangs: killed as well."""

TOOLS = ("gymnasium", "hypothesis", "numpy", "piqp", "pytest", "quadprog")
BENEATH = ("safedpa.dynamics", "safedpa.bus", "safedpa.policy", "safedpa.adaptation", "safedpa.records")
"""What the modules under test stand on, and what imports none of them."""
BARRIERS = ("test_barriers.py", "test_filter_recorded.py", "test_filter_invariance.py")
VERDICTS = (
    "test_filter_recorded.py",
    "test_filter_edges.py",
    "test_filter_inputs.py",
    "test_filter_verdicts.py",
    "test_filter_violated.py",
)
SLOPES = "test_barriers.py::test_gradient_is_the_derivative"
MARGIN = "test_a_margin_with_ordered_errors_is_the_one_that_sorts"
PROMISES = "test_filter_promises.py"
POINT = ("../point/test_point_scene.py", "../point/test_point_filter.py")
BATCH = ("test_batch.py",)
CHECK = (
    "test_check_filter.py",
    "-test_check_filter.py::test_the_example_among_discs_runs_and_hits_nothing",
    "-test_check_filter.py::test_the_point_robot_is_fine",
)
"""Without what takes ten seconds and drives the whole filter."""
ROLLOUT = (
    "test_rollout_barrier.py",
    "-test_rollout_barrier.py::test_what_is_thinner_than_a_tick_is_not_jumped_over",
    "-test_rollout_barrier.py::test_with_relative_degree_two_nothing_is_hit_and_nothing_relaxed",
    "-test_rollout_barrier.py::test_a_planar_quadrotor_is_kept_off_by_its_tilt",
)
PENDING = ("test_pending_actions.py", "-test_pending_actions.py::test_a_delay_that_is_known_costs_nothing")
DRIVES = (
    "test_margin_over_drives.py",
    "-test_margin_over_drives.py::"
    "test_fresh_drives_are_covered_as_often_as_stated_where_steps_taken_for_exchangeable_are_not",
)
CHANGES = ("../changes/test_margin_changes.py", "../changes/test_offers_to_nodes.py")
WATCHED = ("test_watched_margin.py", "test_out_of_the_layer.py", *CHANGES)
MODULES = {
    "decision": (*VERDICTS, PROMISES, "test_filter_invariance.py"),
    "search": ("test_filter_search.py", "test_filter_search_back.py", *VERDICTS, PROMISES, "test_filter_invariance.py"),
    "conditions": ("test_filter_conditions.py", *VERDICTS, PROMISES, "test_filter_invariance.py"),
    "tangent": ("test_tangent.py", "test_filter_conditions.py", *VERDICTS),
    "chain_rule": ("test_chain_rule.py",),
    "least_unsafe": ("test_least_unsafe.py", "test_filter_violated.py", "test_filter_verdicts.py", PROMISES),
    "lattice": ("test_lattice.py",),
    "highest": ("test_highest.py", "test_least_unsafe.py", PROMISES),
    "inputs": VERDICTS,
    "quadratic_program": ("test_quadratic_program.py", "test_nearest.py", *VERDICTS),
    "nearest": ("test_nearest.py", "test_quadratic_program.py"),
    "program_rows": ("test_quadratic_program.py", "test_nearest.py", *VERDICTS),
    "margins_in_force": ("test_margins_in_force.py", *VERDICTS),
    "car_stack": ("test_car_stack.py", *BARRIERS),
    "car_geometry": ("test_car_stack.py", *BARRIERS),
    "affine_motion": ("test_affine_motion.py", *VERDICTS),
    "remembered": ("test_remembered.py", *BARRIERS),
    "solution": ("test_quadratic_program.py", *VERDICTS),
    "verdict": ("test_resting_verdict.py", *VERDICTS),
    "braking": ("test_braking.py", *BARRIERS),
    "barrier": ("test_barriers.py::test_stack_keeps_order_names_and_margins", *BARRIERS),
    "obstacle_barrier": (f"{SLOPES}[ObstacleBarrier]", *BARRIERS),
    "field_barrier": (f"{SLOPES}[FieldBarrier]", *BARRIERS),
    "speed_barrier": (f"{SLOPES}[SpeedBarrier]", *BARRIERS),
    "function_barrier": (f"{SLOPES}[FunctionBarrier]", "test_barriers.py", "test_filter_inputs.py"),
    "corridor_barrier": ("test_corridor_barrier.py",),
    "swept": ("test_swept.py",),
    "differences": ("test_differences.py",),
    "higher_order_barrier": ("test_higher_order_barrier.py",),
    "stopping_barrier": POINT,
    "stopping_walk": POINT,
    "margin": ("test_margin_conformal.py", f"../fleet_process/test_fast_paths.py::{MARGIN}"),
    "batch": BATCH,
    "batch_barriers": BATCH,
    "batch_nearest": ("test_batch_nearest.py", *BATCH),
    "batch_search": BATCH,
    "prediction": ("test_filter_inputs.py", "test_on_its_way.py", "test_filter_verdicts.py"),
    "safety_filter": ("test_strangers.py", "test_filter_verdicts.py", "test_filter_inputs.py"),
    "settings": ("test_filter_settings.py", "test_strangers.py"),
    "shipped": ("../services/test_shipped.py", "test_filter_settings.py", "test_run_calibration.py"),
    "compatibility": ("test_strangers.py",),
    "finite_clock": ("test_finite_clock.py",),
    "numbers_returned": ("test_isolation.py", "test_filter_inputs.py"),
    "gymnasium_wrapper": ("test_gymnasium_filter.py",),
    "scene": ("test_scene_corridor.py", "test_towed_reach.py"),
    "scenes": ("test_strangers.py", *POINT),
    "point_scene": POINT,
    "car_barriers": ("test_car_stack.py", *BARRIERS),
    "reversed_way": ("test_towed_reach.py",),
    "towed_reach": ("test_towed_reach.py",),
    "calibration": ("test_margin_conformal.py", *DRIVES, "test_run_calibration.py"),
    "run_calibration": ("test_run_calibration.py", "test_strangers.py"),
    "recorded": ("test_theory_command.py",),
    "ceiling": ("test_watched_margin.py", *DRIVES),
    "drive_calibration": DRIVES,
    "drive_heights": ("test_watched_margin.py",),
    "watched_margin": WATCHED,
    "margin_change": CHANGES,
    "margin_text": (*CHANGES, "test_run_calibration.py"),
    "live_margin": ("test_run_calibration.py",),
    "held_model": (*WATCHED, "test_strangers.py"),
    "filtered_robot": (*WATCHED, "test_late_robot.py", "test_standstill.py", "test_way_out.py"),
    "way_out": ("test_way_out.py", "-test_way_out.py::test_a_car_beside_an_obstacle_gets_out"),
    "standstill": ("test_standstill.py",),
    "orders": ("../operations/test_stop_orders.py",),
    "node": (*WATCHED, "../operations/test_stop_orders.py", "../services/test_shipped.py", "test_strangers.py"),
    "on_its_way": ("test_on_its_way.py", "test_trail.py", "test_late_robot.py"),
    "trail": ("test_trail.py", "test_late_robot.py"),
    "found_delay": ("test_found_delay.py",),
    "pending_actions": PENDING,
    "closed_loop": ROLLOUT,
    "rollout_barrier": ROLLOUT,
    "check_backup": CHECK,
    "check_barriers": CHECK,
    "check_filter": CHECK,
    "check_influence": CHECK,
    "check_probes": CHECK,
    "check_report": CHECK,
    "theory_bound": ("test_theory_bound.py", "test_theory_consequence.py"),
    "theory_gradient": ("test_theory_gradient.py",),
    "theory_layer": ("test_theory_layer.py",),
    "theory_lipschitz": ("test_theory_bound.py",),
    "theory_measure": ("test_theory_measure.py", "test_theory_bound.py"),
    "theory_recorded": ("test_theory_recorded.py",),
}
"""Which tests judge which module, the quickest first; named as seen from ``tests/safety``, with "-" those left out."""


class Planted(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from a given source in place of its file."""

    def __init__(self, name: str, source: str) -> None:
        self._name, self._source = name, source

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """The specification of the planted module, of no other."""
        return importlib.util.spec_from_loader(fullname, self) if fullname == self._name else None

    def exec_module(self, module: ModuleType) -> None:
        """Runs the planted source."""
        exec(compile(self._source, self._name, "exec"), module.__dict__)


def import_what_is_not_mutated() -> None:
    """So that a forked process has it at once."""
    for name in (*TOOLS, *BENEATH, "scipy.optimize", "scipy.stats"):
        importlib.import_module(name)
    if early := [name for name in sys.modules if name.startswith(f"{PACKAGE}.")]:
        raise RuntimeError(f"{early[0]} is imported already: no fault planted there would be seen")


def judge(module: str, sources: list[str], tests: tuple[str, ...], jobs: int, most: int = SECONDS) -> list[bool]:
    """For each source whether the tests noticed nothing; ``jobs`` processes at a time. Hanging counts as noticed.

    ``most`` s of processor time are given to each.
    """
    survived, running, waiting = [False] * len(sources), {}, list(range(len(sources)))
    while running or waiting:
        while waiting and len(running) < jobs:
            index = waiting.pop(0)
            child = os.fork()
            if child == 0:
                resource.setrlimit(resource.RLIMIT_CPU, (most, most))
                run_tests(module, sources[index], tests)
            running[child] = (index, time.monotonic() + SECONDS)
        time.sleep(0.02)
        for child, (index, deadline) in list(running.items()):
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                survived[index] = os.waitstatus_to_exitcode(status) == 0
            elif time.monotonic() > deadline:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
            else:
                continue
            del running[child]
    return survived


def spent() -> float:
    """Processor time of the processes that ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_tests(module: str, source: str, tests: tuple[str, ...]) -> None:
    """In the forked process: never returns."""
    import hypothesis
    import pytest

    # One counterexample is enough: making it small costs more than all other tests.
    hypothesis.settings.register_profile("mutation", phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate))
    hypothesis.settings.load_profile("mutation")
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    sys.meta_path.insert(0, Planted(f"{PACKAGE}.{module}", source))
    files = [str(ROOT / "tests" / "safety" / name) for name in tests if not name.startswith("-")]
    files += [f"--deselect=tests/safety/{name[1:]}" for name in tests if name.startswith("-")]
    quiet = "ignore::pytest.PytestAssertRewriteWarning"  # hypothesis was imported before pytest could rewrite it
    plain = ("-x", "-q", "--tb=no", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist")
    code = pytest.main([*plain, "-W", quiet, "--rootdir", str(ROOT), *files])
    os._exit(int(code))


def main(arguments: list[str]) -> int:
    """Runs every mutant of the wanted modules (default: all) and writes the summary."""
    jobs = int(arguments.pop(0).removeprefix("--jobs=")) if arguments and arguments[0].startswith("--jobs=") else 1
    os.nice(10)
    os.chdir(ROOT)
    sys.path[:0] = [str(HERE), str(ROOT / "shared")]
    from mutants import mutants

    import_what_is_not_mutated()
    rows, survivors, start = [], [], time.monotonic()
    text, open_ones = "", 0
    for module in arguments or list(MODULES):
        source = (ROOT / "shared" / "safedpa" / "safety" / f"{module}.py").read_text(encoding="utf-8")
        planted = mutants(source)
        before = spent()
        sound = judge(module, [source], MODULES[module], 1)[0]
        most = ceil(PATIENCE * (spent() - before)) + ROOM
        alive = judge(module, [mutant.source for mutant in planted], MODULES[module], jobs, most) if sound else []
        if not sound:
            sys.stderr.write(f"{module}: its tests fail without any fault; repair them first\n")
            return 2
        left = [mutant for mutant, survived in zip(planted, alive, strict=True) if survived]
        today = datetime.date.today().isoformat()
        rows.append({"module": module, "mutants": len(planted), "survived": len(left), "date": today})
        for mutant in left:
            sys.stderr.write(f"survived: {module}:{mutant.line} {mutant.name}\n")
            survivors.append({"module": module, "line": mutant.line, "name": mutant.name})
        sys.stderr.write(f"{module}: {len(planted)} mutants, {len(left)} survived, {time.monotonic() - start:.0f} s\n")
        text, open_ones = report([*rows], [*survivors])  # after each: a run that is cut keeps what it did
    sys.stdout.write(text)
    return 1 if open_ones else 0


def report(rows: list[dict[str, Any]], survivors: list[dict[str, Any]]) -> tuple[str, int]:
    """Renews these modules' part of the summaries; the text of ``summary.md``, and how many survivors are open."""
    path, renewed = HERE / "summary.json", {row["module"] for row in rows}
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"modules": [], "survivors": []}
    rows += [row for row in before["modules"] if row["module"] not in renewed and row["module"] in MODULES]
    survivors += [entry for entry in before["survivors"] if entry["module"] not in renewed]
    explained = (HERE / "survivors.md").read_text(encoding="utf-8") if (HERE / "survivors.md").exists() else ""
    for entry in survivors:
        entry["explained"] = f"{entry['module']}: `{entry['name']}`" in explained
    rows.sort(key=lambda row: list(MODULES).index(row["module"]))
    total, alive = sum(row["mutants"] for row in rows), len(survivors)
    open_ones = [survivor for survivor in survivors if not survivor["explained"]]
    lines = ["| module | mutants | killed | survived | run on |", "|---|---|---|---|---|"]
    for row in [*rows, {"module": "all", "mutants": total, "survived": alive, "date": ""}]:
        killed = row["mutants"] - row["survived"]
        lines.append(f"| {row['module']} | {row['mutants']} | {killed} | {row['survived']} | {row['date']} |")
    lines += ["", f"Survivors without an explanation: {len(open_ones)}."]
    lines += [f"- line {survivor['line']}, {survivor['module']}: `{survivor['name']}`" for survivor in open_ones]
    text = "\n".join(lines) + "\n"
    document = {"mutants": total, "killed": total - alive, "modules": rows, "survivors": survivors}
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    (HERE / "summary.md").write_text("# Mutation run\n\n" + text, encoding="utf-8")
    return text, len(open_ones)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
