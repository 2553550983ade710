"""Straight edges of a part without markers: the detector's contract, accuracy against rendered truth, part files, and
what it is shown that is not the part.
"""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.contracts import DetectorContract
from stereoservo_drivers.edges import EdgeDetector, crossing, load_part, measure_lines, take_profiles
from stereoservo_sim.world.body import part_text
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, solid_cell

CELL = solid_cell()
FIRST = int(CELL.body.ids[0])


def truth_of(cell, q, name="left"):
    return dict(zip(cell.body.ids.tolist(), map(tuple, cell.truth_pixels(q)[name].tolist()), strict=True))


def detector_in(folder, start=None, name="left", **options):
    truth = truth_of(CELL, CELL.base, name)
    start = {marker: (round(u), round(v)) for marker, (u, v) in truth.items()} if start is None else start
    (folder / "wedge.part").write_text(part_text(CELL.body, {name: start}))
    context = DriverContext(VirtualClock(), "edges", folder, folder, name)
    return EdgeDetector({"part": "wedge.part", **options}, context)


def picture(q=CELL.base, cell=CELL, name="left", seed=1, blur=0.7, noise=2.0, background="arm"):
    settings = RenderSettings(blur, noise, background)
    return Renderer(cell, cell.camera(name), settings).render(q, np.random.default_rng(seed))


def frame_of(image, seq=1):
    return Frame("left", seq, seq * 33_000_000, seq * 33_000_000, image)


def prior_of(frame, truth, off=0.0, sigma=0.3):
    k = len(truth)
    return Prior(
        frame.camera, frame.t_shutter_ns, np.array(list(truth)), np.array(list(truth.values())) + off,
        np.zeros((k, 2)), np.tile(sigma**2 * np.eye(2), (k, 1, 1)),
    )  # fmt: skip


class TestEdgeDetector(DetectorContract):
    accuracy_px = 0.5
    least_markers = 8

    def make_detector(self, context):
        (context.cell_dir / "wedge.part").write_text(part_text(CELL.body, {"left": truth_of(CELL, CELL.base)}))
        return EdgeDetector({"part": "wedge.part"}, context)

    def make_scene(self):
        return picture(), truth_of(CELL, CELL.base)


def test_vertices_are_where_they_are_and_as_sure_as_they_say(tmp_path):
    """Over lights, blurs, noises and postures before an even background; every vertex beside the truth."""
    rng = np.random.default_rng(4)
    detector, squares, away = detector_in(tmp_path), [], []
    for k in range(24):
        light = rng.normal(size=3) * 0.5 + CELL.body.light
        cell = replace(CELL, body=replace(CELL.body, light=light))
        q = (CELL.base if k % 2 else DEMO_GOALS["near"]) + rng.uniform(-0.15, 0.15, 6)
        image = picture(q, cell, seed=k, blur=rng.uniform(0.5, 1.2), noise=rng.uniform(1, 4), background="plain")
        truth = truth_of(cell, q)
        frame = frame_of(image, k + 1)
        found = detector.detect(frame, prior_of(frame, truth, rng.normal(0, 0.3, (len(truth), 2))))
        errors = found.pixels - np.array([truth[m] for m in found.ids.tolist()]).reshape(-1, 2)
        away += np.linalg.norm(errors, axis=1).tolist()
        squares += np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found.covariances), errors).tolist()
    assert len(away) > 120
    assert np.median(away) < 0.1
    assert np.percentile(away, 98) < 0.6
    assert 0.4 < np.mean(squares) / 2.0 < 1.6  # normalised estimation error squared, a degree of freedom


def test_a_moving_part_is_followed_without_a_prior(tmp_path):
    detector = detector_in(tmp_path)
    for k in range(12):
        q = CELL.base + 0.01 * k
        found = detector.detect(frame_of(picture(q, seed=k), k + 1), None)
        truth, sigmas = truth_of(CELL, q), np.sqrt(found.covariances.trace(axis1=1, axis2=2))
        assert len(found.ids) >= 5
        for marker, pixel, sigma in zip(found.ids.tolist(), found.pixels, sigmas, strict=True):
            assert np.linalg.norm(pixel - truth[marker]) < 5.0 * sigma + 0.3


def test_hidden_edges_are_not_taken_for_others(tmp_path):
    """A dark bar before a third of the part: what is reported is right, and why the rest is not is told."""
    image, truth = picture(), truth_of(CELL, CELL.base)
    middle = np.mean(list(truth.values()), axis=0)
    left = int(middle[0] + 15)
    image[:, left:] = 60
    detector = detector_in(tmp_path)
    found = detector.detect(frame_of(image), None)
    for marker, pixel in zip(found.ids.tolist(), found.pixels, strict=True):
        assert np.linalg.norm(pixel - truth[marker]) < 0.6
    assert all(isinstance(reason, str) and reason for reason in detector.refused.values())
    assert detector.refused


