"""What a robot writes of its periods is what a campaign of faults reads."""

from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa_sim.robots.run_summary import TracedPeriod, TraceWriter, read_trace

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
ROWS = st.lists(NUMBERS, max_size=4).map(tuple)
PERIODS = st.builds(
    TracedPeriod, epoch=st.integers(), tick=st.integers(), published=NUMBERS, applied_at=NUMBERS,
    action_epoch=st.integers(), action_tick=st.integers(), applied=ROWS,
    applied_by=st.sampled_from(("filter", "watchdog")), values=ROWS, collisions=st.integers(),
)  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(periods=st.lists(PERIODS, max_size=4))
def test_a_trace_is_read_as_it_was_written(periods: list[TracedPeriod], tmp_path_factory) -> None:
    path: Path = tmp_path_factory.mktemp("trace") / "trace.jsonl"
    with TraceWriter(path) as writer:
        for period in periods:
            writer.write(period)
    assert list(read_trace(path)) == periods
