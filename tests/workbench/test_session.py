"""The workbench without its page: versions, decisions, selections, sentences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import Setting, fingerprint, load_model
from safedpa.errors import InputError
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_services.workbench.panels.error_map import (
    map_figure,
    selection_from_map_box,
    selection_from_time_box,
    time_figure,
    window_near,
)
from safedpa_services.workbench.panels.prediction import curves_figure, excerpt_at_start, path_figure
from safedpa_services.workbench.panels.theme import DARK, LIGHT
from safedpa_services.workbench.session import jobs
from safedpa_services.workbench.session.files import save_model_files
from safedpa_services.workbench.session.selection import (
    ERROR,
    TIME,
    Selection,
    default_axes,
    error_map,
    summarize_selection,
    window_times,
    window_values,
)
from safedpa_services.workbench.session.session import Session


def quiet(_share):
    """Progress that is not shown."""


@pytest.fixture(scope="module")
def versions(plain, runs):
    return jobs.first_versions(plain, runs, 1.0, quiet)


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
    assert "coefficient 0.3" in best.parameters[0]
    assert best.parameters[0].endswith("1/m")
    others = [card for card in searched.cards() if card.decision == "rejected"]
    assert others
    assert all(card.speaks_against for card in others if card.error is None)


def test_adding_lowers_the_error_and_undo_takes_it_back(searched, versions):
    searched.add(searched.fitted_version("quadratic_drag"))
    assert searched.present.error < 0.2 * versions[-1].error
    assert searched.comparison.error.value < 0.2 * versions[-1].comparison.error.value
    assert searched.present.improved == "2/2"
    assert searched.proposed is None
    assert searched.undo() == "quadratic_drag was removed again."
    assert searched.versions == list(versions)
    assert searched.cards()[0].effect == "quadratic_drag"
    assert searched.undo() == ""


def test_a_candidate_against_the_ranking_is_fitted_on_demand(searched, found, runs):
    effect = found.candidates[-1].effect
    assert searched.fitted_version(effect) is None
    searched.add(jobs.add_candidate(searched.present.step, found.proposal, effect, runs, 1.0, quiet))
    assert [item.name for item in searched.present.model.effects] == [effect]


def test_any_effect_can_be_removed_and_undo_brings_it_back(searched, versions, found, runs):
    needless = found.candidates[-1].effect
    searched.add(jobs.add_candidate(searched.present.step, found.proposal, needless, runs, 1.0, quiet))
    assert searched.doubtful_effects() == (needless,)
    searched.add(jobs.remove_effect(searched.present.step, needless, runs, 1.0, quiet))
    assert searched.present.model.effects == ()
    assert searched.present.error == pytest.approx(versions[-1].error, rel=1e-3)
    assert searched.decisions[-1][:2] == ("removed", needless)
    with pytest.raises(InputError, match="the model does not have it"):
        jobs.remove_effect(searched.present.step, needless, runs, 1.0, quiet)
    assert searched.undo() == f"{needless} is in the model again."
    assert [item.name for item in searched.present.model.effects] == [needless]
    searched.undo()
    searched.add(searched.fitted_version("quadratic_drag"))
    assert searched.doubtful_effects() == ()


def test_rejecting_takes_off_the_list_and_undo_puts_back(searched):
    before = [card.effect for card in searched.cards()]
    searched.reject(before[0])
    assert [card.effect for card in searched.cards()] == before[1:]
    assert "You rejected" in searched.verdict
    assert searched.undo() == f"{before[0]} is back on the list."
    assert [card.effect for card in searched.cards()] == before
    with pytest.raises(InputError, match="not among the candidates"):
        searched.reject("phlogiston")


def test_decisions_are_undone_in_reverse(searched):
    searched.reject("viscous_drag")
    searched.add(searched.fitted_version("quadratic_drag"))
    searched.undo()
    assert "viscous_drag" not in [card.effect for card in searched.cards()]
    searched.undo()
    assert "viscous_drag" in [card.effect for card in searched.cards()]


def test_what_was_proposed_for_an_undone_version_is_not_proposed_for_the_next_one(searched, found):
    searched.add(searched.fitted_version("quadratic_drag"))
    searched.propose(1, found)
    searched.reject(found.candidates[-1].effect)
    searched.undo()
    searched.undo()
    searched.add(searched.fitted_version("quadratic_drag"))
    assert searched.proposed is None
    assert searched.cards() == []


def test_looking_at_an_earlier_version_changes_nothing_else(searched, versions):
    searched.add(searched.fitted_version("quadratic_drag"))
    searched.show_version(0)
    assert searched.comparison is versions[0].comparison
    assert searched.present.label == "+ quadratic_drag"
    searched.show_version(1)
    assert searched.shown is None


def test_a_selection_selects_the_same_windows_in_every_figure(session):
    cell = session.map().worst
    session.select(cell)
    assert 0 < session.selection_summary.windows < session.selection_summary.total
    assert session.selection_summary.ratio > 1.2
    assert session.mask[session.start]
    assert "times the average" in session.selection_summary.sentence
    selected = time_figure(session, LIGHT)["data"][-1]["x"]
    assert len(selected) == session.selection_summary.windows
    assert map_figure(session, LIGHT)["layout"]["shapes"]
    session.select(None)
    assert session.selection_summary is None


def test_an_empty_box_selects_nothing_and_says_so(session):
    session.select(Selection({"speed": (90.0, 91.0)}))
    assert session.selection_summary.sentence == "The selection contains no window."
    assert not session.mask.any()
    errors = session.comparison.window_errors
    assert session.start == session.worst_start(), "what was looked at before is looked at on"
    assert (errors > errors[session.start]).sum() == len(errors) // 20


@given(low=st.floats(-1.0, 3.0), width=st.floats(0.0, 3.0), start=st.floats(0.0, 40.0), seconds=st.floats(0.0, 60.0))
def test_two_ranges_select_what_lies_in_both(versions, low, width, start, seconds):
    comparison = versions[0].comparison
    one, other = Selection({"speed": (low, low + width)}), Selection({TIME: (start, start + seconds)})
    both = Selection({**one.ranges, **other.ranges})
    assert (both.mask(comparison) == (one.mask(comparison) & other.mask(comparison))).all()
    assert summarize_selection(comparison, both.mask(comparison)).windows == int(both.mask(comparison).sum())


def test_every_window_is_counted_in_one_cell_of_the_map(versions):
    comparison = versions[0].comparison
    found = error_map(comparison, *default_axes(comparison))
    assert found.windows.sum() == len(comparison.windows)
    speed = window_values(comparison.windows, found.x)
    selection = found.cell(float(speed[0]), float(window_values(comparison.windows, found.y)[0]))
    assert selection.mask(comparison)[0]


def test_one_variable_on_both_axes_is_no_error(session):
    session.axes = ("speed", "speed")
    session.select(session.map().worst)
    assert session.selection_summary.windows > 0
    assert selection_from_map_box(session, {"x": [0.0, 1.0], "y": [0.0, 1.0]}).ranges == {"speed": (0.0, 1.0)}


def test_boxes_of_the_browser_become_selections_and_invalid_events_do_not(session):
    session.axes = ("steer", "speed")
    box = selection_from_map_box(session, {"x": [0.3, 0.1], "y": [1, 2]})
    assert box.ranges == {"steer": (0.1, 0.3), "speed": (1.0, 2.0)}
    assert selection_from_time_box({"x": [3, 8]}).ranges == {TIME: (3.0, 8.0)}
    assert selection_from_time_box({"x": [3, 8], "y": [0.5, 9]}).ranges[ERROR][0] == 0.5
    for nonsense in ({}, {"x": "3"}, {"x": [1.0]}, {"x": [1.0, float("nan")]}, {"x": [1.0, None]}):
        assert selection_from_map_box(session, nonsense) is None
        assert selection_from_time_box(nonsense) is None


def test_runs_follow_one_another_on_the_axis_of_time(session):
    t = window_times(session.comparison.windows)
    assert (np.diff(t) > 0).all()
    assert window_near(session, float(t[7]) + 0.01) == 7


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_figures_show_measured_and_every_version(searched, theme):
    searched.add(searched.fitted_version("quadratic_drag"))
    found = excerpt_at_start(searched)
    names = [trace.get("name") for trace in path_figure(searched, found, theme)["data"]]
    assert names[:4] == ["whole run", "measured", "given model", "+ quadratic_drag"]
    curves = curves_figure(searched, found, theme)["data"]
    assert len(curves) == 2 * 3
    (_, t, given), (_, same, better) = found.predicted
    np.testing.assert_array_equal(t, same)
    measured = found.measured[np.searchsorted(found.t, t)]
    off = [np.sqrt(np.mean((states[:, 3] - measured[:, 3]) ** 2)) for states in (given, better)]
    assert off[1] < 0.05 * off[0], "0.7 m/s without its drag, the sensor's noise with it"


def test_refitted_free_parameters_are_a_version_of_their_own_that_cannot_be_undone(plain, runs, tmp_path):
    free = plain.with_settings({"base.drive_gain": Setting(4.0, free=True)})
    session = Session("free", runs, 1.0, jobs.first_versions(free, runs, 1.0, quiet))
    assert [version.label for version in session.versions] == ["given model", "free parameters refitted"]
    assert session.present.error < session.versions[0].error
    assert session.undo() == ""
    assert session.number == 1
    save_model_files(session.present.step, runs, free, tmp_path, quiet)
    assert load_model(tmp_path / "model.toml").latent_names == ("base.drive_gain",), "what was free stays free"


@pytest.mark.long
def test_saving_writes_the_model_with_final_numbers(searched, plain, runs, tmp_path):
    version = searched.fitted_version("quadratic_drag")
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

    from safedpa_services.workbench.rerun_viewer import write_view

    searched.add(searched.fitted_version("quadratic_drag"))
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
