"""The report's page and recording, from a document as the contract has it."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from safedpa.compare.excerpt import excerpt, heads
from safedpa.compare.rollout_error import rollout_error
from safedpa.compare.windows import windows_of
from safedpa.dynamics import load_model
from safedpa.errors import RecordingError
from safedpa.records.run import Finding, Run, Stretch
from safedpa.report.diagnosis_page import before_after_figure, falling_figure, map_figure, report_page, write_report
from safedpa.report.diagnosis_recording import write_recording
from safedpa.report.diagnosis_story import parameters_text, step_text, story_of


def candidate(stage, name, error, decision="rejected", **more):
    return {
        "stage": stage,
        "effect": name,
        "parameters": {"coefficient": {"value": 0.2, "std": 0.004, "unit": "1/m"}},
        "heldout_error": error,
        "score": 5.0,
        "indistinguishable_from": [],
        "decision": decision,
        "reason": f"{name} does what it does",
        **more,
    }


@pytest.fixture
def diagnosed(plain, with_effect, drive):
    """(document, runs, models): quadratic drag was missing and was found, steering lag as well."""
    drag = with_effect(plain, "quadratic_drag", coefficient=0.2)
    both = with_effect(drag, "steering_lag", time_constant=0.2)
    runs = [replace(drive(both, 30.0, seed=seed), name=f"run {seed}") for seed in (1, 2)]
    runs[0] = replace(runs[0], findings=(Finding("jump", "x jumped <once> & was cut"),))
    names, models = ["quadratic_drag", "steering_lag"], [plain, drag, both]
    stages = []
    for number, model in enumerate(models):
        error = rollout_error(model, windows_of(runs, 1.0))
        per_state = dict(zip(plain.system.state_names, error.per_state.tolist(), strict=True))
        stages.append(
            {
                "effects": names[:number],
                "heldout_error": error.value,
                "per_state": per_state,
                "runs_improved": "2/2" if number else "",
            }
        )
    errors = [stage["heldout_error"] for stage in stages]
    document = {
        "format": 1,
        "robot": "car",
        "verdict": "effect_missing",
        "added": names,
        "stages": stages,
        "candidates": [
            candidate(0, names[0], errors[1], "accepted", indistinguishable_from=["viscous_drag"]),
            candidate(0, "viscous_drag", errors[1] * 1.01, "suspected", indistinguishable_from=[names[0]]),
            *[candidate(0, f"other_{number}", errors[0]) for number in range(8)],
            candidate(1, names[1], errors[2], "accepted"),
            candidate(1, "other_1", None, score=None),
            candidate(2, "other_2", errors[2]),
        ],
        "where": [{"variable": "speed", "low": 2.0, "high": 3.0, "error": 0.4, "share": 0.4, "samples": 12}],
        "unexplained": {"depends_on": ["x", "y"], "expression": "speed' = -0.3 [x > 1]", "share": 0.42},
        "next_experiment": {"manoeuvre": "Coast down", "separates": ["a", "b"], "why": "They differ there"},
        "data_quality": [{"run": "run 1", "kind": "jump", "message": "x jumped <once> & was cut"}],
    }
    return document, runs, models


def embedded(text):
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.S).group(1))


def test_the_page_has_the_whole_story(diagnosed, tmp_path):
    document, runs, models = diagnosed
    path = write_report(document, runs, models, tmp_path, "my model")
    text = path.read_text(encoding="utf-8")
    words = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text[: text.index("plotly.js v")]))
    assert path.name == "report.html"
    first, last = document["stages"][0]["heldout_error"], document["stages"][-1]["heldout_error"]
    for expected in (
        f"The model lacks quadratic_drag and steering_lag. With them the error on data that was not used for fitting "
        f"falls from {first:.3g} to {last:.3g}, by {100 * (1 - last / first):.0f} %.",
        "42 % of what remains depends on x and y",
        "What is missing beside quadratic_drag?",
        "coefficient 0.2 ± 0.004 1/m",
        "quadratic_drag (accepted) and viscous_drag",
        "4 more candidates",
        "Quadratic_drag does what it does. Cannot be told from viscous_drag.",
        "Coast down It separates a from b. They differ there",
        "It is a formula that fits, not a physical effect with a name",
        "x jumped &lt;once&gt; &amp; was cut",
    ):
        assert expected in words
    assert [figure["id"] for figure in embedded(text)["figures"]] == ["falling", "where", "residuals", "maps"]
    for figure in embedded(text)["figures"]:
        assert f'id="{figure["id"]}"' in text


def test_the_page_asks_no_other_host(diagnosed):
    document, runs, models = diagnosed
    text = report_page({**document, "added": ["</script><b>x", "y"]}, runs, models, "<model>")
    assert len(text) < 6e6
    assert re.search(r"<(script|img|link|iframe|source)[^>]+(src|href)\s*=", text.replace("\n", " ")[:30000]) is None
    own = text[: text.index("plotly.js v")] + text[text.index('<script type="application/json"') :]
    assert "http://" not in own
    assert "https://" not in own
    assert "default-src 'none'" in own
    assert text.count("</script") == 4
    assert "&lt;model&gt;" in text


def test_the_bars_fall(diagnosed):
    document, _, _ = diagnosed
    bars = [trace for trace in falling_figure(document)["data"] if trace["type"] == "bar"]
    assert len(bars) == 5
    assert bars[0]["y"] == sorted(bars[0]["y"], reverse=True)
    np.testing.assert_allclose(bars[0]["y"], [stage["heldout_error"] for stage in document["stages"]], rtol=1e-4)
    shown = [trace["text"][0] for trace in falling_figure(document)["data"] if trace.get("mode") == "text"]
    first, last = document["stages"][0]["heldout_error"], document["stages"][-1]["heldout_error"]
    assert f"−{100 * (1 - last / first):.0f} %" in shown[2]


def test_figures_show_less_error_after(diagnosed):
    from safedpa.compare.comparison import compare_model

    _, runs, models = diagnosed
    before, after = compare_model(models[0], runs), compare_model(models[-1], runs)
    for figure in (before_after_figure(before, after), map_figure(before, after)):
        traces = [trace for trace in figure["data"] if trace["type"] in ("bar", "heatmap")]
        half = len(traces) // 2
        pairs = zip(traces[:half], traces[half:], strict=True)
        if traces[0]["type"] == "bar":
            pairs = zip(traces[::2], traces[1::2], strict=True)
        for one, other in pairs:
            old, new = (np.array(item.get("z", item["y"]), dtype=float) for item in (one, other))
            assert old.shape == new.shape
            assert np.nanmean(new) < 0.2 * np.nanmean(old)
    heat = [trace for trace in map_figure(before, after)["data"] if trace["type"] == "heatmap"]
    assert len({trace["zmax"] for trace in heat}) == 1
    assert [trace["showscale"] for trace in heat] == [True, *[False] * (len(heat) - 1)]


def test_nothing_missing_is_a_page_too(diagnosed):
    document, runs, models = diagnosed
    bare = {
        **document,
        "verdict": "nothing_missing",
        "added": [],
        "stages": document["stages"][:1],
        "candidates": [candidate(0, "viscous_drag", document["stages"][0]["heldout_error"])],
        "unexplained": None,
        "next_experiment": None,
        "data_quality": [],
    }
    text = report_page(bare, runs, models[:1], "complete")
    for expected in ("Nothing is missing", "None is needed", "Nothing was cut", "What does the given model lack?"):
        assert expected in text
    assert "What was found" not in text
    names = {trace.get("name") for trace in embedded(text)["overlays"][0]["data"]}
    assert "after" not in names
    unexplained = {**bare, "verdict": "unexplained", "unexplained": document["unexplained"]}
    assert "no effect of the library describes" in story_of(unexplained).lead


def test_a_stage_lists_what_it_changed():
    names = [["drag"], ["drag", "lag", "offset"], ["lag", "offset"], ["lag", "offset"]]
    stages = [{"effects": effects} for effects in names]
    told = [step_text(before, stage) for before, stage in zip([None, *stages], stages, strict=False)]
    assert told == ["given model", "+ lag + offset", "− drag", "refitted"]


def test_numbers_that_are_not_finite_leave_gaps(diagnosed):
    document, runs, models = diagnosed
    stages = [{**document["stages"][0], "heldout_error": None, "per_state": {"x": None, "y": 1.0}}]
    lost = candidate(0, "drag", None, parameters={"coefficient": {"value": None, "std": None, "unit": "1/m"}})
    broken = {**document, "stages": stages, "added": [], "candidates": [lost], "verdict": "unexplained"}
    assert "coefficient nan 1/m" in report_page(broken, runs, models[:1], "broken")


def test_the_last_fit_counts(diagnosed):
    document, _, _ = diagnosed
    last = {"quadratic_drag.coefficient": {"value": 0.19, "std": 0.002, "unit": "1/m"}}
    found = story_of({**document, "parameters": last}).found
    assert found[0].parameters == [("coefficient", "0.19", "0.002", "1/m")]
    assert found[1].parameters == [("coefficient", "0.2", "0.004", "1/m")]


def test_parameters_read_as_a_person_writes_them():
    entry = {"value": 0.1234, "std": None, "unit": "1"}
    assert parameters_text({"gain": entry, "angle": {"value": -2.0, "std": 0.01, "unit": "rad"}}) == (
        "gain 0.123, angle -2 ± 0.01 rad"
    )


def test_a_pendulum_has_a_page_and_a_recording_without_a_plane(tmp_path):
    model = load_model("dfki_pendulum")
    states = np.zeros((600, 2))
    states[0] = 2.0, 0.0
    torque = 0.4 * np.sin(0.05 * np.arange(600))[:, None]
    for row in range(599):
        states[row + 1] = model.step(states[row], torque[row])
    t = np.arange(600) * 0.005
    run = Run("swing", model.system, t, states, torque, (Stretch(0, 600),))
    stage = {"effects": [], "heldout_error": 0.5, "per_state": {"angle": 0.5, "rate": 0.5}, "runs_improved": ""}
    document = {
        "verdict": "nothing_missing", "added": [], "stages": [stage], "candidates": [], "where": [], "horizon": 0.5,
        "unexplained": None, "next_experiment": None, "data_quality": [],
    }  # fmt: skip
    assert "angle [rad]" in report_page(document, [run], [model], "pendulum")
    assert write_recording(document, [run], [model], tmp_path).stat().st_size > 1000


def test_the_recording_plays_stage_after_stage(diagnosed, tmp_path):
    document, runs, models = diagnosed
    path = write_recording(document, runs, models, tmp_path)
    assert path.name == "diagnosis.rrd"
    content = path.read_bytes()
    assert len(content) < 5e6
    for name in ("plane/measured", "plane/predicted", "plane/robot", "states/speed/measured", "story", "error"):
        assert f"/{name}".encode() in content
    given, improved = (_rows(path, f"/states/speed/{kind}") for kind in ("given", "improved"))
    assert 0 < given < improved


def _rows(path, ending):
    """How many rows a recording holds of the entities that end so, however its writer batched them."""
    from rerun.chunk import RrdReader

    chunks = list(RrdReader(path).stream())
    return sum(chunk.num_rows for chunk in chunks if str(chunk.entity_path).endswith(ending))


def test_long_logs_are_shown_in_part(diagnosed, monkeypatch):
    document, runs, models = diagnosed
    long = replace(runs[1], stretches=(Stretch(0, 250), Stretch(260, 600)))
    shown = excerpt([runs[0], long], 300)
    assert [run.stretches[0].start for run in shown] == [0, 0]
    assert 200 <= sum(len(part) for run in shown for part in run.stretches) <= 400
    assert excerpt(runs, 1200) == runs
    slow = excerpt([replace(runs[0], t=10.0 * runs[0].t)], 150)[0]
    assert [(part.start, part.stop) for part in slow.stretches] == [(start, start + 20) for start in range(0, 600, 80)]
    far = excerpt([replace(runs[0], t=10.0 * runs[0].t)], 150, horizon=20.0)[0]
    assert {len(part) for part in far.stretches} == {120}
    many = excerpt(runs * 50, 600)
    assert len(many) < 10
    assert 500 <= sum(len(part) for run in many for part in run.stretches) <= 1200
    heading = heads([long], 13.52)[0]
    assert [(part.start, part.stop) for part in heading.stretches] == [(0, 250), (260, 271)]
    monkeypatch.setattr("safedpa.report.diagnosis_page.excerpt", lambda runs, _, horizon: excerpt(runs, 600, horizon))
    assert "excerpt of 25 % of the logs" in report_page(document, runs * 2, models, "long")


def test_a_recording_that_cannot_be_written_raises_an_error(diagnosed, tmp_path):
    document, runs, models = diagnosed
    with pytest.raises(RecordingError):
        write_recording(document, runs, models, tmp_path / "absent" / "folder")


def test_open_questions_are_on_the_page(diagnosed):
    document, runs, models = diagnosed
    number = {"value": 0.31, "std": 0.1, "unit": "1/s"}
    near = {
        "effect": "viscous_drag", "parameters": {"viscous_drag.coefficient": number}, "heldout_fall": 0.24,
        "score": 2.1, "smallest_detectable": {}, "drive": "coast down", "reason": "likely, not proven",
    }  # fmt: skip
    size = {
        "effect": "payload", "parameter": "mass_ratio", "unit": "1", "smallest": None, "ordinary": 0.3,
        "only_with": ["base.speed_gain"], "drive": "weigh it",
    }  # fmt: skip
    lost = {"stage": 1, "run": "drive 2", "state": "yaw", "before": 0.2, "after": 0.5}
    opened = {
        **document, "verdict": "undecided", "added": [], "stages": document["stages"][:1], "candidates": [],
        "unexplained": None, "closest": [near], "detectable": [size], "worse": [lost],
    }  # fmt: skip
    text = report_page(opened, runs, models[:1], "open")
    for expected in (
        "Undecided: not enough data to tell", "viscous_drag", "24 %", "coast down", "not at all",
        "only as a sum with base.speed_gain", "yaw in drive 2 (0.2 to 0.5)",
    ):  # fmt: skip
        assert expected in text
