"""One effect at a time: the same steps as the whole diagnosis, with a person's choice between them."""

import pickle

import pytest

from safedpa.diagnosis.interactive import first_step, given_error, proposal, with_candidate, with_final
from safedpa.errors import InputError
from safedpa.records import load_run


@pytest.fixture(scope="module")
def first(plain, runs):
    return first_step(plain, runs)


@pytest.fixture(scope="module")
def reported():
    """Progress that the one search of this file reports."""
    return []


@pytest.fixture(scope="module")
def proposed(first, reported):
    return proposal(first, lambda done, every: reported.append(done / every))


@pytest.fixture(scope="module")
def dragged(first, proposed):
    """The model with the hidden effect; a step is never changed, so all tests look at the same one."""
    return with_candidate(first, proposed, "quadratic_drag")


def test_the_hidden_effect_is_the_choice_and_its_number_is_right(first, proposed, dragged):
    assert proposed.choice == "quadratic_drag"
    assert dragged.error.value < 0.4 * first.error.value
    value = dragged.values["quadratic_drag.coefficient"]
    assert abs(value.value - 0.3) < 0.005
    assert dragged.improved == "2/2"


def test_a_person_may_take_another_one_and_go_back(first, proposed):
    """Back is the very same proposal again, after the other one was taken from it."""
    other = with_candidate(first, proposed, "viscous_drag")
    assert [item.name for item in other.model.effects] == ["viscous_drag"]
    assert first.model.effects == ()
    assert first.search.added == []
    best = with_candidate(first, proposed, "quadratic_drag")
    for table in ("candidates", "added", "rivals", "without"):
        assert getattr(best.search, table) is not getattr(first.search, table), "a step shares nothing that changes"
    assert best.error.value < other.error.value < first.error.value


def test_a_step_keeps_what_was_tried_as_starts_for_the_next_one(proposed, dragged):
    tried = {item.trial.name for item in proposed.search.candidates}
    assert tried <= {item.trial.name for item in dragged.search.candidates}


def test_after_the_hidden_effect_nothing_more_is_chosen(dragged):
    again = proposal(dragged)
    assert again.choice is None
    assert "quadratic_drag" not in {item.effect for item in again.candidates}


@pytest.mark.long
def test_nothing_is_chosen_where_nothing_is_hidden(plain, complete_drive):
    found = proposal(first_step(plain, [load_run(complete_drive, plain.system)]))
    assert found.choice is None
    assert found.unexplained is None


def test_too_little_data_allows_no_verdict(plain, runs, tmp_path):
    text = (tmp_path / "short.csv", 80)
    lines = ["t,x,y,yaw,speed,throttle,steer"]
    for t, state, action in zip(runs[0].t[: text[1]], runs[0].states, runs[0].actions, strict=False):
        lines.append(",".join(map(repr, map(float, [t, *state, *action]))))
    text[0].write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = proposal(first_step(plain, [load_run(text[0], plain.system)], 0.2))
    assert found.candidates == ()
    assert "too little" in found.unexplained.expression


def test_unknown_candidates_are_refused(first, proposed):
    with pytest.raises(InputError, match="not among the candidates"):
        with_candidate(first, proposed, "phlogiston")


@pytest.mark.usefixtures("proposed")
def test_progress_grows_and_steps_travel_to_another_process(first, reported):
    assert reported == sorted(reported)
    assert 0.0 <= reported[0] < reported[-1] < 1.0
    again = pickle.loads(pickle.dumps(first))
    assert again.error.value == first.error.value


def test_the_given_model_and_the_final_numbers(plain, first, dragged):
    assert given_error(plain, first) == pytest.approx(first.error.value, rel=0.2)
    final = with_final(dragged)
    assert final.error.value <= 1.03 * dragged.error.value
    assert abs(final.values["quadratic_drag.coefficient"].value - 0.3) < 0.02
