"""A decision by the compiled search is the decision of Python, to the last bit."""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import safedpa
from safedpa.dynamics import load_model
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings, SafetyFilter, Verdict
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.prediction.dead_time import InFlightCommands
from safedpa.safety.solver.candidates import HeldSolution

if shutil.which("cc") is None:
    pytest.skip("no C compiler", allow_module_level=True)

FOOTPRINT, FIELD = (0.08, 0.4, 0.12), (-4.0, 4.0, -4.0, 4.0)
CAR, SETTINGS = load_model("car"), FilterSettings.for_robot("car")
ANY = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)


def scene(count: int, seed: int = 1) -> list[list[float]]:
    random = np.random.default_rng([seed, count])
    discs = np.column_stack([random.uniform(-3.5, 3.5, (count, 2)), random.uniform(0.2, 0.35, count)])
    return [[float(entry) for entry in disc] for disc in discs]


def by_python(safe: SafetyFilter) -> SafetyFilter:
    """The same filter without the compiled search: three actions are what it declines, a deadline another way."""
    copy = SafetyFilter.for_model(CAR, safe.settings, safe.barriers)
    copy.tools = replace(copy.tools, compiled=None)
    return copy


def fields(verdict: Verdict) -> dict[str, Any]:
    return {**verdict.as_dict(), "microseconds": 0.0}


def barriers(count: int, seed: int = 1) -> Sequence[safedpa.AbstractBarrier]:
    parts = car_barriers(SETTINGS, FOOTPRINT, scene(count, seed), FIELD)
    whole = make_barrier_set(parts)
    whole.prepare(4)  # type: ignore[attr-defined]  # waits for the compiler
    return tuple(parts)


def both(count: int = 6, own: FilterSettings = SETTINGS) -> tuple[SafetyFilter, SafetyFilter]:
    compiled = SafetyFilter.for_model(CAR, own, barriers(count))
    return compiled, by_python(compiled)


COMPILED, PYTHON = both()


@pytest.mark.parametrize("count", [1, 2, 7, 33])
@pytest.mark.parametrize("robust", [False, True])
def test_verdicts_are_those_of_python(count: int, robust: bool) -> None:
    compiled, python = both(count, replace(SETTINGS, eta=0.9, relinearisations=0) if robust else SETTINGS)
    random, seen = np.random.default_rng(count), set[str]()
    for _ in range(150):
        state = random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0))
        nominal, latent = random.uniform((-0.9, -0.4), (2.8, 0.4)), random.uniform((0.0, 0.0), (1.0, 4.0))
        found = compiled.decide(state, nominal, latent)
        assert fields(found) == fields(python.decide(state, nominal, latent))
        seen.add(found.status.value)
    assert {"passed", "corrected", "violated"} <= seen


@given(st.lists(ANY, min_size=4, max_size=4), st.lists(ANY, min_size=2, max_size=2))
@settings(max_examples=200, deadline=None)
def test_odd_numbers_have_the_verdict_of_python(state: list[float], nominal: list[float]) -> None:
    found = COMPILED.decide(state, nominal, CAR.latent)
    assert fields(found) == fields(PYTHON.decide(state, nominal, CAR.latent))
    assert np.isfinite(found.action).all()


@pytest.mark.parametrize(
    "state", [None, "abcd", [0.0, 0.0, 0.0], [True, 0.0, 0.0, 0.0], np.zeros((1, 4)), np.zeros(4, np.float32), 1.0,
              np.ma.masked_array(np.zeros(4), [False, True, False, False]), np.zeros(8)[::2], (0, 0, 0, 0)],
)  # fmt: skip
def test_inputs_of_other_kinds_have_the_verdict_of_python(state: Any) -> None:
    assert fields(COMPILED.decide(state, [1.0, 0.0], CAR.latent)) == fields(
        PYTHON.decide(state, [1.0, 0.0], CAR.latent)
    )


def test_an_action_is_read_only_and_belongs_to_its_verdict() -> None:
    first = COMPILED.decide([-3.0, -3.0, 0.5, 0.2], [0.3, 0.1], CAR.latent)
    kept = first.action.copy()
    COMPILED.decide([-3.0, -3.0, 0.5, 0.2], [0.0, 0.0], CAR.latent)
    assert first.action.tolist() == kept.tolist()
    assert not first.action.flags.writeable
    assert first.nominal is not None
    first.nominal[0] = 5.0
    assert first.action.tolist() == kept.tolist()


