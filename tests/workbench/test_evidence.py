"""What speaks for a candidate and against it: gain, error, how well its parameters are known."""

import pytest

from safedpa.diagnosis.report_schema import Candidate, FittedValue
from safedpa_services.workbench.session.candidate_cards import make_card


def candidate(score, error=0.2, std=0.05):
    numbers = {"coefficient": FittedValue(0.5, std, "1/m")}
    return Candidate(0, "quadratic_drag", numbers, error, score, (), "rejected", "")


@pytest.mark.parametrize(
    ("score", "spoken_for", "spoken_against"),
    [
        (None, "", "no gain on unseen stretches may be chance"),
        (-1.0, "", "a gain of -1.0 standard errors"),
        (1.9, "", "a gain of 1.9 standard errors"),
        (2.5, "2.5 standard errors: hardly chance", ""),
        (3.5, "3.5 standard errors: clear of chance", ""),
    ],
)
def test_a_gain_of_two_standard_errors_speaks_for_a_candidate_and_a_smaller_one_against_it(
    score, spoken_for, spoken_against
):
    """By chance alone one of 44 gains is larger than two standard errors, one of 740 than three."""
    card = make_card("car", candidate(score), 0.5, None, {})
    gained = [line for line in card.speaks_for if "standard errors" in line]
    doubted = [line for line in card.speaks_against if "unseen stretches" in line]
    assert (len(gained), len(doubted)) == (bool(spoken_for), bool(spoken_against))
    assert all(line.endswith(spoken_for) for line in gained)
    assert all(line.startswith(spoken_against) for line in doubted)


@pytest.mark.parametrize(
    ("error", "spoken_for", "spoken_against"),
    [
        (0.25, "0.5 → 0.25 (−50 %)", ""),
        (0.499, "", "hardly changes"),
        (0.501, "", "hardly changes"),
        (0.6, "", "rises 0.5 → 0.6"),
        (None, "", "too little to be evaluated"),
    ],
)
def test_a_falling_error_speaks_for_a_candidate_and_any_other_against_it(error, spoken_for, spoken_against):
    card = make_card("car", candidate(4.0, error), 0.5, None, {})
    fell = [line for line in card.speaks_for if "→" in line]
    stayed = [line for line in card.speaks_against if "error on data" in line or "evaluated" in line]
    assert (len(fell), len(stayed)) == (bool(spoken_for), bool(spoken_against))
    assert all(spoken_for in line for line in fell)
    assert all(spoken_against in line for line in stayed)


@pytest.mark.parametrize(
    ("std", "known", "rough"), [(0.05, "10 %", ""), (0.1, "", ""), (0.2, "", "40 %"), (None, "", "999 %")]
)
def test_a_parameter_is_well_known_or_roughly(std, known, rough):
    """Of 0.5: 0.05 are a tenth, 0.2 two fifths; one without a deviation is not known at all."""
    card = make_card("car", candidate(4.0, 0.2, std), 0.5, None, {})
    assert [line.partition("known to ")[2] for line in card.speaks_for if "known to" in line] == [known] * bool(known)
    notice = [line.partition("only to ")[2] for line in card.speaks_against if "known only" in line]
    assert notice == [rough] * bool(rough)
