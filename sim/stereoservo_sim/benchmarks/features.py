"""``bench features``: duration of dot detection on simulated images (tracking, acquisition), with OpenCV labelling
as a baseline; detection rate and accuracy under light, lens, sensor and clutter effects; CPU time and corner accuracy
of the detector `aruco` on twelve tags, with and without a prior, beside OpenCV's own detector.

Synthetic images are of the default faces, with known dot centres. A dot is an ellipse drawn by area coverage on a grid
of FINE points a pixel, blurred there as by a lens (before pixel sampling), lit, and then noise and quantisation are
applied.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import CameraObservation, Frame, Prior
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.detectors.tag_registration import dictionary, tag_cells
from stereoservo_sim.benchmarks.timing import summary, timed
from stereoservo_sim.experiments.textured import context_of, prior_at
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.summaries import wilson
from stereoservo_sim.world.coverage import blend_ellipse, blend_polygon
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import demo_cell

FINE = 4
WIDTH, HEIGHT, FOCAL = 640, 480, 1000.0
BLACK, WHITE = 30.0, 220.0
CLEAR_PX = 6.0
"""Least gap between clutter and a face's dots; clutter that touches dots occludes them, which is a separate test."""


@dataclass(frozen=True)
class Conditions:
    """Conditions of an image.

    ``tilt``: largest [deg]; ``distance`` [m] between two bounds; ``blur`` [px]; ``noise`` [grey levels]; ``gradient``:
    share of the light lost from the left border to the right; ``clutter``: dots; ``banding``: amplitude over
    ``band_rows`` rows; ``shot``: variance per grey level [levels]; ``gain`` of the light between two bounds (255 is
    white); ``cut``: depth to which a dark edge covers one dot of each face [px]; ``jpeg``: quality (0: none);
    ``motion`` [px]. ``drawn``: blur, noise, gradient and clutter of each image are uniform between none and these.
    """

    tilt: float = 50.0
    distance: tuple[float, float] = (1.6, 1.6)
    blur: float = 0.7
    noise: float = 2.0
    gradient: float = 0.0
    clutter: int = 0
    banding: float = 0.0
    band_rows: float = 144.0
    shot: float = 0.0
    gain: tuple[float, float] = (1.0, 1.0)
    cut: float = 0.0
    jpeg: int = 0
    motion: float = 0.0
    drawn: bool = False

    def of_a_picture(self, rng: np.random.Generator) -> Conditions:
        """The conditions of one image."""
        if not self.drawn:
            return self
        blur, noise, gradient = rng.uniform(0.0, 1.0, 3) * (self.blur, self.noise, self.gradient)
        return replace(self, blur=blur, noise=noise, gradient=gradient, clutter=int(rng.integers(self.clutter + 1)))


def look(tilt: float, azimuth: float, roll: float, distance: float, at: FloatArray) -> FloatArray:
    """Homography (3, 3) of a plane [m] whose origin is imaged at pixel ``at`` from ``distance`` [m]; angles [rad]."""
    K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    H: FloatArray = K @ np.column_stack([R[:, :2], distance * np.linalg.solve(K, np.append(at, 1.0))])
    return H


def project(H: FloatArray, points: FloatArray) -> FloatArray:
    """Project points (n, 2) of the plane to pixels (n, 2)."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ H.T
    pixels: FloatArray = homogeneous[:, :2] / homogeneous[:, 2:]
    return pixels


def circle_conic(H: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Conic (3, 3), negative inside, of a circle of the plane under ``H``."""
    x, y = centre
    inverse = np.linalg.inv(H)
    conic: FloatArray = (
        inverse.T @ np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius * radius]]) @ inverse
    )
    return conic * np.sign(conic[0, 0])


