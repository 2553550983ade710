"""Cameras calibrated without an arm: against true cameras projected by OpenCV's model, against cv2.stereoCalibrate on
real and rendered chessboards; degenerate views are refused for what is wrong with them.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from oracles import waved_bodies
from oracles.waved_bodies import DEGENERATE, degenerate, rendered_pictures, waved
from stereoservo.calibration.camera_rig.rig_bundle import fit_rig, starts
from stereoservo.calibration.camera_rig.rig_calibration import (
    KnownDistance,
    calibrate_rig,
    load_rig,
    save_rig,
)
from stereoservo.calibration.camera_rig.views import RigViews, still_places, usable_views
from stereoservo.calibration.normal_equations import prior_rows
from stereoservo.calibration.rig_model import rig_at
from stereoservo.calibration.trial_data import CalibrationError, TrialCamera
from stereoservo.cli import main as cli
from stereoservo.ports.devices import CameraObservation

CAUSES = {
    "board_parallel": {"flat_motion"},
    "board_almost_parallel": {"flat_motion"},
    "board_at_rest": {"flat_motion"},
    "board_slid_on_a_table": {"flat_motion"},
    "few_places": {"too_few_views"},
    "rod": {"markers_on_a_line", "flat_body"},
    "cameras_apart": {"camera_apart"},
    "body_only_shifted": {"no_turns"},
    "body_flat": {"flat_body"},
    "one_camera_unknown_body": {"one_camera"},
}
"""What is true of each kind of degenerate views, and may be said of it."""
PAIRS = Path("/usr/share/doc/opencv-doc/examples/data")
"""Where Debian's package opencv-doc has left01.jpg to right14.jpg."""


def sigma_of(seed: int) -> float:
    """Noise [px], log-uniform from 0.05 to 1."""
    return float(np.exp(np.random.default_rng(seed).uniform(np.log(0.05), 0.0)))


def normalised_error(seed: int, known: bool) -> tuple[float, int]:
    """Squared error of all cameras' parameters in their stated covariance, and its freedoms."""
    rig = waved(seed, sigma=sigma_of(seed), known=known)
    length = float(np.linalg.norm(rig.body[0] - rig.body[1]))
    result, _ = calibrate_rig(rig.views, None if known else KnownDistance(0, 1, length))
    error: list[float] = []
    for k, camera in enumerate(result.cameras):
        K = rig.K[k]
        error += [K[0, 0] - camera.focal[0], K[1, 1] - camera.focal[1], K[0, 2] - camera.centre[0]]
        error += [K[1, 2] - camera.centre[1], *(rig.distortion[k] - np.array(camera.distortion))]
    for k, camera in enumerate(result.cameras[1:], 1):
        turn = Rotation.from_matrix(rig.motions[k, :3, :3] @ np.array(camera.rotation).T).as_rotvec()
        error += [*turn, *(rig.motions[k, :3, 3] - np.array(camera.translation))]
    # Pixels were found square: fy is fx.
    kept = [i for i, name in enumerate(result.parameters) if not name.endswith(".fy")]
    C = np.array(result.covariance)[np.ix_(kept, kept)]
    e = np.array(error)[kept]
    return float(e @ np.linalg.solve(C, e)), len(kept)


@pytest.mark.parametrize(("known", "seeds"), [(True, 8), (False, 5)], ids=["board", "unknown body"])
def test_the_stated_covariance_is_that_of_the_errors(known: bool, seeds: int) -> None:
    found = [normalised_error(2000 + seed, known) for seed in range(seeds)]
    total, freedoms = sum(one for one, _ in found), sum(count for _, count in found)
    low, high = chi2.ppf([0.0005, 0.9995], freedoms)
    print(f"NEES {total / freedoms:.3f} over {seeds} seeds, interval {low / freedoms:.3f} to {high / freedoms:.3f}")
    assert low < total < high


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("known", [True, False], ids=["board", "unknown body"])
def test_good_views_are_hardly_ever_refused_and_their_covariance_holds(known: bool) -> None:
    """Of a board never; of a body that nobody has measured four of a hundred at most, where its bundle stalls, or the
    noise leaves a rotation open."""
    count, found, refused = 100, [], []
    for seed in range(count):
        try:
            found.append(normalised_error(seed, known))
        except CalibrationError as error:
            refused.append(f"{seed}: {error.code}")
    total, freedoms = sum(one for one, _ in found), sum(each for _, each in found)
    low, high = chi2.ppf([0.005, 0.995], freedoms) / freedoms
    print(f"refused {refused}, NEES {total / freedoms:.3f}, 99 % interval {low:.3f} to {high:.3f}")
    assert len(refused) <= (0 if known else 4)
    assert low < total / freedoms < high


def refusal(views: RigViews) -> str:
    """The code of the views' refusal, ``accepted`` where there is none."""
    try:
        calibrate_rig(views)
    except CalibrationError as refused:
        error = refused
    else:
        return "accepted"
    assert {"cause", "value", "limit", "remedy"} <= set(error.data), error
    return error.code


