"""A figure of ours beside the thesis's, in one verdict word: what each word means, and how it is found.

Our error stands against the thesis's, never the bound of an error; a bound is a reason where no estimator can do
better. An error is ``better`` or ``worse`` beyond a quarter of the thesis's own, else it ``agrees``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Literal, NamedTuple

Verdict = Literal["agrees", "better", "worse", "not comparable", "not reproduced"]
MEANINGS: dict[Verdict, str] = {
    "agrees": "an error within a quarter of the thesis's, within a limit that it states, or what it saw is seen again",
    "better": "an error of ours at least a fifth smaller than the thesis's",
    "worse": "an error of ours more than a quarter larger than the thesis's, or above a limit that it states",
    "not comparable": "the thesis gives a value of another thing, or too little to compare with",
    "not reproduced": "what the thesis saw is not what is seen here",
}
MARGIN = 1.25
"""Of a ratio of errors, to either side, that still agrees."""


class Comparison(NamedTuple):
    """A row: ``item`` of the thesis (table, figure, section), ``what`` is compared, both values as text, the verdict
    and why it is so."""

    item: str
    what: str
    thesis: str
    ours: str
    verdict: Verdict
    why: str = ""


def of_error(
    item: str, what: str, thesis: float | None, ours: float | None, unit: str, why: str = "", lost: str = ""
) -> Comparison:
    """Comparison of two errors [unit]; ``why`` is said where ours is not ``better``, ``lost`` where there is none."""
    if thesis is None or ours is None:
        return Comparison(item, what, _text(thesis, unit), _text(ours, unit), "not comparable", lost)
    verdict: Verdict = "agrees"
    if ours > MARGIN * thesis:
        verdict = "worse"
    elif MARGIN * ours < thesis:
        verdict = "better"
    return Comparison(
        item, what, _text(thesis, unit), _text(ours, unit), verdict, why if verdict == "worse" else ""
    )


def of_limit(
    item: str, what: str, limit: float, ours: float | None, unit: str, why: str = "", said: str = "below"
) -> Comparison:
    """Comparison of an error of ours [unit] with the limit that the thesis states; ``why`` is said above it."""
    if ours is None:
        return Comparison(item, what, f"{said} {_text(limit, unit)}".strip(), "-", "not reproduced", why)
    held = ours <= limit
    return Comparison(
        item,
        what,
        f"{said} {_text(limit, unit)}".strip(),
        _text(ours, unit),
        "agrees" if held else "worse",
        "" if held else why,
    )


def of_statement(item: str, what: str, thesis: str, ours: str, seen: bool, why: str = "") -> Comparison:
    """Comparison of what the thesis saw with what is ``seen`` here; ``why`` is said where it is not."""
    return Comparison(item, what, thesis, ours, "agrees" if seen else "not reproduced", "" if seen else why)


def tally(comparisons: Iterable[Comparison]) -> dict[str, int]:
    """How many rows have each verdict, in the order of their meanings."""
    counts = Counter(row.verdict for row in comparisons)
    return {verdict: counts[verdict] for verdict in MEANINGS}


def _text(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.4g} {unit}".strip()