def random_picture(conditions: Conditions, rng: np.random.Generator) -> tuple[ImageArray, FloatArray]:
    """An image (HEIGHT, WIDTH) with both faces side by side and its dots' centres (14, 2) [px]."""
    conditions = conditions.of_a_picture(rng)
    z = rng.uniform(*conditions.distance)
    image = np.full((HEIGHT, WIDTH), BLACK, np.float32)
    truth, conics = [], []
    for f, face in enumerate(DEFAULT_BODY):
        at = np.array([180.0 + 280.0 * f, 240.0]) + rng.uniform(-1.0, 1.0, 2) * (20.0, 60.0)
        tilt = np.radians(rng.uniform(0.0, conditions.tilt))
        azimuth, roll = rng.uniform(0.0, 2.0 * np.pi, 2)
        H = look(tilt, azimuth, roll, z, at)
        half = face.half_side
        corners = project(H, np.array([[-half, -half], [half, -half], [half, half], [-half, half]]))
        blend_polygon(image, corners, BLACK - 10.0)
        truth.append(project(H, face.positions))
        conics += [circle_conic(H, position, face.radius) for position in face.positions]
    pixels = np.concatenate(truth)
    conics += _clutter(conditions.clutter, 8.0 / z, pixels, rng)
    coverage = np.zeros((HEIGHT, WIDTH), np.float32)
    for conic in conics:
        add_ellipse(coverage, conic, conditions.blur)
    image += (WHITE - image) * np.minimum(coverage, 1.0)
    if conditions.cut:
        for f in range(len(DEFAULT_BODY)):
            _cover(image, conics[7 * f + int(rng.integers(7))], conditions, rng)
    return _as_taken(image, conditions, rng), pixels


def _clutter(count: int, radius: float, pixels: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
    """Conics of round dots of about ``radius`` [px] near those of the faces."""
    conics: list[FloatArray] = []
    while len(conics) < count:
        centre = pixels[rng.integers(len(pixels))] + rng.uniform(-90.0, 90.0, 2)
        own = radius * rng.uniform(0.6, 1.3)
        if np.hypot(*(pixels - centre).T).min() >= radius + own + CLEAR_PX:
            conics.append(circle_conic(np.eye(3), centre, own))
    return conics


def add_ellipse(coverage: npt.NDArray[np.float32], conic: FloatArray, blur: float) -> None:
    """Add an ellipse's coverage, blurred before it is sampled."""
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    half = np.sqrt(np.diag(np.linalg.inv(conic[:2, :2])) * level) + 5.0 * blur + 1.0
    u0, v0 = np.floor(centre - half).astype(int)
    u1, v1 = np.ceil(centre + half).astype(int) + 1
    # fine point i of the patch is at u0 - 1/2 + (i + 1/2) / FINE
    start = 0.5 / FINE - 0.5
    to_pixels = np.array([[1 / FINE, 0, u0 + start], [0, 1 / FINE, v0 + start], [0, 0, 1]])
    fine = np.zeros(((v1 - v0) * FINE, (u1 - u0) * FINE), np.float32)
    blend_ellipse(fine, to_pixels.T @ conic @ to_pixels, 1.0)
    if blur:
        fine = cv2.GaussianBlur(fine, (0, 0), blur * FINE).astype(np.float32)
    patch = fine.reshape(v1 - v0, FINE, u1 - u0, FINE).mean(axis=(1, 3))
    a, b, c, d = max(u0, 0), min(u1, WIDTH), max(v0, 0), min(v1, HEIGHT)
    if a < b and c < d:
        coverage[c:d, a:b] += patch[c - v0 : d - v0, a - u0 : b - u0]


def _cover(image: npt.NDArray[np.float32], conic: FloatArray, conditions: Conditions, rng: np.random.Generator) -> None:
    """Cover an ellipse from one side, to the depth of the cut, by a dark area with an edge as blurred as the dots'."""
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    n = np.array([np.cos(angle), np.sin(angle)])
    half = float(np.sqrt(n @ np.linalg.solve(conic[:2, :2], n) * level))
    u0, v0 = np.maximum(np.floor(centre - half - 20).astype(int), 0)
    v, u = np.mgrid[v0 : v0 + int(2 * half) + 41, u0 : u0 + int(2 * half) + 41]
    beyond = (u - centre[0]) * n[0] + (v - centre[1]) * n[1] - half + conditions.cut
    aside = (v - centre[1]) * n[0] - (u - centre[0]) * n[1]
    across = float(np.sqrt(n[::-1] * (-1, 1) @ np.linalg.solve(conic[:2, :2], n[::-1] * (-1, 1)) * level))
    # only about this dot
    near = (np.abs(beyond) < conditions.cut + 3.0 + 3.0 * conditions.blur) & (np.abs(aside) < across + 3.0)
    share = ndtr(beyond / np.hypot(conditions.blur, 0.29)) * near
    patch = image[v0 : v0 + share.shape[0], u0 : u0 + share.shape[1]]
    patch += (BLACK - 10.0 - patch) * share[: patch.shape[0], : patch.shape[1]]


def _as_taken(image: npt.NDArray[np.float32], conditions: Conditions, rng: np.random.Generator) -> ImageArray:
    """Apply light, motion blur, noise, quantisation and compression."""
    if conditions.gradient:
        image *= 1.0 - conditions.gradient * np.arange(WIDTH, dtype=np.float32) / (WIDTH - 1)
    if conditions.banding:
        phase = 2.0 * np.pi * (np.arange(HEIGHT) / conditions.band_rows + rng.uniform())
        image *= (1.0 + conditions.banding * np.sin(phase)).astype(np.float32)[:, None]
    image *= np.float32(rng.uniform(*conditions.gain))
    if conditions.motion:
        image = _moved(image, conditions.motion, rng.uniform(0.0, np.pi))
    variance = conditions.noise**2 + conditions.shot * image
    noisy = image + np.sqrt(variance) * rng.standard_normal(image.shape, np.float32)
    taken: ImageArray = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    if conditions.jpeg:
        packed = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, conditions.jpeg])[1]
        taken = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE).astype(np.uint8)
    return taken