def refusals(first: int, last: int) -> dict[str, dict[str, int]]:
    """How often each kind of degenerate views was refused for which cause; ``accepted`` where it was not."""
    found: dict[str, dict[str, int]] = {kind: {} for kind in DEGENERATE}
    for seed in range(first, last):
        kind = DEGENERATE[seed % len(DEGENERATE)]
        code = refusal(degenerate(kind, seed, sigma_of(seed)).views)
        found[kind][code] = found[kind].get(code, 0) + 1
    return found


def test_degenerate_views_are_refused_for_what_is_wrong() -> None:
    found = refusals(5000, 5030)
    assert {kind: set(codes) - CAUSES[kind] for kind, codes in found.items() if set(codes) - CAUSES[kind]} == {}


@pytest.mark.slow
def test_a_thousand_degenerate_data_sets_are_refused() -> None:
    found = refusals(0, 1000)
    refused = sum(count for codes in found.values() for code, count in codes.items() if code != "accepted")
    print(f"{refused} of 1000 refused at 0.05 to 1 px: {found}")
    assert refused == 1000


def test_ties_have_the_derivatives_of_their_residuals() -> None:
    rig = waved(7, places=6)
    fit = fit_rig(usable_views(rig.views), starts(usable_views(rig.views))[0])
    data = fit.solution.data
    rows = prior_rows(fit.rig, fit.solution.charts, data)
    assert rows.shape[0] == 8
    step = 1e-2 / np.abs(rows[:, :-1]).max(axis=0, initial=1.0)
    for j in np.flatnonzero(np.abs(rows[:, :-1]).max(axis=0)):
        x = np.zeros(fit.solution.charts.size)
        x[j] = step[j]
        there, back = (
            prior_rows(rig_at(fit.rig, fit.solution.charts, sign * x), fit.solution.charts, data)[:, -1]
            for sign in (1.0, -1.0)
        )
        numeric = (there - back) / (2.0 * step[j])
        assert np.abs(numeric - rows[:, j]).max() < 1e-5 * np.abs(rows[:, j]).max()


def test_pixels_that_are_not_square_are_found() -> None:
    rig = waved(11, sigma=0.1)
    pixels = rig.views.pixels * np.array([1.0, 1.08])
    views = type(rig.views)(
        tuple(TrialCamera(c.name, c.width, 520) for c in rig.views.cameras), rig.views.marker_ids,
        rig.views.names, pixels, rig.views.sigmas, rig.views.layout,
    )  # fmt: skip
    result, fit = calibrate_rig(views)
    assert abs(fit.aspect - 1.0 / 1.08) < 1e-3
    for K, camera in zip(rig.K, result.cameras, strict=True):
        assert abs(camera.focal[1] - 1.08 * K[1, 1]) < 5.0 * camera.deviations["fy"]
        assert abs(camera.focal[0] - K[0, 0]) < 5.0 * camera.deviations["fx"]


def test_wrong_markers_are_left_out_and_a_file_holds_the_result(tmp_path: Path) -> None:
    rig = waved(12, cameras=3, sigma=0.1)
    rig.views.pixels[1, 3, 5:9] += 6.0
    result, _ = calibrate_rig(rig.views)
    assert 4 <= result.left_out <= 6
    assert result.views[-1].left_out == 0
    for K, camera in zip(rig.K, result.cameras, strict=True):
        assert abs(camera.focal[0] - K[0, 0]) < 5.0 * camera.deviations["fx"]
    save_rig(result, tmp_path / "rig.json")
    assert load_rig(tmp_path / "rig.json") == result
    (tmp_path / "rig.json").write_text("{}")
    with pytest.raises(CalibrationError, match="calibrate --rig"):
        load_rig(tmp_path / "rig.json")


def test_places_are_where_the_body_was_held_still() -> None:
    cameras = [TrialCamera("left", 640, 480), TrialCamera("right", 640, 480)]
    rng = np.random.default_rng(4)
    seen: dict[str, list[CameraObservation]] = {"left": [], "right": []}
    at = np.array([100.0, 100.0])
    for frame in range(200):
        phase = frame % 50
        if phase < 30:  # carried for a second, then held for 0.6 s
            at = at + 3.0
        for camera in cameras:
            pixels = at + 20.0 * np.arange(5)[:, None] + 0.05 * rng.normal(size=(5, 2))
            gone = camera.name == "right" and frame >= 150
            count = 0 if gone else 5
            seen[camera.name].append(
                CameraObservation(
                    camera.name, frame, round(frame / 30 * 1e9), round(frame / 30 * 1e9), np.arange(count),
                    pixels[:count], np.tile(0.01 * np.eye(2), (count, 1, 1)),
                )
            )  # fmt: skip
    views = still_places(cameras, seen)
    assert len(views.names) == 4
    assert views.seen[0].all()
    assert views.seen[1].all(axis=1).tolist() == [True, True, True, False]
    assert np.abs(views.pixels[0, 0, 0] - (100.0 + 3.0 * 30)).max() < 0.1


