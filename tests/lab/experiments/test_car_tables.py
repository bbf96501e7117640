"""The tables and figures of experiments: cells, curves, prediction errors, latents, coverage, progress."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa_lab.experiments.car import curves as car_curves
from safedpa_lab.experiments.car import experiment as car
from safedpa_lab.experiments.car import figures as car_figures
from safedpa_lab.experiments.car import latent as car_latent
from safedpa_lab.experiments.car import margin as car_margin
from safedpa_lab.experiments.car import predictor as car_errors
from safedpa_lab.experiments.car.curves import chosen_sweeps
from safedpa_lab.experiments.car.episodes import Outcome
from safedpa_lab.experiments.car.latent import LinearDiscriminant, latent_result
from safedpa_lab.experiments.car.methods import METHODS
from safedpa_lab.experiments.car.report import cell_of, table_markdown
from safedpa_lab.experiments.common.figures import MODELS
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.sensing import curves as sensing_curves


def outcome(seed: int, **changes: Any) -> Outcome:
    usual: dict[str, Any] = {
        "success": True, "safe": True, "ticks": 100, "first_collision": "", "collisions": 0, "changed": 5,
        "least_h": 0.5, "statuses": {"passed": 95, "corrected": 5}, "covered": {}, "trajectory": "t",
    }  # fmt: skip
    return Outcome(seed, **usual | changes)


EPISODES = [
    outcome(1, ticks=60, covered={"wall": [50, 60], "sea": [1, 2]}),
    outcome(2, success=False, ticks=300, changed=40, least_h=0.25),
    outcome(3, safe=False, ticks=80, changed=0, statuses={"passed": 80}, least_h=-0.125),
    outcome(4, success=False, safe=False, ticks=300, statuses={"passed": 290, "fallback": 10}, changed=10),
    outcome(5, success=False, ticks=300, covered={"wall": [7, 20]}),
    outcome(6, ticks=160, changed=60),
    outcome(7, success=False, ticks=300, changed=0),
]
"""Of seven three reach the goal, five touch nothing, two do both."""


def test_a_cell_counts_success_safety_and_both() -> None:
    cell = cell_of(METHODS["safedpa"], "box", EPISODES)
    assert cell["episodes"] == 7
    for name, hits in (("success", 3), ("safe", 5), ("both", 2)):
        interval = [round(end, 4) for end in wilson_interval(hits, 7)]
        assert cell[name] == {"hits": hits, "of": 7, "share": round(hits / 7, 4), "interval_95": interval}
    assert cell["seconds_to_goal"] == 4.0, "60, 80 and 160 ticks of 0.05 s"
    assert cell["changed_share"] == 0.08, "120 of 1500 ticks"
    assert cell["statuses"] == {"corrected": 25, "fallback": 10, "passed": 845}
    assert (cell["least_h"], cell["not_reached"], cell["not_safe"]) == (-0.125, [2, 4, 5, 7], [3, 4])
    assert cell["covered"] == {
        "wall": {"covered": 57, "steps": 80, "share": 0.7125}, "sea": {"covered": 1, "steps": 2, "share": 0.5},
    }  # fmt: skip
    assert cell["paper"] == {"success": 1.0, "safe": 0.9}, "as the paper states"
    nowhere = cell_of(METHODS["rma"], "none", EPISODES[3:5])
    assert (nowhere["seconds_to_goal"], nowhere["paper"], nowhere["success"]["hits"]) == (None, None, 0)


@pytest.mark.parametrize(
    ("places", "head", "rows"),
    [
        ([("safedpa", "box")], "| Box |", {"safedpa": 1}),
        ([("rma", "none")], "| Car |", {"rma": 1}),
        ([("safedpa", "box"), ("rma", "chair")], "| Box | Chair |", {"safedpa": 1, "rma": 1}),
        ([("safedpa", "large_chair"), ("safedpa", "box"), ("rma", "box")], "| Box | Large Chair |",
         {"safedpa": 2, "rma": 1}),
    ],
)  # fmt: skip
def test_the_table_has_a_row_for_each_method_and_a_column_for_each_load(places, head, rows) -> None:
    cells = [cell_of(METHODS[name], load, EPISODES) for name, load in places]
    table, _, below = table_markdown(cells).partition("\n\n")
    lines = table.splitlines()
    assert lines[0] == f"| success / safety / both {head}"
    found = {name: line for name in METHODS for line in lines[2:-1] if line.startswith(f"| {METHODS[name].title} |")}
    assert {name: line.count("0.43 / 0.71 / 0.29") for name, line in found.items()} == rows
    assert len(below.splitlines()) == 2 + len(places)
    assert all(line.endswith("| 4.0 | 8 % |") for line in below.splitlines()[2:])


class Calibrated:
    """In place of a calibration from drives: forty of them."""

    size, settings = 40, None

    def __init__(self, *_: Any) -> None: ...

    def margins(self, _: Any, advance: Callable[[int], None]) -> tuple[Any, Any]:
        advance(15)
        advance(25)
        return {METHODS["safedpa"].filter_model: SimpleNamespace(epsilon={"wall": 0.1})}, {}


def run_cells(cells: Sequence[Any], _workers: Any, _out: Any, report_progress: Callable[[int], None]) -> Iterator[Any]:
    """Each cell with outcomes of its seeds; in as many as its place in the list the load changed while driving."""
    for number, cell in enumerate(cells):
        report_progress(len(cell.seeds))
        yield cell, [outcome(seed, load_changed=30 if n <= number else None) for n, seed in enumerate(cell.seeds)]


@pytest.mark.parametrize(
    ("parts", "wanted"),
    [
        (("table",), 40 + 2 * 3 * 7), (("errors",), 5 * 3 + 3), (("latent",), 5 * 3 + 5 * 2 + 5 * 3),
        (("errors", "latent"), 5 * 3 + 3 + 5 * 3 + 5 * 2), (("table", "equal-margin"), 40 + 2 * 3 * 7 + 1 * 3 * 4),
        (("equal-margin",), 40 + 1 * 3 * 4),
    ],
)  # fmt: skip
def test_progress_of_the_experiment_ends_at_its_total(parts, wanted, monkeypatch) -> None:
    """Two methods, one of them with a filter; three loads, two of them towed; seven episodes, five drives."""

    def recorded(_: Any, orders: Sequence[Any], advance: Callable[[int], None]) -> list[Any]:
        for _ in orders:
            advance(1)
        return []

    monkeypatch.setattr(car.CarExperiment, "drivable", lambda _: ([METHODS["safedpa"], METHODS["rma"]], []))
    for name, own in (("Calibration", Calibrated), ("run_cells", run_cells), ("recorded", recorded)):
        monkeypatch.setattr(car, name, own)
    monkeypatch.setattr(car, "increment_scale", lambda *_: np.ones(4))
    monkeypatch.setattr(car, "with_margins_of", lambda _model, margins: margins)
    for name in ("errors_of_model", "latent_result", "predicted_paths"):
        monkeypatch.setattr(car, name, lambda *_: {})
    reported: list[tuple[int, int]] = []
    experiment = car.CarExperiment(
        Path(), loads=("none", "box", "chair"), parts=parts, episodes=7, equal_margin_episodes=4, drives=5, processes=1
    )
    car.car_experiment(experiment, lambda *done: reported.append(done))
    assert {everything for _, everything in reported} == {wanted}
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    assert reported[-1] == (wanted, wanted)


@pytest.mark.parametrize(
    ("sweeps", "shared"), [(("noise",), 0), (("noise", "speed"), 1), (("delay", "delay_untold"), 1), (("load",), 0)]
)
@pytest.mark.parametrize("methods", [1, 2])
def test_curves_drive_every_method_at_every_value_once(sweeps, shared, methods, monkeypatch) -> None:
    """Forty drives calibrate; without any change all sweeps meet in one place."""
    chosen = [METHODS["safedpa"], METHODS["rma"]][:methods]
    monkeypatch.setattr(car, "Calibration", Calibrated)
    monkeypatch.setattr(car_curves, "run_cells", run_cells)
    monkeypatch.setattr(car_curves.CarCurves, "drivable", lambda _: (chosen, []))
    reported: list[tuple[int, int]] = []
    found = car_curves.car_curves(
        car_curves.CarCurves(Path(), sweeps=sweeps, episodes=12, processes=1), lambda *done: reported.append(done)
    )
    wanted = chosen_sweeps(sweeps)
    values = sum(len(sweep.values) for sweep in wanted) - shared
    assert reported[-1] == (40 + values * methods * 12,) * 2
    for sweep in wanted:
        points = found["sweeps"][sweep.name]["points"]
        assert [(point["value"], point["method"]) for point in points] == [
            (value, method.name) for value in sweep.values for method in chosen
        ]
        assert all("paper" not in point and point["episodes"] == 12 for point in points)
    first = found["sweeps"][wanted[0].name]["points"]
    assert [point["load_changed"] for point in first] == [min(n + 1, 12) for n in range(len(first))]


FRAME = SimpleNamespace(own_increment=lambda before, after: after - before)


def test_errors_are_root_mean_squares_over_their_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    """Predictions count from the 60th step on; those of one second begin every fifth step, as long as it is driven."""
    late = np.random.default_rng(1).normal(0.0, (3.0, 5.0, 2.0, 1.0), (25, 4))
    seconds = np.array([[9.0] * 4, [1.0] * 4])
    states = np.random.default_rng(2).normal(size=(86, 4))
    drive: Any = SimpleNamespace(states=states, loads=("box",))
    predictor = SimpleNamespace(
        one_step=lambda: states[1:] + np.concatenate([np.full((60, 4), 99.0), late]),
        rollouts=lambda starts, steps: np.array([seconds + states[start + steps] for start in starts]),
    )
    monkeypatch.setattr(car_errors, "frame_of", lambda _: FRAME)
    monkeypatch.setattr(car_errors, "predictor_of", lambda *_: predictor)
    model: Any = None
    scale = np.array([1.0, 2.0, 1.0, 0.5])
    rows = car_errors.errors_of_model(model, [drive], scale)
    assert set(rows) == {"box", "mixed"}
    reported, roots = rows["mixed"]["one_step"], np.sqrt((late**2).mean(axis=0))
    assert list(reported["root_mean_square"].values()) == pytest.approx(roots)
    assert list(reported["per_state"].values()) == pytest.approx(roots / scale)
    assert (reported["number"], reported["count"]) == (pytest.approx(np.mean(roots / scale)), 25)
    assert reported["position"] == pytest.approx(np.hypot(roots[0], roots[1]))
    later = rows["box"]["one_second"]
    assert (later["count"], list(later["root_mean_square"].values())) == (2, pytest.approx([1.0] * 4))


def test_the_scale_is_the_root_mean_square_of_the_change_in_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(car_errors, "frame_of", lambda _: FRAME)
    states = [[[0.0, 0.0], [3.0, 1.0], [-1.0, 0.0]], [[5.0, 7.0], [5.0, 9.0]]]
    drives: Any = [SimpleNamespace(states=np.array(own)) for own in states]
    assert car_errors.increment_scale([], drives).tolist() == pytest.approx([np.sqrt(25 / 3), np.sqrt(2.0)])


CROSS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
CROSSES = np.concatenate([CROSS + np.array([2.0, 0.0]), CROSS + np.array([0.0, 4.0])])
"""Of two classes, around (2, 0) and (0, 4)."""


@given(st.floats(0.01, 100.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_a_discriminant_separates_classes_in_any_unit(size: float, x: float, y: float) -> None:
    """Between classes of the same spread the perpendicular bisector decides; an entry that never changes does not."""
    labels, point = ["a"] * 4 + ["b"] * 4, np.array([[x, y]])
    found = LinearDiscriminant.fit(size * CROSSES, labels)
    np.testing.assert_allclose(found.means, size * np.array([[2.0, 0.0], [0.0, 4.0]]), atol=1e-12)
    side = (x - 2.0) ** 2 + y**2 - x**2 - (y - 4.0) ** 2
    if abs(side) > 1e-3:
        assert found.classify(size * point) == ["a" if side < 0.0 else "b"]
        idle = LinearDiscriminant.fit(np.column_stack([CROSSES, np.full(8, 0.5)]), labels)
        assert idle.classify(np.append(point, [[0.5]], axis=1)) == ["a" if side < 0.0 else "b"]


def test_the_plane_of_most_variance_and_its_shares() -> None:
    """Variances of 9, 4 and 1 along the axes: 9/14 and 4/14."""
    points = [size * sign * unit for size, unit in zip((3.0, 2.0, 1.0), np.eye(3), strict=True) for sign in (1.0, -1.0)]
    middle, directions, shares = car_latent.principal_plane(np.array(points) + 5.0)
    assert (middle, np.abs(directions)) == (pytest.approx([5.0] * 3), pytest.approx(np.eye(3)[:2]))
    assert shares == pytest.approx([9.0 / 14.0, 4.0 / 14.0])


LOADS = {"none": 0.0, "box": 5.0, "chair": 10.0}
"""Each load with its latent; errors stay below 0.1 with it."""


def latent_drive(loads: Sequence[str], notice: Sequence[str] | None = None, errors: Sequence[float] | None = None):
    latents = np.array([[LOADS[load] + 0.1 * (-1) ** n] for n, load in enumerate(notice or loads)])
    sizes = np.array(errors or [0.1] * (len(loads) - 1))
    return SimpleNamespace(loads=tuple(loads), latents=latents, sizes=sizes, states=np.zeros((len(loads), 4)))


def latents_of(hitching: Sequence[Any], patch: pytest.MonkeyPatch, heldout: Sequence[Any] = ()) -> dict[str, Any]:
    patch.setattr(car_latent, "frame_of", lambda _: FRAME)
    patch.setattr(car_latent, "latents_along", lambda _, drive: drive.latents)
    patch.setattr(
        car_latent, "predictor_of",
        lambda _, drive: SimpleNamespace(one_step=lambda: np.repeat(drive.sizes[:, None], 4, axis=1)),
    )  # fmt: skip
    fitting = [latent_drive([load] * 70) for load in LOADS]
    model: Any = SimpleNamespace(latent_names=("z",))
    return latent_result(model, fitting, list(heldout) or fitting, hitching, np.ones(4))


def test_the_classes_of_held_out_latents_are_counted_once_the_history_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 4 latents without a load one is taken for a box, of 3 with a box two for none; the first 60 do not count."""
    junk = ["chair"] * 60
    heldout = [
        latent_drive(["none"] * 64, [*junk, "none", "box", "none", "none"]),
        latent_drive(["box"] * 63, [*junk, "none", "box", "none"]),
    ]
    reported = latents_of([], monkeypatch, heldout)
    assert reported["confusion"]["none"] == {"none": 3, "box": 1, "chair": 0}
    assert reported["confusion"]["box"] == {"none": 2, "box": 1, "chair": 0}
    assert reported["accuracy"] == {"right": 4, "of": 7, "share": 4 / 7} == reported["hitched_or_not"]
    assert {load: len(points) for load, points in reported["points"]["by_load"].items()} == {"none": 4, "box": 3}
    assert reported["adaptation"]["latent_ticks"]["of"] == 0