def _moved(image: npt.NDArray[np.float32], length: float, angle: float) -> npt.NDArray[np.float32]:
    """The image with motion blur along a line, about its centre."""
    u, v = np.meshgrid(np.fft.rfftfreq(WIDTH), np.fft.fftfreq(HEIGHT))
    smear = np.sinc(length * (u * np.cos(angle) + v * np.sin(angle)))
    moved: npt.NDArray[np.float32] = np.fft.irfft2(np.fft.rfft2(image) * smear, image.shape).astype(np.float32)
    return moved


# -- detection rate and accuracy of dots -------------------------------------------------------------------------

NEAR = (0.8, 1.2)
"""Distances [m] at which a dot's diameter is 13 to 20 px; 1.6 m: 10 px."""
TESTED: dict[str, Conditions] = {
    "detection: up to all of it": Conditions(
        tilt=70.0, distance=NEAR, blur=1.5, noise=10.0, gradient=0.5, clutter=9, drawn=True
    ),
    "detection: all at once": Conditions(tilt=70.0, distance=NEAR, blur=1.5, noise=10.0, gradient=0.5, clutter=9),
    "detection: all at once, 10 px": Conditions(tilt=70.0, blur=1.5, noise=10.0, gradient=0.5, clutter=9),
    "detection: tilt 70, clutter": Conditions(tilt=70.0, distance=NEAR, clutter=9),
    "n0": Conditions(noise=0.0),
    "n2 b.7": Conditions(),
    "n5 b.7": Conditions(noise=5.0),
    "n10 b.7": Conditions(noise=10.0),
    "n2 b1.5": Conditions(blur=1.5),
    "n2 b.7 g50%": Conditions(gradient=0.5),
    "n5 b1.5 g50%": Conditions(noise=5.0, blur=1.5, gradient=0.5),
    "n0 g50%, near": Conditions(noise=0.0, gradient=0.5, distance=(0.8, 1.0)),
    "banding 20%": Conditions(banding=0.2),
    "light x 0.4 to 1.6": Conditions(gain=(0.4, 1.6)),
    "white clipped": Conditions(gain=(1.3, 1.8)),
    "shot noise": Conditions(noise=1.0, shot=0.2),
    "motion 5 px": Conditions(motion=5.0),
    "cut 0.3 px": Conditions(cut=0.3),
    "cut 1 px": Conditions(cut=1.0),
    "jpeg 95": Conditions(jpeg=95),
    "jpeg 75": Conditions(jpeg=75),
    "jpeg 50": Conditions(jpeg=50),
}
"""Default: dots of 10 px, tilts to 50 degrees, 2 grey levels of noise, 0.7 px of blur."""
REFERENCE_PX = {
    "n0": 0.011,
    "n2 b.7": 0.013,
    "n5 b.7": 0.023,
    "n10 b.7": 0.041,
    "n2 b1.5": 0.017,
    "n2 b.7 g50%": 0.017,
    "n5 b1.5 g50%": 0.035,
}
"""Errors of thresholded components with weighted centroids (OpenCV), measured on such images beforehand."""
WRONG_PX = 2.0
"""A dot reported farther than this from its true position has a wrong id."""
TRACKED_DOTS = 4


