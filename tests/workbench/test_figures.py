"""What the workbench's figures and bars show: spans, marks, axes, directions."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from tests.messages import finding_of, state_of, verdict_of

from safedpa_services.workbench.live.panels import drive_table, error_bars, error_figure, evidence_figure, field_figure
from safedpa_services.workbench.live.store import RobotHistory, TimelineMark
from safedpa_services.workbench.panels import error_map, prediction
from safedpa_services.workbench.panels.theme import LIGHT

NOW = 300.0
ROBOT_WITHOUT_STATES = SimpleNamespace(system=SimpleNamespace(state=()))
WHEN = (0.0, 100.0, 179.0, 181.0, 240.0, 299.0)
"""s; of a robot that drives for 300 s, of which the figures show the last 120."""


@pytest.fixture
def history():
    made = RobotHistory("r1")
    made.path.extend((t, (t, 0.0, 0.0, 1.0)) for t in (*np.arange(0.0, NOW, 5.0), NOW))
    for t in WHEN:
        made.errors.append((t, 0.01 * t, 0.02 * t, 1.0 + t, 13.8))
        made.marks.append(TimelineMark(t, "finding" if t == 240.0 else "model", f"at {t:.0f} s"))
    return made


def test_error_evidence_and_marks_are_those_of_the_last_two_minutes(history):
    figure = error_figure(history, LIGHT)
    band, error = figure["data"]
    assert error["x"] == band["x"] == [181.0, 240.0, 299.0]
    assert error["y"] == pytest.approx([1.81, 2.40, 2.99])
    assert band["y"] == pytest.approx([3.62, 4.80, 5.98])
    shapes = figure["layout"]["shapes"]
    assert [shape["x0"] for shape in shapes] == [shape["x1"] for shape in shapes] == [181.0, 240.0, 299.0]
    assert [shape["line"]["dash"] for shape in shapes] == ["solid", "dot", "solid"]
    assert figure["layout"]["xaxis"]["range"] == [180.0, 300.0]
    assert figure["layout"]["yaxis"]["range"] == pytest.approx([0.0, 1.15 * 5.98])
    figure = evidence_figure(history, LIGHT)
    threshold, evidence = figure["data"]
    assert evidence["x"] == threshold["x"] == [181.0, 240.0, 299.0]
    assert threshold["y"] == [13.8] * 3
    assert evidence["y"] == pytest.approx([1.6 * 13.8] * 3), "what is far above is cut: the threshold stays in sight"
    assert figure["layout"]["xaxis"]["range"] == [180.0, 300.0]
    low, high = figure["layout"]["yaxis"]["range"]
    assert low < 0.0
    assert high > 1.6 * 13.8


def test_a_drive_of_less_than_two_minutes_is_shown_whole(history):
    while history.path[-1][0] > 110.0:
        history.path.pop()
    for retained in (history.errors, history.marks):
        while len(retained) > 2:
            retained.pop()
    figure, evidence = error_figure(history, LIGHT), evidence_figure(history, LIGHT)
    assert [shape["x0"] for shape in figure["layout"]["shapes"]] == [0.0, 100.0]
    assert figure["layout"]["xaxis"]["range"] == evidence["layout"]["xaxis"]["range"] == [0.0, 110.0]


def test_the_field_shows_the_path_of_the_last_twenty_seconds(history):
    (line,) = field_figure(history, LIGHT)["data"]
    assert line["x"] == [285.0, 290.0, 295.0, 300.0]


@pytest.mark.parametrize(
    ("errors", "before", "band", "bars"),
    [
        ([], None, 0.0, []),
        ([0.4, 0.1], None, 0.0, [("now", "0.400", 100.0)]),
        ([0.0, 0.1, 0.0], None, 0.0, [("now", "0.100", 100.0)]),
        ([0.9] * 50 + [0.1, 0.3, 0.2, 0.1, 0.2], 0.8, 0.0, [("before", "0.800", 100.0), ("now", "0.200", 25.0)]),
        ([0.2] * 9, 0.1, 0.4, [("before", "0.100", 25.0), ("now", "0.200", 50.0), ("end", "0.400", 100.0)]),
    ],
)
def test_the_bar_of_now_is_the_median_of_five_seconds_and_the_longest_bar_fills_the_line(errors, before, band, bars):
    """A finding comes each second. One of 55 seconds would still tell of what was before the change."""
    history = RobotHistory("r1", error_before_change=before, finding=SimpleNamespace(band=band))
    history.errors.extend((float(at), error, 0.0, 0.0, 13.8) for at, error in enumerate(errors))
    page = error_bars(history, 0.0)
    shown = re.findall(r"<span>(\w+)[^<]*</span><span class=.value.>([\d.]+)<.*?width:([\d.]+)%", page)
    assert [(name, value, float(width)) for name, value, width in shown] == bars
    change = {0.8: "−75 %", 0.1: "+100 %"}.get(before, "")
    assert re.findall(r"[−+]\d+ %", page) == ([change] if change else [])


def test_the_table_of_a_drive_is_empty_until_a_robot_is_heard_and_then_has_its_clock_goals_and_room():
    history = RobotHistory("r1")
    assert drive_table(history, 9.0) == ""
    history.update(state_of(robot_time=41.6, goals_reached=3, collisions=1), 9.0)
    cell = "<td>(.*?)</td>"
    rows = re.findall(f"<tr>{cell}{cell}{cell}", drive_table(history, 9.2))
    assert rows == [(*row, "0.2 s old") for row in (("clock", "42 s"), ("goals reached", "3"), ("collisions", "1"))]
    history.update(verdict_of("passed", h_now=0.256, margin=0.0304), 9.0)
    history.update(finding_of("watching", model="0123456789abcdef"), 9.0)
    rows = re.findall(f"<tr>{cell}{cell}{cell}", drive_table(history, 16.0))
    assert {age for _, _, age in rows} == {'<b class="old">7.0 s old</b>'}
    assert [row[:2] for row in rows[3:]] == [
        ("model in use", "01234567"),
        ("barrier h", "0.26 m"),
        ("margin", "0.030 m"),
    ]


@pytest.mark.parametrize(("yaw", "turned"), [(0.0, 90.0), (np.pi / 2.0, 0.0), (np.pi, -90.0), (-np.pi / 4.0, 135.0)])
def test_the_robot_points_where_it_heads(history, yaw, turned):
    """A triangle points up; Plotly turns it clockwise, by degrees."""
    history.state = SimpleNamespace(
        values=(1.0, 2.0, yaw, 0.5), goal=(3.0, 4.0), obstacles=((5.0, 6.0, 0.5),), load_pose=(0.5, 2.0, 0.0),
        field=(-4.0, 4.0, -3.0, 3.0),
    )  # fmt: skip
    figure = field_figure(history, LIGHT)
    signs = {sign["name"]: sign for sign in figure["data"] if sign.get("mode") == "markers"}
    assert {name: (*sign["x"], *sign["y"]) for name, sign in signs.items()} == {
        "goal": (3.0, 4.0), "robot": (1.0, 2.0), "load": (0.5, 2.0),
    }  # fmt: skip
    assert signs["robot"]["marker"]["angle"] == pytest.approx(turned)
    (circle,) = figure["layout"]["shapes"]
    assert [circle[name] for name in ("x0", "x1", "y0", "y1")] == [4.5, 5.5, 5.5, 6.5]
    assert figure["layout"]["xaxis"]["range"] == [-4.0, 4.0]
    assert figure["layout"]["yaxis"]["range"] == [-3.0, 3.0]


def test_no_axis_of_a_small_figure_has_more_numbers_than_can_be_read(history):
    """At 11 letters a line and 4 pixels between lines: 20 pixels each; the figures are 110 to 190 pixels high."""
    states = [SimpleNamespace(name=name, unit="m") for name in ("x", "y", "yaw", "speed")]
    windows = SimpleNamespace(system=SimpleNamespace(state=states))
    session = SimpleNamespace(comparison=SimpleNamespace(windows=windows), number=0, shown=None)
    t = np.linspace(0.0, 1.0, 5)
    rows = np.column_stack([t, 2.0 * t, 3.0 * t, 4.0 * t])
    found = SimpleNamespace(t=t, measured=rows, full_path=np.zeros((5, 2)), predicted=[("given model", t, rows + 0.5)])
    layout = prediction.curves_figure(session, found, LIGHT)["layout"]
    heights = [value for name, value in layout.items() if name.startswith("yaxis")]
    assert [axis["title"]["text"] for axis in heights] == ["yaw [m]", "speed [m]"], "the place has a figure of its own"
    for figure in ({"layout": layout}, error_figure(history, LIGHT), evidence_figure(history, LIGHT)):
        for name, value in figure["layout"].items():
            if name.startswith("yaxis"):
                assert 2 <= value["nticks"] <= 6, name
    low, high = heights[1]["range"]
    assert low < 0.0
    assert high > 4.5


def test_the_line_along_time_is_broken_between_stretches():
    windows = SimpleNamespace(
        names=("a", "b"), run=np.array([0, 0, 0, 1]), begin=np.array([0, 0, 2, 3]), start=np.arange(4),
        end=np.arange(1, 5), time=np.array([0.0, 1.0, 5.0, 0.0, 1.0]),
    )  # fmt: skip
    comparison = SimpleNamespace(windows=windows, window_errors=np.array([0.1, 0.2, 0.3, 0.4]))
    version = SimpleNamespace(comparison=comparison, label="given model")
    session = SimpleNamespace(comparison=comparison, versions=[version], shown_version=version, mask=None, start=2)
    figure = error_map.time_figure(session, LIGHT)
    (line,) = figure["data"]
    drawn = [None if value is None or np.isnan(value) else value for value in line["y"]]
    assert drawn == [0.1, 0.2, None, 0.3, None, 0.4]
    assert 2 <= figure["layout"]["yaxis"]["nticks"] <= 6


@pytest.mark.parametrize(
    ("errors", "widths"), [((0.4, 0.1, 0.3), [100.0, 25.0, 75.0]), ((0.1, 0.2), [50.0, 100.0]), ((0.0, 0.0), [0.0] * 2)]
)
def test_the_bars_of_versions_are_as_long_as_their_errors(errors, widths, finished):
    """A model without any error, as of a recording that it made itself, has a bar without a length."""
    pytest.importorskip("nicegui")
    from tests.workbench.tab import Tab

    from safedpa_services.workbench.panels.error_reduction import ErrorReductionPanel

    none = SimpleNamespace(error=SimpleNamespace(scale=(), per_state=()), windows=ROBOT_WITHOUT_STATES)
    versions = [SimpleNamespace(label=f"version {at}", error=error, comparison=none) for at, error in enumerate(errors)]
    session = SimpleNamespace(
        versions=versions, number=0, shown=None, decisions=[], shown_version=SimpleNamespace(values={}, improved="2/3"),
        comparison=none, doubtful_effects=tuple, present=SimpleNamespace(model=SimpleNamespace(effects=())),
    )  # fmt: skip

    async def story():
        with Tab() as tab:
            ErrorReductionPanel(lambda _: None, lambda: None, lambda: None, lambda _: None).show(session)
            return " ".join(tab.lines)

    notice = finished(story())
    assert [float(width) for width in re.findall(r"width:([\d.]+)%", notice)] == pytest.approx(widths)
    assert re.findall(r'class="value">([\d.e-]+)<', notice) == [f"{error:.3g}" for error in errors]
    assert "better in 2 of 3 recordings" in notice