# -- against OpenCV -----------------------------------------------------------------------------------------


def opencv_stereo(pixels: list[np.ndarray], layout: np.ndarray, size: tuple[int, int]) -> tuple[list[float], float]:
    """Focal lengths (fx of each camera) and baseline of cv2.stereoCalibrate with k1, k2, p1, p2."""
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    points = [layout.astype(np.float32)] * len(pixels[0])
    views = [[one.astype(np.float32).reshape(-1, 1, 2) for one in each] for each in pixels]
    guess = np.array([[size[0], 0.0, size[0] / 2], [0.0, size[0], size[1] / 2], [0.0, 0.0, 1.0]])
    single = [cv2.calibrateCamera(points, each, size, guess.copy(), None, flags=flags) for each in views]
    found = cv2.stereoCalibrate(
        points, *views, single[0][1], single[0][2], single[1][1], single[1][2], size, flags=flags,
        criteria=(3, 500, 1e-12),
    )  # fmt: skip
    return [float(found[1][0, 0]), float(found[3][0, 0])], float(np.linalg.norm(found[6]))


def held_against_opencv(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stereoservo_drivers.chessboard import find_corners

    command = ["calibrate", "--rig", "--images", str(folder), "--board", "9x6", "--pitch", "0.025"]
    assert cli.invoke([*command, "--output", str(tmp_path / "rig.json"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    left, right = (sorted((folder / name).iterdir()) for name in ("left", "right"))
    corners = [
        [find_corners(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 9, 6) for path in paths] for paths in (left, right)
    ]
    both = [s for s in range(len(left)) if corners[0][s] is not None and corners[1][s] is not None]
    pixels = [[each[s] for s in both] for each in corners]
    focals, baseline = opencv_stereo(pixels, waved_bodies.board(), waved_bodies.SIZE)
    for focal, camera in zip(focals, report["cameras"], strict=True):
        apart, deviation = abs(camera["focal"][0] - focal), camera["deviations"]["fx"]
        print(f"{camera['name']}: {camera['focal'][0]:.3f} ± {deviation:.3f} px, OpenCV {focal:.3f} px")
        assert apart < max(0.5, deviation)
    ours = float(np.linalg.norm(report["cameras"][1]["translation"]))
    print(f"baseline {1e3 * ours:.4f} mm, OpenCV {1e3 * baseline:.4f} mm")
    assert abs(ours / baseline - 1.0) < 1e-3
    assert report["unit"] == "m"
    assert len(report["covariance"]) == len(report["parameters"]) == 22
    assert report["next_views"][0]["would_be_px"] < report["next_views"][0]["deviation_px"]


def test_rendered_pairs_as_opencv_has_them_and_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = rendered_pictures(5, tmp_path / "pictures", places=9)
    held_against_opencv(tmp_path / "pictures", tmp_path, capsys)
    for K, camera in zip(truth.K, load_rig(tmp_path / "rig.json").cameras, strict=True):
        assert abs(camera.focal[0] - K[0, 0]) < 4.0 * camera.deviations["fx"]


def real_pairs() -> Path | None:
    """Folder of OpenCV's chessboard pairs, where the package or $STEREOSERVO_DATA has them."""
    places = [Path(os.environ.get("STEREOSERVO_DATA", "../shared/data")) / "chessboards", PAIRS]
    return next((place for place in places if (place / "left01.jpg").exists()), None)


@pytest.mark.skipif(real_pairs() is None, reason="no left01.jpg: Debian's opencv-doc has it, or $STEREOSERVO_DATA")
def test_real_pairs_as_opencv_has_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = real_pairs()
    assert source is not None
    for name in ("left", "right"):
        (tmp_path / "pairs" / name).mkdir(parents=True)
        for path in source.glob(f"{name}[0-9][0-9].jpg"):
            (tmp_path / "pairs" / name / path.name).write_bytes(path.read_bytes())
    held_against_opencv(tmp_path / "pairs", tmp_path, capsys)


# -- the command --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--rig", "--board", "9x6"], "--pitch"),
        (["--rig", "--board", "8x6", "--pitch", "0.02", "--images", "PICTURES"], "an odd and an even count"),
        (["--rig"], "needs a cell file"),
        (["--rig", "--images", "EMPTY", "--board", "9x6", "--pitch", "0.02"], "a folder a camera"),
        (["--rig", "--images", "PICTURES"], "needs --board"),
        (
            ["--rig", "--images", "PICTURES", "--board", "9x6", "--pitch", "0.02"],
            "none of the 1 pictures of camera",
        ),
        ([], "CELL is needed"),
    ],
)
def test_what_is_missing_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("left", "right"):
        (tmp_path / "pictures" / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "pictures" / name / "1.png"), np.full((480, 640), 128, dtype=np.uint8))
    places = {"PICTURES": str(tmp_path / "pictures"), "EMPTY": str(tmp_path / "empty")}
    assert cli.invoke(["calibrate", *(places.get(one, one) for one in arguments)]) != 0
    assert said in capsys.readouterr().err
