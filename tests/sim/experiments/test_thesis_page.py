"""``reproduce all``: every table and figure of the thesis with a verdict, on one page that needs nothing else."""

import json
import re
from html import escape
from pathlib import Path

import pytest
from typer.testing import CliRunner

from oracles.thesis_verdicts import KNOWN, PLACE, changed
from stereoservo.cli.dispatch import app
from stereoservo_sim.experiments.catalogue import CONTENTS, EXPERIMENTS, REPRODUCED
from stereoservo_sim.experiments.experiment import (
    MEANINGS,
    cell_text,
    not_comparable,
    of_error,
    of_limit,
    of_statement,
    tally,
    tally_text,
)
from stereoservo_sim.experiments.thesis_page import page, reproduce_all

ROOT = Path(__file__).resolve().parents[3]


def silent(stage, done, total):
    """No progress."""


def test_verdict_words():
    assert of_error("t", "w", 1.0, 0.79, "mm", "why")[5:] == ("better", "why")
    assert of_error("t", "w", 1.0, 1.2, "mm", "why")[4:] == ("within a quarter", "agrees", "")
    assert of_error("t", "w", 1.0, 1.3, "mm", "why")[3:] == ("1.3 mm", "within a quarter", "worse", "why")
    assert of_limit("t", "w", 0.5, 0.5, "mm", "why")[4:] == ("at most 0.5 mm", "agrees", "")
    assert of_limit("t", "w", 0.5, 0.51, "mm", "why")[5:] == ("worse", "why")
    assert of_statement("t", "w", "fails", "does not", "it fails", False, "why")[4:] == (
        "it fails",
        "not reproduced",
        "why",
    )
    assert not_comparable("t", "w", "-", "1", "why")[4:] == ("-", "not comparable", "why")


def test_known_verdicts_have_places_and_words_and_their_tally_is_in_the_readme():
    assert all(PLACE.fullmatch(item) for _, item, _ in KNOWN)
    assert set(KNOWN.values()) <= set(MEANINGS)
    printed = f"all: {tally_text(tally(KNOWN.values()))}"
    assert printed in (ROOT / "README.md").read_text(encoding="utf-8"), printed


def test_values_of_rows_as_text():
    assert cell_text({"median": 0.5, "p16": 0.25, "p84": 1.0, "mean": 0.6}) == "0.5 (0.25 to 1)"
    assert cell_text({"median": None, "p16": None, "p84": None, "mean": None}) == cell_text(None) == "-"
    assert cell_text({"metric": 3, "projective": 1}) == "metric 3, projective 1"
    assert cell_text([0.25, 1.0]) == "0.25 to 1"


def test_every_table_and_figure_has_an_experiment_or_says_why_none():
    for item in CONTENTS:
        assert bool(item.experiment) != bool(item.instead), item
    assert {item.experiment for item in CONTENTS if item.experiment} == set(REPRODUCED)
    assert {key[0] for key in KNOWN} == set(REPRODUCED)


def test_the_page_holds_verdicts_and_figures_and_fetches_nothing():
    found = reproduce_all(0, 2, silent, names=("grid",))
    text = page(found, 0)
    assert text.count('src="data:image/png;base64,') == len(found[0].figures) == 1
    assert not re.search(r'(?:src|href)="(?!data:image/png|#)', text)
    for row in found[0].compared:
        assert escape(row.what) in text
        assert escape(row.criterion) in text
    assert "homing: not run" in text


def test_options_of_all(tmp_path):
    for words, said in (
        (["all", "--plot", str(tmp_path)], "--html FILE"),
        (["all", "--data", str(tmp_path)], "all does not take --data"),
        (["grid", "--html", str(tmp_path / "a.html")], "`reproduce all`"),
        (["all", "--html", str(tmp_path)], "directory"),
    ):
        run = CliRunner().invoke(app, ["reproduce", *words, "--json"])
        assert run.exit_code == 1
        assert said in json.loads(run.stdout)["error"]["message"]


def test_no_experiment_of_the_thesis_prints_raw_json():
    """Of the tables for people; here with the shortest of them."""
    run = CliRunner().invoke(app, ["reproduce", "grid", "--seeds", "1"])
    assert run.exit_code == 0, run.output
    assert not re.search(r'[{\[]"|\{\'', run.output)
    assert "verdicts: " in run.output


def test_verdicts_of_the_inverse_kinematics_are_the_known_ones():
    experiment = EXPERIMENTS["inverse-kinematics"]
    compared = experiment.compare(experiment.run(0, {"seeds": 10}, silent))
    assert {(row.item, row.what) for row in compared} == {key[1:] for key in KNOWN if key[0] == experiment.name}
    assert changed(experiment.name, compared) == []
    assert changed(experiment.name, [row._replace(item="") for row in compared[:1]])
    assert changed(experiment.name, [row._replace(why="") for row in compared[:1]])


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_verdicts_of_the_whole_thesis_are_the_known_ones():
    found = reproduce_all(0, None, silent)
    for one in found:
        assert changed(one.experiment.name, one.compared) == []
        assert one.figures
    assert {(one.experiment.name, row.item, row.what) for one in found for row in one.compared} == set(KNOWN)
    assert set(REPRODUCED) <= set(EXPERIMENTS)