@dataclass
class _Tally:
    """Counts of one row's images, for one mode of detection."""

    faces: int = 0
    dots: int = 0
    wrong: int = 0
    frames: int = 0
    found: int = 0
    errors: list[FloatArray] = field(default_factory=list)
    squares: list[FloatArray] = field(default_factory=list)

    def add(self, observation: CameraObservation, truth: FloatArray) -> None:
        errors = observation.pixels - truth[observation.ids]
        seen = [int(np.isin(face.ids, observation.ids).sum()) for face in DEFAULT_BODY]
        faces = sum(count >= TRACKED_DOTS for count in seen)
        self.frames += 1
        self.faces += faces
        self.found += faces == len(seen)
        self.dots += len(errors)
        self.wrong += int((np.hypot(*errors.T) > WRONG_PX).sum())
        self.errors.append(errors)
        self.squares.append(
            np.sum(errors * np.linalg.solve(observation.covariances, errors[:, :, None])[:, :, 0], axis=1)
        )

    def row(self) -> dict[str, Any]:
        errors, squares = np.concatenate(self.errors), np.concatenate(self.squares)
        low, high = wilson(self.found, self.frames)
        face_low, face_high = wilson(self.faces, len(DEFAULT_BODY) * self.frames)
        share, most_wrong = wilson(self.wrong, max(self.dots, 1))
        figures: dict[str, Any] = {
            "frames": self.frames,
            "all_faces": self.found,
            "all_faces_wilson_95": [low, high],
            "faces": self.faces,
            "faces_wilson_95": [face_low, face_high],
            "dots": self.dots,
            "wrong_ids": self.wrong,
            "wrong_ids_wilson_95": [share, most_wrong],
        }
        if self.dots:
            figures["rms_px"] = float(np.sqrt(np.mean(errors**2)))
            figures["bias_px"] = [float(x) for x in errors.mean(axis=0)]
            figures["max_px"] = float(np.abs(errors).max())
            figures["chi2_per_freedom"] = float(squares.mean() / 2.0)
            figures["beyond_chi2_0.999"] = float(np.mean(squares > -2.0 * np.log(0.001)))
        return figures


def robustness(
    detector: DotDetector, pictures: int, seed: int, progress: ProgressCall, rows: dict[str, Conditions] = TESTED
) -> list[dict[str, Any]]:
    """A row for each of the conditions, by acquisition (no prior) and by tracking (a prior some 1 px off).

    Each uses the same number of random images. A face counts as found with four correct dots or more, a frame with all
    its faces.
    """
    table = []
    for at, (name, conditions) in enumerate(rows.items()):
        rng = np.random.default_rng([seed, at])
        acquired, tracked = _Tally(), _Tally()
        for k in range(pictures):
            image, truth = random_picture(conditions, rng)
            frame = Frame("bench", k, 1_000_000_000, 1_000_000_000, image)
            off = rng.normal(0.0, 1.0, 2) + rng.normal(0.0, 0.3, truth.shape)
            prior = prior_at("bench", frame.t_shutter_ns, np.arange(len(truth)), truth + off, 1.1)
            acquired.add(detector.detect(frame, None), truth)
            tracked.add(detector.detect(frame, prior), truth)
        row: dict[str, Any] = {"conditions": name, "acquired": acquired.row(), "tracked": tracked.row()}
        if name in REFERENCE_PX and tracked.dots:
            row["reference_px"] = REFERENCE_PX[name]
            row["rms_over_reference"] = row["tracked"]["rms_px"] / REFERENCE_PX[name]
        table.append(row)
        progress("robustness", at + 1, len(rows))
    return table


# -- tags ------------------------------------------------------------------------------------------------------

DICTIONARY = "36h11"
TAG_COLUMNS, TAG_ROWS = 4, 3
SIDE_PX, TILT_DEG = 80.0, 50.0