def test_a_change_of_load_is_watched_until_the_next_or_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hitched at tick 20, another at 45, until tick 60; the latent follows after 4 and 5, the error after 6 and 2."""
    drive = latent_drive(
        ["none"] * 20 + ["box"] * 25 + ["chair"] * 15,
        ["none"] * 24 + ["box"] * 26 + ["chair"] * 10,
        [0.05] * 20 + [0.5] * 6 + [0.1] * 19 + [0.5] * 2 + [0.1] * 12,
    )
    reported = latents_of([drive, latent_drive(["none"] * 20)], monkeypatch)
    assert reported["changes"] == [
        {"from": "none", "to": "box", "watched": 25, "latent_ticks": 4, "error_ticks": 6},
        {"from": "box", "to": "chair", "watched": 15, "latent_ticks": 5, "error_ticks": 2},
    ]


@pytest.mark.parametrize(
    ("fine", "first"),
    [
        ("1111111111", 0), ("0111111111", None), ("01111111111", 1), ("1101110111", 0), ("1101110110", None),
        ("10000000001111111111", 10), ("111111111", None),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("early", "noticed"), [(0, True), (5, True), (6, False), (10, False)])
def test_a_change_is_noticed_at_the_first_tick_that_lasts_but_for_two_of_ten(fine, first, early, noticed, monkeypatch):
    """Unless more than half of the ten ticks before it were noticed already."""
    notice = ["none"] * (20 - early) + ["box"] * early + ["box" if one == "1" else "none" for one in fine]
    (row,) = latents_of([latent_drive(["none"] * 20 + ["box"] * len(fine), notice)], monkeypatch)["changes"]
    assert row["latent_ticks"] == (first if noticed else None)


def test_changes_within_two_and_a_half_seconds_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that never arrived counts as not within them; the paper's history is 50 ticks long."""
    drives = [
        latent_drive(["none"] * 20 + ["box"] * 70, ["none"] * (20 + late) + ["box"] * (70 - late))
        for late in (10, 50, 51, 65)
    ]
    reported = latents_of(drives, monkeypatch)["adaptation"]["latent_ticks"]
    assert (reported["within"], reported["of"], reported["median"]) == (2, 4, 50.5)
    assert reported["interval_95"] == list(wilson_interval(2, 4))
    most = latents_of(drives[2:], monkeypatch)["adaptation"]["latent_ticks"]
    assert (most["within"], most["median"]) == (0, None)


