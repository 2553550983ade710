"""The verdicts of the thesis's figures beside ours, as they are known: a row that changes fails a test."""

import re
from pathlib import Path

KNOWN = {
    (experiment, item, what): verdict
    for experiment, item, what, verdict in (
        line.split("\t") for line in Path(__file__).with_suffix(".tsv").read_text(encoding="utf-8").splitlines()
    )
}
PLACE = re.compile(r"(table|figs?\.?) \d\.\d+(, \d\.\d+)*|[3-9]\.\d(\.\d)?(, \d\.\d)*")
"""A place of the thesis: a table, figures, or sections."""


def changed(experiment, compared):
    """Rows of an experiment whose verdict is another than the known one, with those that are not known or that lack
    a place of the thesis, a criterion, or a reason.
    """
    return [
        f"{row.item}, {row.what}: {row.verdict}, known: {known}; criterion {row.criterion!r}, why {row.why!r}"
        for row in compared
        if (known := KNOWN.get((experiment, row.item, row.what))) != row.verdict
        or not PLACE.fullmatch(row.item)
        or not row.criterion
        or bool(row.why) == (row.verdict == "agrees")
    ]
