"""Places the messages of several topics in time, in segments between which a clock was set.

Receipt times and stamps are judged in the order of the file. Stamps that are 0, in the future or of another epoch are
replaced by the time of receipt, message by message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.errors import RunError
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.readers.bags.topics import RECEIPT, Series
from safedpa.records.run import Finding
from safedpa.records.segments import MAX_LATE, judge_clock, late_rows

__all__ = ["Placed", "place_messages"]

_NEAREST_DELAY = 1e-4
"""s; a median delay below it is not reported."""
_STUCK = 2
"""Repetitions of one stamp from which on a clock is stuck; fewer come from a clock of coarse steps."""
_SAME = 1000
"""ns; stamps that differ by less are the same."""
_OWN_CLOCK = 1e6
"""Weight of a stamp that agrees with the clock of the rows, compared with one that does not."""


@dataclass
class Placed:
    """The messages of one topic in time, in the order of the file."""

    time: NDArray[np.int64]
    """ns on the clock of the rows."""
    segment: NDArray[np.intp]
    order: NDArray[np.intp]
    """Messages by segment and time, without those that have no time."""


@dataclass(frozen=True)
class _Cut:
    """A clock was set between two messages of the file, at ``low`` and ``high``.

    ``before`` and ``after`` are what a message between them is compared with: a receipt time, or a delay [ns].
    """

    low: int
    high: int
    before: int
    after: int
    by_delay: bool = False


def place_messages(
    path: Path, found: Mapping[str, Series], rows_topic: str, clock: str
) -> tuple[dict[str, Placed], list[Finding]]:
    """Places the messages of all topics on the clock of the topic that gives the rows.

    Raises RunError if the stamps of a topic, and those of the rows, are of two clocks throughout.
    """
    findings: list[Finding] = []
    rows = found[rows_topic]
    stamped = clock != RECEIPT and rows.stamp is not None
    receipts = {topic: judge_clock(_seconds(series.receipt)) for topic, series in found.items()}
    cuts = [cut for topic, series in found.items() for cut in _receipt_cuts(series, receipts[topic].cuts)]
    wrong = {topic: judged.wrong.copy() for topic, judged in receipts.items()}
    if stamped:
        stamps, stamp_cuts = _judged_stamps(rows, receipts[rows_topic].segment, None)
        cuts += [cut for cut in stamp_cuts if not any(cut.low < one.high and one.low < cut.high for one in cuts)]
    cuts = _merged(cuts)
    placed = {}
    rows_segment = _segments(rows, cuts)
    for topic, series in found.items():
        segment = rows_segment if topic == rows_topic else _segments(series, cuts)
        time = series.receipt
        if stamped:
            level = _level(series, segment, rows, rows_segment, ~stamps)
            bad = stamps if topic == rows_topic else _bad_stamps(series, receipts[topic].segment, segment, level)
            if topic != rows_topic:
                _check_clocks(path, rows_topic, topic, series, bad, level)
            time = _time(series, bad, level)
            findings += _bad_stamp_finding(topic, series, time, bad & ~wrong[topic])
        placed[topic] = Placed(time, segment, np.empty(0, dtype=np.intp))
        findings += _lost_finding(topic, series, wrong[topic])
        replaced = wrong[topic] | (bad if stamped and series.stamp is not None else False)
        findings += _late_finding(topic, time, segment, replaced)
        right = np.flatnonzero(~wrong[topic])
        placed[topic].order = right[np.lexsort((time[right], segment[right]))]
    findings += _receipt_findings(cuts, placed[rows_topic])
    if stamped:
        findings += _delay_finding(rows_topic, rows, stamps)
    return placed, findings


def _seconds(nanoseconds: NDArray[np.int64]) -> FloatArray:
    """Seconds since the first message: differences of integers are exact."""
    return np.asarray((nanoseconds - nanoseconds[:1].sum()) * 1e-9)


def _receipt_cuts(series: Series, rows: NDArray[np.intp]) -> list[_Cut]:
    at, receipt = series.place, series.receipt
    return [_Cut(int(at[k - 1]), int(at[k]), int(receipt[k - 1]), int(receipt[k])) for k in rows.tolist()]


def _judged_stamps(series: Series, parts: NDArray[np.intp], agree: BoolArray | None) -> tuple[BoolArray, list[_Cut]]:
    """Wrong stamps, and the cuts between stamps; ``parts`` are the segments of the receipt times.

    Of two publishers whose stamps differ, the one whose stamps ``agree`` with the clock of the rows is right.
    """
    assert series.stamp is not None
    stamp, receipt = series.stamp, series.receipt
    near = np.abs(receipt - stamp) * 1e-9 < MAX_LATE if agree is None else agree
    wrong = _zero(series)
    # also of each of two publishers, whose messages alternate
    for rows in (np.arange(len(near)), np.flatnonzero(near), np.flatnonzero(~near)):
        wrong[rows] |= _stuck(series, rows)
    cuts = []
    for number in np.unique(parts):
        rows = np.flatnonzero((parts == number) & ~wrong)
        if not len(rows):
            continue
        weight = np.where(near[rows], 1.001 if agree is None else _OWN_CLOCK, 1.0)
        judged = judge_clock(_seconds(stamp[rows]), _seconds(receipt[rows]), weight)
        wrong[rows[judged.wrong]] = True
        right = rows[~judged.wrong]
        edges = np.flatnonzero(np.diff(judged.segment[~judged.wrong])) + 1
        for before, after in zip(right[edges - 1].tolist(), right[edges].tolist(), strict=True):
            delay, later = (int(receipt[k] - stamp[k]) for k in (before, after))
            cuts.append(_Cut(int(series.place[before]), int(series.place[after]), delay, later, by_delay=True))
    return wrong, cuts


def _zero(series: Series) -> BoolArray:
    """Stamps of 0, unless the delay of the next message that has one shows that its clock did begin then."""
    assert series.stamp is not None
    zero, filled = series.stamp <= 0, np.flatnonzero(series.stamp > 0)
    if not zero.any() or not len(filled):
        return zero
    delay = series.receipt - series.stamp
    after = filled[np.minimum(np.searchsorted(filled, np.arange(len(zero))), len(filled) - 1)]
    return np.asarray(zero & (np.abs(delay - delay[after]) > MAX_LATE * 1e9))


def _stuck(series: Series, rows: NDArray[np.intp]) -> BoolArray:
    """Which of ``rows`` repeat a stamp, but not its values and time of receipt, three times or more in a row."""
    assert series.stamp is not None
    again = np.zeros(len(rows), dtype=bool)
    for values in series.values.values():
        again[1:] |= np.diff(values[rows]) != 0.0
    again[1:] &= (np.abs(np.diff(series.stamp[rows])) <= _SAME) & (np.diff(series.receipt[rows]) > 0)
    if not again.any():
        return again
    edges = np.flatnonzero(np.diff(np.concatenate([[False], again, [False]]).astype(np.int8)))
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        again[start:stop] = stop - start >= _STUCK
    return again


def _merged(cuts: list[_Cut]) -> list[_Cut]:
    """One cut for those of several topics that overlap: between the latest low and the earliest high message."""
    merged: list[_Cut] = []
    for cut in sorted(cuts, key=lambda one: (one.low, one.high)):
        if merged and cut.low < merged[-1].high:
            last = merged[-1]
            first = cut if cut.high < last.high else last
            merged[-1] = _Cut(cut.low, first.high, cut.before, first.after, cut.by_delay)
        else:
            merged.append(cut)
    return merged


def _segments(series: Series, cuts: list[_Cut]) -> NDArray[np.intp]:
    """Number of cuts before each message."""
    if not cuts:
        return np.zeros(len(series.receipt), dtype=np.intp)
    at = series.place
    begun = np.searchsorted([cut.low for cut in cuts], at, side="left")
    ended = np.searchsorted([cut.high for cut in cuts], at, side="right")
    segment = ended.copy()
    for row in np.flatnonzero(begun > ended).tolist():  # between the messages that show the cut
        cut = cuts[ended[row]]
        own = int(series.receipt[row])
        if cut.by_delay:
            own -= int(series.stamp[row]) if series.stamp is not None else own - cut.before
        segment[row] += abs(own - cut.after) < abs(own - cut.before)
    return segment


def _level(
    series: Series,
    segment: NDArray[np.intp],
    rows: Series,
    rows_segment: NDArray[np.intp],
    good: BoolArray,
) -> FloatArray:
    """Delay [s] from stamp to receipt of the nearest row in the segment of each message; NaN without one."""
    assert rows.stamp is not None
    known = np.flatnonzero(good)
    if not len(known):
        return np.full(len(segment), np.nan)
    delay = (rows.receipt - rows.stamp)[known] * 1e-9
    at, own = rows.place[known], rows_segment[known]
    after = np.minimum(np.searchsorted(at, series.place, side="left"), len(known) - 1)
    before = np.maximum(after - 1, 0)
    same = own[after] == segment
    nearer = np.abs(at[before] - series.place) < np.abs(at[after] - series.place)
    chosen = np.where((own[before] == segment) & (nearer | ~same), before, after)
    return np.where(own[chosen] == segment, delay[chosen], np.nan)


def _bad_stamps(series: Series, parts: NDArray[np.intp], segment: NDArray[np.intp], level: FloatArray) -> BoolArray:
    """Messages of another topic whose stamps are not on the clock of the rows."""
    if series.stamp is None:
        return np.zeros(len(series.receipt), dtype=bool)
    agree = np.abs((series.receipt - series.stamp) * 1e-9 - level) <= MAX_LATE
    bad, cuts = _judged_stamps(series, parts, agree)
    piece = np.searchsorted([cut.high for cut in cuts], series.place, side="right")
    # a part of the receipts, and of the rows, is a piece of its own
    piece = (piece * (int(parts.max()) + 1) + parts) * (int(segment.max()) + 1) + segment
    for number in np.unique(piece):  # stamps that arrive late together are right if most of them agree
        own = (piece == number) & ~bad
        if own.any() and agree[own].mean() < 0.5:
            bad |= own
    return bad


def _check_clocks(path: Path, rows_topic: str, topic: str, series: Series, bad: BoolArray, level: FloatArray) -> None:
    delay = 0.0 if series.stamp is None else (series.receipt - series.stamp) * 1e-9
    apart = np.abs(level - delay)
    known = np.isfinite(apart)
    if not known.any() or not (bad.all() if series.stamp is not None else np.median(apart[known]) > MAX_LATE):
        return
    raise RunError(
        f"{path}: stamps of '{rows_topic}' and times of '{topic}' are {np.median(apart[known]):.3g} s apart:"
        ' two clocks, or a replayed log; wanted one clock: t = { topic = "'
        f'{rows_topic}", clock = "receipt" }}'
    )


def _time(series: Series, bad: BoolArray, level: FloatArray) -> NDArray[np.int64]:
    """Time of each message [ns]: its stamp, or its receipt minus the usual delay."""
    if series.stamp is None:
        return series.receipt
    if not bad.any():
        return series.stamp
    own = (series.receipt - series.stamp) * 1e-9 - level
    known = ~bad & np.isfinite(own)
    offset = float(np.median(own[known])) if known.any() else 0.0
    # receipts that were kept as float64 are inexact by 256 ns, and a command belongs to the row of its own time
    delay = np.round((np.nan_to_num(level) + offset) * 1e9).astype(np.int64) + _SAME
    return np.where(bad, series.receipt - delay, series.stamp)


def _bad_stamp_finding(topic: str, series: Series, time: NDArray[np.int64], bad: BoolArray) -> list[Finding]:
    if series.stamp is None or not bad.any():
        return []
    first = int(np.flatnonzero(bad)[0])
    count = int(bad.sum())
    stamp = series.stamp[first] / 1e9
    text = f"{topic}: {count} of {count_text(len(bad), 'message has', 'messages have')} "
    text += f"a stamp of another clock ({stamp:.3f} s)" if stamp else "no stamp (0)"
    done = "their time of receipt was taken instead"
    return [finding("bad_stamp", text, count, time[first] / 1e9, done)]


def _lost_finding(topic: str, series: Series, wrong: BoolArray) -> list[Finding]:
    if not wrong.any():
        return []
    first = int(np.flatnonzero(wrong)[0])
    text = f"{topic}: {count_text(int(wrong.sum()), 'message was', 'messages were')} received at a time that fits none "
    text += f"around it ({series.receipt[first] / 1e9:.3f} s)"
    near = series.receipt[max(first - 1, 0)] / 1e9
    return [finding("bad_stamp", text, int(wrong.sum()), near, "ignored")]


def _late_finding(topic: str, time: NDArray[np.int64], segment: NDArray[np.intp], replaced: BoolArray) -> list[Finding]:
    right = np.flatnonzero(~replaced)
    late, largest = late_rows(_seconds(time[right]), segment[right])
    count = int(late.sum())
    if not count:
        return []
    text = f"{topic}: {count_text(count, 'message is', 'messages are')} out of order by up to {largest:.3g} s"
    return [finding("out_of_order", text, count, time[right[np.argmax(late)]] / 1e9, "sorted")]


def _receipt_findings(cuts: list[_Cut], rows: Placed) -> list[Finding]:
    """Clocks of the recorder that were set back where the times of the rows do not show it."""
    set_back = [
        cut
        for number, cut in enumerate(cuts)
        if cut.after < cut.before and not cut.by_delay and not _shown(rows, number)
    ]
    if not set_back:
        return []
    first = set_back[0]
    text = f"the clock of the recorder runs backwards {count_text(len(set_back), 'time', 'times')} "
    text += f"(from {first.before / 1e9:.3f} to {first.after / 1e9:.3f} s)"
    return [finding("clock_reset", text, len(set_back), first.after / 1e9, "cut there")]


def _shown(rows: Placed, cut: int) -> bool:
    before, after = rows.time[rows.segment == cut], rows.time[rows.segment == cut + 1]
    return bool(len(before) and len(after) and after.min() < before.max())


def _delay_finding(rows_topic: str, rows: Series, bad: BoolArray) -> list[Finding]:
    assert rows.stamp is not None
    delay = float(np.median((rows.receipt - rows.stamp)[~bad])) * 1e-9 if not bad.all() else 0.0
    if abs(delay) < _NEAREST_DELAY:
        return []
    sentence = f"times are the stamps of {rows_topic}; they were received {delay * 1000:.1f} ms later (median)"
    return [Finding("stamps", sentence, len(rows.receipt))]