def test_the_share_of_fresh_errors_that_a_margin_covers_is_counted() -> None:
    margin: Any = SimpleNamespace(epsilon={"wall": 0.2}, theorem={"wall": 0.5})
    fresh = car_margin.StepErrors({"wall": np.array([-0.1, 0.2, 0.3, 0.5, 0.6])}, {})
    row = car_margin.coverage_of(margin, fresh)["wall"]
    assert (row["steps"], row["largest_error"]) == (5, 0.6)
    for name, epsilon, covered in (("conformal", 0.2, 2), ("theorem", 0.5, 4)):
        interval = list(wilson_interval(covered, 5))
        assert row[name] == {"epsilon": epsilon, "covered": covered, "share": covered / 5, "interval_95": interval}


def test_the_worst_error_of_a_kind_is_where_the_model_hoped_most() -> None:
    def barrier(kind: str, *rise: float) -> Any:
        return SimpleNamespace(kind=kind, h=lambda state: np.array(rise) * state[0])

    barriers = [barrier("wall", 1.0, 3.0), barrier("wall", -2.0), barrier("hill", -1.0), barrier("sea")]
    found = car_margin.worst_errors(barriers, np.array([0.75]), np.array([0.5]))
    assert found == {"wall": 0.75, "hill": -0.25}