def test_a_filter_without_obstacles_and_one_with_a_thousand_decide_as_python() -> None:
    for count in (0, 1000):
        compiled, python = both(count)
        for state in ([0.0, 0.0, 0.0, 0.0], [3.0, 3.0, 0.7, 1.5]):
            assert fields(compiled.decide(state, [2.0, 0.0], CAR.latent)) == fields(
                python.decide(state, [2.0, 0.0], CAR.latent)
            )


def test_other_margins_and_other_barriers_count_from_the_next_decision_on() -> None:
    state, nominal = [-3.0, -3.0, 0.5, 0.2], [0.3, 0.1]
    others = barriers(6, seed=2)
    for given_barriers in (None, others, None):
        for epsilon in (None, {"obstacle": 0.5}, {"obstacle": 0.6}):
            found = COMPILED.decide(state, nominal, CAR.latent, barriers=given_barriers, epsilon=epsilon)
            wanted = PYTHON.decide(state, nominal, CAR.latent, barriers=given_barriers, epsilon=epsilon)
            assert fields(found) == fields(wanted)


def test_a_search_of_a_moment_ago_is_reused_as_by_python() -> None:
    tight, reasons = {"obstacle": 10.0}, list[str]()
    held = HeldSolution(), HeldSolution()
    for tick in range(30):
        state = [-3.0 + 0.001 * tick, -3.0, 0.8, 0.0]
        found, wanted = (
            one.decide(state, [2.0, 0.0], CAR.latent, epsilon=tight, time=0.01 * tick, held_solution=own)
            for one, own in zip((COMPILED, PYTHON), held, strict=True)
        )
        assert fields(found) == fields(wanted)
        reasons.append(found.reason)
    assert 0 < sum("no worse now" in reason for reason in reasons) < 30


def test_threads_with_filters_of_their_own_decide_as_one() -> None:
    random = np.random.default_rng(5)
    states = random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0), (150, 4))

    def drive(_: int) -> list[dict[str, Any]]:
        own = both()[0]
        return [fields(own.decide(state, [2.0, 0.1], CAR.latent)) for state in states]

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(drive, range(4)))
    assert all(one == found[0] for one in found)