@pytest.mark.parametrize("what", ["mirrored", "one edge", "faint", "other part", "half out"])
def test_what_is_not_the_part_is_not_reported(tmp_path, what):
    image = picture()
    if what == "mirrored":
        image = np.ascontiguousarray(image[:, ::-1])
    elif what == "one edge":
        image = np.full_like(image, 60)
        image[:, 300:] = 180
    elif what == "faint":
        image = (100 + 0.02 * (image.astype(float) - 100)).astype(np.uint8)
    elif what == "other part":
        image = np.full_like(image, 90)
        cv2.rectangle(image, (270, 180), (370, 290), 200, -1)
    else:
        image = np.roll(image, 330, axis=1)
        image[:, :330] = 90
    found = detector_in(tmp_path).detect(frame_of(image), None)
    assert len(found.ids) == 0


def test_huge_noise_gives_nothing_or_what_is_right(tmp_path):
    rng, truth = np.random.default_rng(6), truth_of(CELL, CELL.base)
    detector = detector_in(tmp_path)
    for k in range(5):
        noisy = picture(seed=k).astype(float) + rng.normal(0, 60, (480, 640))
        found = detector.detect(frame_of(np.clip(noisy, 0, 255).astype(np.uint8), k + 1), None)
        sigmas = np.sqrt(found.covariances.trace(axis1=1, axis2=2))
        for marker, pixel, sigma in zip(found.ids.tolist(), found.pixels, sigmas, strict=True):
            assert np.linalg.norm(pixel - truth[marker]) < 6.0 * sigma + 0.5


def test_a_line_is_measured_within_its_covariance_and_parallel_ones_have_no_crossing():
    """An exact slanted step, blurred, with noise; its offset and tilt over 200 pictures."""
    rng, normalised = np.random.default_rng(8), []
    v, u = np.mgrid[0:80, 0:120].astype(float)
    for _ in range(200):
        tilt, offset = rng.uniform(-0.2, 0.2), rng.uniform(-1.0, 1.0)
        distance = (v - 40.0 - offset - tilt * (u - 60.0)) / np.hypot(1.0, tilt)
        clean = 60.0 + 80.0 / (1.0 + np.exp(-1.7 * distance / 0.8))
        image = (clean + rng.normal(0, 3.0, clean.shape)).astype(np.float32)
        middle = 40.0 + 0.5 * offset
        ends = np.array([[[20.0, middle], [100.0, middle]]])
        profiles = take_profiles(image, ends, np.array([0]), ends, 12.0, 4.0)
        lines = measure_lines(profiles, ends, np.array([0]), 2.5, coarse=True)
        there = np.array([60.0, 40.0 + offset])
        n, c = lines[0].equation()
        normalised.append((n @ there - c) / np.sqrt(lines[0].variance(there)))
    assert 0.6 < np.std(normalised) < 1.2
    assert abs(np.mean(normalised)) < 0.3
    _, covariance, _ = crossing([lines[0], lines[0]], 0.02)
    assert not np.isfinite(covariance).any() or np.trace(covariance) > 1e3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("[[face]]", "[[fase]]"), "fase"),
        (lambda t: t[: len(t) // 2].rstrip()[:-1] + "[", "TOML"),
        (lambda t: t.replace(f"id = {FIRST}\n", f"id = {FIRST + 1}\n"), "twice"),
        (lambda t: re.sub(r"vertices = \[\d+", "vertices = [7", t, count=1), "no vertex 7"),
        (lambda t: t.replace("at = [", "at = [9.0, 0.0, 0.0]  # ", 1), "plane"),
        (lambda t: t.replace("[start.left]", "[start.right]"), "start.left is missing"),
        (lambda t: t[: t.index("[start.left]") + 12] + f"\n{FIRST} = [1.0, 2.0]\n", "names 1 vertices"),
        (lambda t: t + "999 = [3.0, 4.0]\n", "no vertex 999"),
        (lambda t: t.replace(f"\n{FIRST} = [", f"\n{FIRST} = [nan, ", 1), "start"),
    ],
)  # fmt: skip
def test_a_broken_part_file_is_refused_with_its_name_and_what_is_valid(tmp_path, change, said):
    text = part_text(CELL.body, {"left": truth_of(CELL, CELL.base)})
    (tmp_path / "wedge.part").write_text(change(text))
    with pytest.raises(DriverError, match=r"wedge\.part") as caught:
        load_part(tmp_path / "wedge.part", "left")
    assert caught.value.code == "part"
    assert said in str(caught.value)


def test_no_part_file_and_wrong_options_are_refused(tmp_path):
    context = DriverContext(VirtualClock(), "edges", tmp_path, tmp_path, "left")
    with pytest.raises(DriverError, match=r"none\.part.*cannot be read"):
        EdgeDetector({"part": "none.part"}, context)
    with pytest.raises(DriverError, match="part is missing"):
        EdgeDetector({}, context)
    (tmp_path / "bytes.part").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DriverError, match="no TOML"):
        EdgeDetector({"part": "bytes.part"}, context)


def test_a_part_that_is_not_convex_is_refused(tmp_path):
    body = replace(CELL.body, vertices=CELL.body.vertices.copy())
    inner = np.add(body.vertices[5:].mean(axis=0), (0.0, 0.0, 0.05))
    text = part_text(body, {"left": truth_of(CELL, CELL.base)})
    text = f"[[vertex]]\nid = 900\nat = {inner.tolist()}\n" + text.replace("schema = 1\n", "")
    (tmp_path / "bent.part").write_text(text)
    with pytest.raises(DriverError, match="only convex parts"):
        load_part(tmp_path / "bent.part", "left")
