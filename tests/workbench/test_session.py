"""The workbench without its page: versions, decisions, selections, sentences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import Setting, fingerprint
from safedpa.errors import InputError
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_services.workbench import jobs
from safedpa_services.workbench.brush import (
    ERROR,
    TIME,
    Brush,
    default_axes,
    error_map,
    summarize_selection,
    time_of,
    values_of,
)
from safedpa_services.workbench.look import DARK, LIGHT
from safedpa_services.workbench.panel_path import curves_figure, excerpt_of, path_figure
from safedpa_services.workbench.panel_where import brush_of_map, brush_of_time, map_figure, time_figure, window_near
from safedpa_services.workbench.session import Session
from safedpa_services.workbench.session_files import save_model_files


def quiet(_share):
    """Progress that is not shown."""


@pytest.fixture(scope="module")
def versions(plain, runs):
    return jobs.opened(plain, runs, 1.0, quiet)


@pytest.fixture(scope="module")
def found(versions, runs):
    return jobs.search(versions[-1].step, runs, 1.0, quiet)


@pytest.fixture
def session(versions, runs):
    return Session("plain", runs, 1.0, list(versions))


@pytest.fixture
def searched(session, found):
    session.propose(0, found)
    return session


def test_before_the_search_the_verdict_says_where_the_model_fails(session):
    assert session.verdict.startswith("The model fails most at")
    assert session.cards() == []


def test_after_it_the_verdict_names_what_is_missing(searched):
    assert "Quadratic drag is missing" in searched.verdict
    best = searched.cards()[0]
    assert best.effect == "quadratic_drag"
    assert best.decision == "accepted"
    assert any("unseen stretches" in line for line in best.speaks_for)
    assert "coefficient 0.3" in best.numbers[0]
    assert best.numbers[0].endswith("1/m")
    others = [card for card in searched.cards() if card.decision == "rejected"]
    assert others
    assert all(card.speaks_against for card in others if card.error is None)


def test_adding_lowers_the_error_and_undo_takes_it_back(searched, versions):
    searched.add(searched.settled("quadratic_drag"))
    assert searched.present.error < 0.2 * versions[-1].error
    assert searched.comparison.error.value < 0.2 * versions[-1].comparison.error.value
    assert searched.present.improved == "2/2"
    assert searched.proposed is None
    assert searched.undo() == "quadratic_drag is taken out again."
    assert searched.versions == list(versions)
    assert searched.cards()[0].effect == "quadratic_drag"
    assert searched.undo() == ""


def test_a_candidate_against_the_ranking_is_fitted_on_demand(searched, found, runs):
    effect = found.candidates[-1].effect
    assert searched.settled(effect) is None
    searched.add(jobs.add_candidate(searched.present.step, found.proposal, effect, runs, 1.0, quiet))
    assert [item.name for item in searched.present.model.effects] == [effect]


def test_rejecting_takes_off_the_list_and_undo_puts_back(searched):
    before = [card.effect for card in searched.cards()]
    searched.reject(before[0])
    assert [card.effect for card in searched.cards()] == before[1:]
    assert "was rejected by you" in searched.verdict
    assert searched.undo() == f"{before[0]} is back on the list."
    assert [card.effect for card in searched.cards()] == before
    with pytest.raises(InputError, match="not among the candidates"):
        searched.reject("phlogiston")


def test_decisions_are_undone_in_reverse(searched):
    searched.reject("viscous_drag")
    searched.add(searched.settled("quadratic_drag"))
    searched.undo()
    assert "viscous_drag" not in [card.effect for card in searched.cards()]
    searched.undo()
    assert "viscous_drag" in [card.effect for card in searched.cards()]


def test_looking_at_an_earlier_version_changes_nothing_else(searched, versions):
    searched.add(searched.settled("quadratic_drag"))
    searched.look_at(0)
    assert searched.comparison is versions[0].comparison
    assert searched.present.label == "+ quadratic_drag"
    searched.look_at(1)
    assert searched.shown is None


def test_a_brush_selects_the_same_windows_in_every_figure(session):
    cell = session.map().worst
    session.select(cell)
    assert 0 < session.inside.windows < session.inside.of
    assert session.inside.ratio > 1.2
    assert session.mask[session.start]
    assert "times the average" in session.inside.sentence
    selected = time_figure(session, LIGHT)["data"][-1]["x"]
    assert len(selected) == session.inside.windows
    assert map_figure(session, LIGHT)["layout"]["shapes"]
    session.select(None)
    assert session.inside is None


def test_an_empty_box_selects_nothing_and_says_so(session):
    session.select(Brush({"speed": (90.0, 91.0)}))
    assert session.inside.sentence == "No window lies in there."
    assert not session.mask.any()
    errors = session.comparison.window_errors
    assert session.start == session.worst_start(), "what was looked at before is looked at on"
    assert (errors > errors[session.start]).sum() == len(errors) // 20


@given(low=st.floats(-1.0, 3.0), width=st.floats(0.0, 3.0), start=st.floats(0.0, 40.0), seconds=st.floats(0.0, 60.0))
def test_two_ranges_select_what_lies_in_both(versions, low, width, start, seconds):
    comparison = versions[0].comparison
    one, other = Brush({"speed": (low, low + width)}), Brush({TIME: (start, start + seconds)})
    both = Brush({**one.ranges, **other.ranges})
    assert (both.mask(comparison) == (one.mask(comparison) & other.mask(comparison))).all()
    assert summarize_selection(comparison, both.mask(comparison)).windows == int(both.mask(comparison).sum())


def test_every_window_is_counted_in_one_cell_of_the_map(versions):
    comparison = versions[0].comparison
    found = error_map(comparison, *default_axes(comparison))
    assert found.windows.sum() == len(comparison.windows)
    speed = values_of(comparison.windows, found.x)
    brush = found.cell(float(speed[0]), float(values_of(comparison.windows, found.y)[0]))
    assert brush.mask(comparison)[0]


def test_one_variable_on_both_axes_is_no_error(session):
    session.axes = ("speed", "speed")
    session.select(session.map().worst)
    assert session.inside.windows > 0
    assert brush_of_map(session, {"x": [0.0, 1.0], "y": [0.0, 1.0]}).ranges == {"speed": (0.0, 1.0)}


def test_boxes_of_the_browser_become_brushes_and_nonsense_does_not(session):
    session.axes = ("steer", "speed")
    assert brush_of_map(session, {"x": [0.3, 0.1], "y": [1, 2]}).ranges == {"steer": (0.1, 0.3), "speed": (1.0, 2.0)}
    assert brush_of_time({"x": [3, 8]}).ranges == {TIME: (3.0, 8.0)}
    assert brush_of_time({"x": [3, 8], "y": [0.5, 9]}).ranges[ERROR][0] == 0.5
    for nonsense in ({}, {"x": "3"}, {"x": [1.0]}, {"x": [1.0, float("nan")]}, {"x": [1.0, None]}):
        assert brush_of_map(session, nonsense) is None
        assert brush_of_time(nonsense) is None


def test_runs_follow_one_another_on_the_axis_of_time(session):
    t = time_of(session.comparison.windows)
    assert (np.diff(t) > 0).all()
    assert window_near(session, float(t[7]) + 0.01) == 7


@pytest.mark.parametrize("look", [LIGHT, DARK])
def test_figures_show_measured_and_every_version(searched, look):
    searched.add(searched.settled("quadratic_drag"))
    found = excerpt_of(searched)
    names = [trace.get("name") for trace in path_figure(searched, found, look)["data"]]
    assert names[:4] == ["whole run", "measured", "given model", "+ quadratic_drag"]
    curves = curves_figure(searched, found, look)["data"]
    assert len(curves) == 2 * 3
    (_, t, given), (_, same, better) = found.predicted
    np.testing.assert_array_equal(t, same)
    measured = found.measured[np.searchsorted(found.t, t)]
    off = [np.sqrt(np.mean((states[:, 3] - measured[:, 3]) ** 2)) for states in (given, better)]
    assert off[1] < 0.05 * off[0], "0.7 m/s without its drag, the sensor's noise with it"


def test_free_numbers_are_a_version_of_their_own_that_cannot_be_undone(plain, runs):
    free = plain.with_settings({"base.drive_gain": Setting(4.0, free=True)})
    session = Session("free", runs, 1.0, jobs.opened(free, runs, 1.0, quiet))
    assert [version.label for version in session.versions] == ["given model", "free numbers refitted"]
    assert session.present.error < session.versions[0].error
    assert session.undo() == ""
    assert session.number == 1


def test_saving_writes_the_model_with_final_numbers(searched, plain, runs, tmp_path):
    from safedpa.dynamics import load_model

    version = searched.settled("quadratic_drag")
    notice = save_model_files(version.step, runs, plain, tmp_path / "out", quiet)
    assert f"safedpa up --model {tmp_path / 'out' / 'model.toml'} --margin" in notice
    model = load_model(tmp_path / "out" / "model.toml")
    assert model.settings["quadratic_drag.coefficient"].value == pytest.approx(0.3, abs=0.01)
    assert model.latent_names == ()
    margin = MarginCalibration.load(tmp_path / "out" / "margin.toml")
    assert margin.fingerprint == fingerprint(model)
    assert 0.0 < margin.epsilon["obstacle"] < 0.1


def test_the_rerun_recording_is_twenty_seconds_of_one_stretch_from_the_chosen_start_on(searched, tmp_path):
    from rerun.chunk import RrdReader

    from safedpa_services.workbench.rerun_view import write_view

    searched.add(searched.settled("quadratic_drag"))
    windows = searched.comparison.windows
    last = max(index for index in range(len(windows)) if windows.run[index] == 0)
    for first, end in ((42, None), (last, float(windows.time[windows.end[last]]))):
        searched.start, rows, times = first, dict[str, int](), list[float]()
        write_view(searched, tmp_path / "view.rrd")
        for chunk in RrdReader(tmp_path / "view.rrd").stream():
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
            times += [time.total_seconds() for time in chunk.to_record_batch().to_pydict().get("t", [])]
        start = float(windows.time[windows.start[first]])
        assert min(times) == pytest.approx(start)
        if end is None:
            assert 20.0 <= max(times) - start <= 22.0, "a horizon that begins within 20 s is shown to its end"
        else:
            assert max(times) == pytest.approx(end), "another recording follows, and is not shown"
        for name in ("measured", "given_model", "with_quadratic_drag"):
            assert rows[f"/states/speed/{name}"] > (100 if end is None else 10)
            assert f"/plane/{name}" in rows


def test_a_folder_that_cannot_be_written_to_is_refused(versions, plain, runs, tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="choose another folder"):
        save_model_files(versions[-1].step, runs, plain, tmp_path / "file" / "out", quiet)