@pytest.mark.parametrize("name", ["pendulum", "pendulum_learned", "car_learned"])
def test_one_action_and_networks_decide_as_python(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks as by NumPy: a model that is loaded where compiling is forbidden has no others."""
    model, robot = load_model(name), name.partition("_")[0]
    corridor: Sequence[safedpa.AbstractBarrier] = [safedpa.CorridorBarrier(-0.3, 0.3, 0.25)]
    parts = barriers(6) if robot == "car" else corridor
    compiled = SafetyFilter.for_model(model, FilterSettings.for_robot(robot), parts)
    monkeypatch.setenv("SAFEDPA_COMPILE", "0")
    python = SafetyFilter.for_model(load_model(name), FilterSettings.for_robot(robot), parts)
    python.tools = replace(python.tools, compiled=None)
    low, high = ((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0)) if robot == "car" else ((-0.35, -0.8), (0.35, 0.8))
    random, kinds = np.random.default_rng(7), set()
    for _ in range(100):
        state, nominal = random.uniform(low, high), 20.0 * random.uniform(-1.0, 1.0, len(model.system.action_names))
        found, wanted = (one.decide(state, nominal, model.latent) for one in (compiled, python))
        assert fields(found) == fields(wanted)
        kinds.add(found.status)
    assert len(kinds) >= 2


SAYS = "from safedpa.native.library import why_not_compiled; print(why_not_compiled() or 'compiled')"


def says(cache: Path, **more: str) -> str:
    """Whether a new process with this cache decides by compiled code, or why not."""
    # An installed copy on the path has kernels of its own, which need neither compiler nor cache.
    environment = {**os.environ, "PYTHONPATH": "", "XDG_CACHE_HOME": str(cache), **more}
    done = subprocess.run([sys.executable, "-c", SAYS], capture_output=True, text=True, check=True, env=environment)
    return done.stdout.strip()


@pytest.mark.long
def test_a_damaged_or_foreign_extension_is_never_loaded(tmp_path: Path) -> None:
    assert says(tmp_path) == "compiled"
    folder = tmp_path / "safedpa" / "kernels"
    (made,) = folder.glob("*.so")
    whole = made.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:-1] + bytes([whole[-1] ^ 1])):
        made.write_bytes(damage)
        assert "failed" in says(tmp_path, CC="false")
        assert says(tmp_path) == "compiled"
        (made,) = folder.glob("*.so")
        assert made.read_bytes() != damage
    folder.chmod(0o777)
    assert "other users may write it" in says(tmp_path)
    folder.chmod(0o700)
    made.unlink()
    made.symlink_to("/dev/null")
    assert "link" in says(tmp_path)


@pytest.mark.parametrize(
    ("setting", "reason"), [({"PATH": ""}, "no C compiler"), ({"CC": "false"}, "failed"), ({"HOME": "/dev/null"}, "")]
)
def test_without_a_compiler_or_a_folder_python_decides(setting: dict[str, str], reason: str, tmp_path: Path) -> None:
    cache = tmp_path if "HOME" not in setting else Path("/dev/null")
    found = says(cache, **setting)
    assert found != "compiled"
    assert reason in found
    assert "\n" not in found


PERIOD = 0.05
DISCS = [(1.5, 0.2, 0.4), (2.5, -0.8, 0.4)]


def step(x: Any, a: Any, operations: Any) -> list[Any]:
    moved = [x[0] + PERIOD * x[3] * operations.cos(x[2]), x[1] + PERIOD * x[3] * operations.sin(x[2])]
    return [*moved, x[2] + PERIOD * a[1], x[3] + PERIOD * a[0]]


def brake(x: Any, operations: Any) -> list[Any]:
    return [operations.clip(-x[3] / PERIOD, -1.0, 1.0), 0.0 * x[3]]


def room(x: Any, operations: Any) -> list[Any]:
    return [operations.hypot(x[0] - cx, x[1] - cy) - radius for cx, cy, radius in DISCS]


def test_rollouts_of_ones_own_functions_are_decided_as_by_python() -> None:
    own = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=0.2, epsilon={"rollout": 0.01})
    filters = []
    for _ in range(2):
        barrier = safedpa.RolloutBarrier(step, brake, room, horizon=30, names=("first", "second"))
        assert not barrier.not_compiled
        filters.append(SafetyFilter(barrier.prediction, [barrier], own, backup=barrier.backup))
    compiled, python = filters
    python.tools = replace(python.tools, compiled=None)
    random, seen = np.random.default_rng(9), set[str]()
    for _ in range(60):
        state, nominal = random.uniform((-0.5, -0.5, -0.5, 0.0), (1.2, 0.5, 0.5, 1.2)), random.uniform(-1.0, 1.0, 2)
        found, wanted = compiled.decide(state, nominal), python.decide(state, nominal)
        assert (found.status, found.reason, found.active) == (wanted.status, wanted.reason, wanted.active)
        np.testing.assert_allclose(found.action, wanted.action, rtol=0.0, atol=1e-12)
        seen.add(found.status.value)
    assert {"passed", "corrected"} <= seen
    assert compiled.decide([np.nan, 0.0, 0.0, 0.0], [0.0, 0.0]).status.value == "fallback"


def test_with_commands_in_flight_under_several_delays_verdicts_are_those_of_python() -> None:
    random, seen = np.random.default_rng(11), set[str]()
    for _ in range(150):
        commands = random.uniform((-0.6, -0.34), (2.0, 0.34), (2, 2))
        queue = tuple((tuple(one.tolist()), float(random.uniform(0.01, 0.1))) for one in commands)
        others = tuple(InFlightCommands(None, (0.0, 0.0), part) for part in (queue[:1], queue))
        memory = InFlightCommands(None, (0.0, 0.0), queue[: random.integers(0, 3)], others[: random.integers(0, 3)])
        state = random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0))
        found = COMPILED.decide(state, [2.0, 0.1], CAR.latent, memory=memory)
        assert fields(found) == fields(PYTHON.decide(state, [2.0, 0.1], CAR.latent, memory=memory))
        seen.add(found.status.value)
    assert {"passed", "corrected", "violated"} <= seen


FORKS = """
import os, sys
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings
from safedpa.safety.barriers.stack import make_barrier_set
barriers = make_barrier_set(car_barriers(FilterSettings.for_robot("car"), (0.1, 0.4, 0.1), [[1.0, 1.0, 0.2]]))
barriers.scalar_rows(4)
child = os.fork()
barriers.prepare(4)
status = 0 if child == 0 else os.waitpid(child, 0)[1]
print("done", status, flush=True)
os._exit(0)
"""


@pytest.mark.long
def test_a_process_that_forks_while_a_thread_compiles_does_not_hang(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-c", FORKS]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, timeout=100)
    assert done.stdout == "done 0\ndone 0\n"