@pytest.mark.parametrize("steps", [98, 99])
def test_a_margin_of_99_percent_wants_99_steps_of_every_kind(steps: int) -> None:
    """Of 99 the largest error, and none below 0; of the theorem's errors likewise."""
    values, model = -0.01 * np.arange(steps, 0, -1.0), load_model("car")
    errors = car_margin.StepErrors(
        {"wall": np.arange(150.0), "sea": values}, {"wall": np.arange(99.0), "sea": 2.0 - values}
    )
    if steps < 99:
        with pytest.raises(InputError, match="got 98 steps, wanted at least 99"):
            car_margin.margin_of(model, errors, "2026-01-01")
        return
    found = car_margin.margin_of(model, errors, "2026-01-01")
    assert (found.transitions, found.coverage, found.period) == (99, 0.99, 0.05)
    assert found.epsilon == {"wall": 149.0, "sea": 0.0}
    assert found.theorem == {"wall": 98.0, "sea": pytest.approx(2.99)}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Draws with a module, without a file, and returns the figure."""

    def draw(module: ModuleType, function: Any, result: dict[str, Any]) -> Figure:
        figures: list[Figure] = []

        @contextmanager
        def figure(*_: Any) -> Iterator[Figure]:
            figures.append(Figure(layout="constrained"))
            yield figures[0]

        monkeypatch.setattr(module, "figure", figure)
        function(result, None)
        return figures[0]

    return draw


def ends(container: Any) -> list[list[float]]:
    """Lower and upper ends of the bars of errors."""
    return [[round(float(y), 6) for _, y in segment] for segment in container[2][0].get_segments()]


@pytest.mark.parametrize(
    ("cells", "columns"),
    [
        ([("safedpa", "box")], 1),
        ([("safedpa", "box"), ("safedpa", "none"), ("rma", "none")], 2),
        ([("safedpa", "box"), ("rma", "chair"), ("physics", "large_chair")], 3),
    ],
)
def test_a_table_has_a_panel_for_each_measure_and_load_and_a_bar_for_each_cell(cells, columns, drawn) -> None:
    share = {"share": 0.25, "interval_95": [0.125, 0.5]}
    rows = [
        {"method": name, "load": load, "episodes": 9, "paper": None, "success": share, "safe": share, "both": share}
        for name, load in cells
    ]
    panels = drawn(car_figures, car_figures.table_figure, {"cells": rows}).axes
    assert len(panels) == 3 * columns
    bars = [bar for axes in panels for bar in axes.patches]
    lines = [line for axes in panels for line in axes.lines]
    assert [bar.get_width() for bar in bars] == [0.25] * 3 * len(cells)
    assert [list(line.get_xdata()) for line in lines] == [[0.125, 0.5]] * 3 * len(cells)
    assert {text.get_text() for axes in panels for text in axes.texts} == {"25 %"}
    names = [name for name in METHODS if name in {name for name, _ in cells}]
    assert [text.get_text() for text in panels[0].get_yticklabels()] == [METHODS[name].title for name in names]


@pytest.mark.parametrize("curves", [("noise",), ("walking", "latency")])
def test_curves_of_a_laser_are_drawn_in_per_cent_over_goals_a_minute(curves: tuple[str, ...], drawn: Any) -> None:
    rows = [
        {"curve": name, "value": value, "drives": 8, "drives_in_which_the_car_moved_into_something": hits,
         "share_95": (0.0625, 0.5), "goals_a_minute": goals, "goals_a_minute_told_everything": 5.0}
        for name in curves for value, hits, goals in ((0.5, 1, 2.0), (1.0, 2, 4.0))
    ]  # fmt: skip
    panels = drawn(sensing_curves, sensing_curves.draw_curves, {"rows": rows}).axes
    assert len(panels) == 2 * len(curves)
    for above, below in zip(panels[: len(curves)], panels[len(curves) :], strict=True):
        (bars,) = above.containers
        assert (list(bars[0].get_ydata()), ends(bars)) == ([12.5, 25.0], [[6.25, 50.0], [6.25, 50.0]])
        own, known = (line for line in below.lines if len(line.get_ydata()) == 2 and line.get_ydata()[0] > 1.0)
        assert (list(own.get_ydata()), list(known.get_ydata())) == ([2.0, 4.0], [5.0, 5.0])
        assert below.get_ylim() == pytest.approx((-0.22, 5.5))


def test_curves_of_the_car_are_drawn_in_per_cent_and_their_names_do_not_overlap(drawn: Any) -> None:
    """Names stay at their curve's end where others leave room, and are moved down otherwise."""
    shares = {"safedpa": (0.25, 0.99), "rma": (0.5, 1.0), "rma_p": (0.0, 0.98), "physics": (0.5, 0.3)}
    points = [
        {"method": name, "episodes": 9,
         "safe": (cell := {"share": own[place], "interval_95": [own[place] - 0.125, own[place] + 0.25]}), "both": cell}
        for place in (0, 1) for name, own in shares.items()
    ]  # fmt: skip
    sweep = {"label": "noise", "shown": ["0", "1"], "values": [0.0, 1.0], "usual": 0.0, "advantages": []}
    sweep["points"] = points
    result = {"sweeps": {"noise": sweep}, "family": {"name": "best"}, "load": "chair"}
    panel = drawn(car_figures, car_figures.curves_figure, result).axes[0]
    found = {tuple(bars[0].get_ydata()): np.array(ends(bars)) for bars in panel.containers}
    assert set(found) == {(100 * one, 100 * other) for one, other in shares.values()}
    for share, bars in found.items():
        np.testing.assert_allclose(bars, np.transpose([np.array(share) - 12.5, np.array(share) + 25.0]), atol=1e-6)
    heights = {text.get_text(): text.xy[1] for text in panel.texts}
    wanted = [METHODS[name].title.replace(" model", "") for name in ("rma", "safedpa", "rma_p", "physics")]
    assert sorted(heights, key=lambda name: -heights[name]) == wanted
    placed = [heights[name] for name in wanted]
    assert (placed[0], placed[-1]) == (pytest.approx(100.0), pytest.approx(30.0))
    assert min(-np.diff(placed)) >= 11.0 - 1e-9


def test_coverage_of_margins_is_drawn_in_per_cent_with_its_ends(drawn: Any) -> None:
    name = next(iter(MODELS))
    reported = {"epsilon": 0.1, "share": 0.75, "interval_95": [0.5, 1.0]}
    models = {name: {"obstacle": {"conformal": reported, "theorem": reported | {"epsilon": 0.4}}}}
    result = {"margin": {"models": models, "coverage_wanted": 0.99}}
    left, right = drawn(car_figures, car_figures.margin_figure, result).axes
    assert sorted(bar.get_height() for bar in left.patches) == [0.1, 0.4]
    assert [list(map(float, line.get_ydata())) for line in right.lines] == [[50.0, 100.0], [75.0], [99.0, 99.0]]
