"""`stereoservo bench`: figures that are there and hang together. How large they are is nobody's promise here."""

import json
import mmap
import os

import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo.control.law_registry import LAWS
from stereoservo_sim.benchmarks import calibration, cycle
from stereoservo_sim.benchmarks.calibration import run_calibration, thesis_sized
from stereoservo_sim.benchmarks.features import run_features
from stereoservo_sim.benchmarks.startup import memory_of
from stereoservo_sim.benchmarks.timing import machine, stolen_share, summary, timed
from stereoservo_sim.experiments.learnt_postures import family
from stereoservo_sim.world import synthetic


def quiet(stage, done, total):
    assert 0 < done <= total


def test_timing_leaves_the_warm_up_out():
    seen = []
    wall, cpu = timed(seen.append, 3, warm_up=2)
    assert seen == [0, 1, 0, 1, 2]
    assert len(wall) == len(cpu) == 3
    assert min(wall) >= 0.0


def test_summary_states_repetitions_and_has_a_p99_where_it_means_something():
    few = summary([0.001, 0.003, 0.002], 1e3)
    assert few == {"repetitions": 3, "median": 2.0, "max": 3.0}
    many = summary(list(np.arange(1.0, 101.0)))
    assert many["p99"] == pytest.approx(99.01, abs=0.005)


def test_machine_facts_and_stolen_time():
    facts = machine()
    assert facts["cores"] >= 1
    assert facts["numpy"] == np.__version__
    assert stolen_share((10, 1000), (30, 1200)) == pytest.approx(0.1)
    assert stolen_share(None, (1, 2)) is None
    assert stolen_share((1, 2), (1, 2)) is None


def test_memory_of_a_process_is_what_it_has_written():
    before = memory_of(os.getpid())
    with mmap.mmap(-1, 64 << 20) as mapped:
        mapped.write(bytes(64 << 20))
        after = memory_of(os.getpid())
    assert all(after[key] - before[key] > 63.0 for key in ("rss", "pss"))
    assert 0.0 < before["pss"] <= before["rss"]


def test_calibration_is_thesis_sized_and_reaches_one_minimum(monkeypatch):
    monkeypatch.setattr(calibration, "IMAGES", (100, 200))
    monkeypatch.setattr(calibration, "MARKERS", (8, 16))
    monkeypatch.setattr(calibration, "MARKER_IMAGES", 48)
    result = run_calibration(3, 0, quiet)
    assert result["problem"] == {
        "joints": 6,
        "stops_per_joint": 20,
        "markers": 16,
        "cameras": 2,
        "images": 240,
        "measurements": 2 * 240 * 16,
    }
    assert result["fit_wall_s"]["repetitions"] == 3
    found = result["least_squares"]
    # Two programs, one problem: the same minimum, and the noise's.
    assert found["chi2"]["ours"] == pytest.approx(found["chi2"]["scipy"], rel=1e-6)
    assert found["chi2"]["ours"] == pytest.approx(found["chi2"]["freedom"], rel=5 * np.sqrt(2 / 7680))
    first, last = result["per_image"]
    assert last["images"] > first["images"]
    assert result["fit_ms_an_image_last_over_first"] == pytest.approx(
        last["fit_ms_an_image"] / first["fit_ms_an_image"]
    )
    few, many = result["per_marker"]
    assert (few["markers"], many["markers"], many["cameras"], many["images"]) == (8, 16, 2, 48)
    assert 50 < few["peak_memory_mb"] < many["peak_memory_mb"] + 50 < 1000
    assert result["fit_cpu_exponent_over_markers"] == pytest.approx(
        np.log(many["fit_cpu_s"] / few["fit_cpu_s"]) / np.log(2.0)
    )
    assert thesis_sized().in_view(thesis_sized().stops(20)[0]).mean() > 0.95


def test_cycle_times_kernels_and_core(monkeypatch):
    """Of two laws and bodies: all laws and sizes differ in nothing but their times."""
    laws = {name: LAWS[name] for name in ("stereo", "trajectory")}
    monkeypatch.setattr(cycle, "LAWS", laws)
    monkeypatch.setattr(cycle, "LARGE_BODIES", cycle.LARGE_BODIES[:2])
    result = cycle.run_cycle(1, 0, quiet)
    assert result["stereo_step_us"]["kernels"]["repetitions"] == 200
    assert set(result["core_step_us"]) == set(result["law_step_us"]) == set(laws)
    for found in result["core_step_us"].values():
        for pace in ("tight", "paced"):
            assert found[pace]["between frames"]["repetitions"] >= 100
            assert found[pace]["with frames"]["repetitions"] >= 10
        for stages in found["stages"].values():
            assert min(stages.values()) > 0.0


def test_features_find_the_dots():
    result = run_features(1, 0, quiet)
    assert result["dots_found"]["least"] >= 7
    baseline = "cv2_threshold_and_connected_components"
    assert set(result["ms"]) == {"cold", "tracking", "tracking_2x4", baseline}
    assert result["tags"]["corners_found"] == 1.0
    assert result["tags"]["rms_px"] < 0.012
    for row in result["robustness"]:
        low, high = row["tracked"]["all_faces_wilson_95"]
        assert low <= row["tracked"]["all_faces"] / row["tracked"]["frames"] <= high
        assert row["tracked"]["wrong_ids"] == row["acquired"]["wrong_ids"] == 0


def test_command_prints_one_object_with_the_machine(capfd):
    assert cli.invoke(["bench", "features", "--repetitions", "1", "--json"]) == 0
    out = capfd.readouterr().out
    answer = json.loads(out)
    assert out.count("\n") == 1
    assert answer["bench"] == "features"
    assert answer["machine"]["python"]
    assert "stolen_share" in answer["machine"]


def test_unknown_names_are_refused_with_the_list(capfd):
    assert cli.invoke(["bench", "wheels", "--json"]) == 1
    error = json.loads(capfd.readouterr().out)["error"]
    assert error["code"] == "bench"
    assert error["known"] == [
        "calibration",
        "can",
        "cycle",
        "detectors",
        "faults",
        "features",
        "idle",
        "ik",
        "kills",
        "loop",
        "page",
        "recording",
        "scale",
        "soak",
        "soak-live",
        "startup",
        "watch",
        "wire",
    ]
    assert "wheels" in error["message"]


def test_postures_of_a_learnt_arm_are_counted_beside_those_of_the_true_one():
    row = family("gantry", synthetic.gantry(), 3, np.random.default_rng(0))
    assert (row["refused"], row["poses_found"], row["postures_found"], row["postures"]) == (0, 3, 3, 3)
    assert row["wall_ms"]["repetitions"] == 3
    assert row["cpu_ms"]["median"] > 0.0