WALL, TAG_WHITE, TAG_BLACK, BLUR_PX, TAG_NOISE = 110.0, 215.0, 30.0, 0.7, 2.0
PRIOR_PX = 0.7
"""Standard deviation of the prior, and its offset."""
TAG_IMAGES = 4


def _tag_view(rng: np.random.Generator, at: FloatArray) -> FloatArray:
    """Homography from a tag's unit square to pixels: 1 m from a camera of 1000 px, tilted and rotated at random."""
    tilt, azimuth, roll = np.radians(rng.uniform(0, TILT_DEG)), *rng.uniform(0, 2 * np.pi, 2)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    side = SIDE_PX / 1000.0
    plane = np.column_stack([R[:, 0] * side, R[:, 1] * side, -(R[:, 0] + R[:, 1]) * side / 2 + [0, 0, 1]])
    return np.asarray(np.array([[1000.0, 0, at[0]], [0, 1000.0, at[1]], [0, 0, 1]]) @ plane)


def tag_picture(rng: np.random.Generator) -> tuple[ImageArray, FloatArray]:
    """An image of 640x480 of tags 0 to 11, and their corners (48, 2) [px]."""
    image, corners = tag_scene(rng)
    image = image + rng.normal(0.0, TAG_NOISE, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), corners


def tag_scene(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The same before the sensor: grey levels (480, 640), and the corners."""
    fine = np.full((480 * FINE, 640 * FINE), WALL, np.float32)
    to_fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    corners = []
    for k in range(TAG_COLUMNS * TAG_ROWS):
        at = np.array([90.0 + 153 * (k % TAG_COLUMNS), 85.0 + 155 * (k // TAG_COLUMNS)]) + rng.uniform(-8, 8, 2)
        H = _tag_view(rng, at)
        cells = np.pad(1.0 - tag_cells(DICTIONARY, k), 1, constant_values=1.0)
        n, scale = len(cells) - 2, 16
        printed = np.kron(TAG_BLACK + (TAG_WHITE - TAG_BLACK) * cells, np.ones((scale, scale))).astype(np.float32)
        from_print = np.array([[1, 0, 0.5 - scale], [0, 1, 0.5 - scale], [0, 0, n * scale]]) / (n * scale)
        cv2.warpPerspective(
            printed, to_fine @ H @ from_print, fine.shape[::-1], fine, cv2.INTER_NEAREST, cv2.BORDER_TRANSPARENT
        )
        square = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]) @ H.T
        corners.append(square[:, :2] / square[:, 2:])
    fine = cv2.GaussianBlur(fine, (0, 0), BLUR_PX * FINE)
    image = np.asarray(cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA), dtype=np.float64)
    return image, np.concatenate(corners)


def tags(repetitions: int, seed: int) -> dict[str, Any]:
    """CPU ms an image with a prior, without, and of OpenCV's detector; corners' rms error [px]; share found."""
    rng = np.random.default_rng(seed)
    ids = np.arange(4 * TAG_COLUMNS * TAG_ROWS)
    detector = TagDetector({"tags": list(range(TAG_COLUMNS * TAG_ROWS)), "dictionary": DICTIONARY}, context_of("left"))
    peer = cv2.aruco.ArucoDetector(dictionary(DICTIONARY))
    frames, priors, errors = [], [], []
    for k in range(TAG_IMAGES):
        image, truth = tag_picture(rng)
        frames.append(Frame("left", k, 1_000_000_000, 1_004_000_000, image))
        off = truth + rng.normal(0.0, PRIOR_PX, truth.shape)
        priors.append(prior_at("left", 1_000_000_000, ids, off, PRIOR_PX**2))
        for prior in (None, priors[-1]):
            seen = detector.detect(frames[-1], prior)
            errors.append(seen.pixels - truth[seen.ids])
    count = 10 * repetitions
    times = {
        "prior": timed(lambda k: detector.detect(frames[k % TAG_IMAGES], priors[k % TAG_IMAGES]), count)[1],
        "cold": timed(lambda k: detector.detect(frames[k % TAG_IMAGES], None), count)[1],
        "cv2_aruco": timed(lambda k: peer.detectMarkers(frames[k % TAG_IMAGES].image), count)[1],
    }
    return {
        "tags": TAG_COLUMNS * TAG_ROWS,
        "corners_found": len(np.concatenate(errors)) / (2 * TAG_IMAGES * len(ids)),
        "rms_px": float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
        "cpu_ms": {name: summary(samples, 1e3) for name, samples in times.items()},
    }


# -- duration --------------------------------------------------------------------------------------------------

IMAGES = 8
"""Number of images, used in turn."""
FOUR = (0, 1, 2, 3)
"""The corners of the first face: tracked dots when two cameras see four dots each."""
OFF_PX = (0.4, -0.3)
"""Offset of their prior, equal for all four, since they are checked against it."""


class Pictures(NamedTuple):
    """A detector and its inputs: frames, priors of all their dots, priors of four."""

    detector: DotDetector
    frames: list[Frame]
    priors: list[Prior]
    fours: list[Prior]

    def cold(self, k: int) -> CameraObservation:
        """Detect in image ``k`` (cyclic) without a prior."""
        return self.detector.detect(self.frames[k % IMAGES], None)

    def track(self, k: int) -> CameraObservation:
        """Detect in image ``k`` with a prior of all its dots."""
        return self.detector.detect(self.frames[k % IMAGES], self.priors[k % IMAGES])

    def track_two(self, k: int) -> list[CameraObservation]:
        """Detect in images ``k`` and ``k`` + 1 with priors of four dots."""
        return [self.detector.detect(self.frames[i % IMAGES], self.fours[i % IMAGES]) for i in (k, k + 1)]

    def label(self, k: int) -> int:
        """OpenCV's number of components of image ``k``: the baseline."""
        _, binary = cv2.threshold(self.frames[k % IMAGES].image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        return int(cv2.connectedComponents(binary)[0])


def pictures(seed: int, progress: ProgressCall) -> Pictures:
    """IMAGES images of the demo's cell."""
    rng = np.random.default_rng(seed)
    cell = demo_cell()
    camera = cell.rig.cameras[0]
    renderer = Renderer(cell, camera, RenderSettings())
    frames, priors, fours = [], [], []
    detector = DotDetector({}, context_of(camera.name))
    for k in range(IMAGES):
        q = cell.base + rng.uniform(-0.1, 0.1, len(cell.base))
        frames.append(Frame(camera.name, k, 1_000_000_000, 1_004_000_000, renderer.render(q, rng)))
        seen = detector.detect(frames[-1], None)
        off = rng.normal(0.0, 0.5, seen.pixels.shape)
        at = camera.name, frames[-1].t_shutter_ns
        priors.append(prior_at(*at, seen.ids, seen.pixels + off, 1.0))
        rows = np.flatnonzero(np.isin(seen.ids, FOUR))
        fours.append(prior_at(*at, seen.ids[rows], seen.pixels[rows] + OFF_PX, 1.0))
        progress("pictures", k + 1, IMAGES)
    return Pictures(detector, frames, priors, fours)


def run_features(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Milliseconds per image of 640x480: search without a prior, windows at a prior of 14 dots, two images at priors of
    four, one labelling pass.

    Also the detection rate and accuracy in four images a repetition for each of the conditions of ``robustness``; and
    twelve tags.
    """
    shown = pictures(seed, progress)
    count = max(100, 20 * repetitions)
    found = [len(prior.ids) for prior in shown.priors]
    times = {
        "cold": timed(shown.cold, count)[0],
        "tracking": timed(shown.track, count)[0],
        "tracking_2x4": timed(shown.track_two, count)[0],
        "cv2_threshold_and_connected_components": timed(shown.label, count)[0],
    }
    medians = {name: float(np.median(samples)) for name, samples in times.items()}
    baseline = medians["cv2_threshold_and_connected_components"]
    height, width = shown.frames[0].image.shape
    return {
        "image": [width, height],
        "dots_found": {"least": min(found), "most": max(found)},
        "ms": {name: summary(samples, 1e3) for name, samples in times.items()},
        "cold_over_baseline": medians["cold"] / baseline,
        "tracking_over_baseline": medians["tracking"] / baseline,
        "tracking_2x4_over_baseline": medians["tracking_2x4"] / baseline,
        "tags": tags(repetitions, seed),
        "robustness": robustness(shown.detector, 4 * repetitions, seed, progress),
    }
