"""The verdicts of the thesis's figures beside ours, as they are known: a row that changes fails a test."""

from pathlib import Path

KNOWN = {
    (experiment, item, what): verdict
    for experiment, item, what, verdict in (
        line.split("\t") for line in Path(__file__).with_suffix(".tsv").read_text(encoding="utf-8").splitlines()
    )
}


def changed(experiment, compared):
    """Rows of an experiment whose verdict is another than the known one, with those that are not known."""
    return [
        f"{row.item}, {row.what}: {row.verdict}, known: {known}"
        for row in compared
        if (known := KNOWN.get((experiment, row.item, row.what))) != row.verdict
    ]
