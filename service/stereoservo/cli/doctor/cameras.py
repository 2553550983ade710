"""Examination of the cameras for ``stereoservo doctor``: opens them, records detections for some seconds, collects the
findings, and writes annotated pictures.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import pairwise, permutations, product
from pathlib import Path

import cv2
import msgspec
import numpy as np

from stereoservo.cli.doctor.camera_findings import (
    CameraRecord,
    examine_record,
    examine_skew,
    marker_scatter,
    mean_observations,
    near_border,
)
from stereoservo.cli.doctor.plate_motion import examine_sides
from stereoservo.core.settings import CoreSettings, TrialSettings
from stereoservo.daemon.camera_setup import make_camera
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.geometry.cameras import project_many, triangulate
from stereoservo.geometry.distortion import distort, undistort
from stereoservo.geometry.fundamental import epipolar_distances, fundamental_robust
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CameraModel, CellModel
from stereoservo.messages.locks import AlreadyRunningError, ChannelLock, hardware_lock_path, holder
from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import (
    CameraDriver,
    CameraObservation,
    CameraStatistics,
    CountingCameraDriver,
    Detector,
    DriverError,
    ExaminationFinding,
    ExplainingDetector,
    Frame,
)

SAME_REMEDY = "camera.options of one of them: each camera has its own"
FIRST_FRAME_S = 6.0
"""Time limit for a camera's first frame [s]."""
POLL_S = 0.002
DEFAULT_MARKERS = 4
GREEN, RED = (0, 200, 0), (0, 0, 230)


class WatchedCamera:
    """An open camera, whose frames are searched for markers and recorded."""

    def __init__(self, record: CameraRecord, driver: CameraDriver, detector: Detector | None) -> None:
        self.record = record
        self._driver = driver
        self._detector = detector
        self._began: CameraStatistics | None = None
        self._began_s = time.monotonic()

    def poll(self) -> None:
        """Process the frames that arrived; an error ends the observation of this camera, not of the others."""
        if self.record.error:
            return
        try:
            arrived = self._driver.poll()
            if not arrived:
                return
            newest = arrived[-1]
            if isinstance(newest, Frame):
                self.record.frame = newest
                assert self._detector is not None  # `describe_camera` has checked it
                newest = self._detector.detect(newest, None)
            assert isinstance(newest, CameraObservation)
            self.record.seen.append(newest)
        except DriverError as error:
            self.record.error = str(error)

    def begin(self) -> None:
        """Discard the frames so far: first frames are late, kernels are compiled, cameras are opened one after the
        other.
        """
        self.record.seen.clear()
        self._began = self._counts()
        self._began_s = time.monotonic()

    def _counts(self) -> CameraStatistics | None:
        return self._driver.statistics() if isinstance(self._driver, CountingCameraDriver) else None

    def finish(self) -> None:
        """Set the final counts and, if nothing was found, search the mirror image. Releases the camera."""
        now = self._counts()
        if now is not None:
            before = self._began or CameraStatistics()
            self.record.statistics = CameraStatistics(
                frames=now.frames - before.frames,
                dropped=now.dropped - before.dropped,
                frozen=now.frozen - before.frozen,
                reconnects=now.reconnects - before.reconnects,
                settings=now.settings,
                server_clock=now.server_clock,
            )
            self.record.watched_s = time.monotonic() - self._began_s
        frame = self.record.frame
        none = not any(o.ids.size for o in self.record.seen)
        if isinstance(self._detector, ExplainingDetector):
            self.record.refused = dict(self._detector.refused)
        if frame is not None and self._detector is not None and none and not self.record.error:
            mirror = msgspec.structs.replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]))
            self.record.flipped = int(self._detector.detect(mirror, None).ids.size)
        try:
            self._driver.deactivate()
        finally:
            self._driver.close()


def examine_cameras(
    plan: RunPlan, settings: CoreSettings, model: CellModel | None, seconds: float, pictures: Path
) -> Iterator[ExaminationFinding]:
    """Findings on the cell's cameras; an image of each is written to ``pictures``. Skipped while another process uses
    them.
    """
    directories = plan.directories
    pid = holder(directories.daemon_lock)
    if pid is not None:
        yield ExaminationFinding("cameras", None, f"not examined: the daemon (process {pid}) has them", f"`kill {pid}`")
        return
    with ExitStack() as locks:
        try:
            twice = lock_cameras(plan, locks)
        except AlreadyRunningError as error:
            yield ExaminationFinding("cameras", None, f"not examined: {error}")
            return
        if twice:
            yield ExaminationFinding("cameras", False, twice, SAME_REMEDY)
            return
        records = watch_cameras(plan, seconds)
    min_markers = DEFAULT_MARKERS if settings.trials is None else settings.trials.min_markers
    for record in records:
        yield from examine_record(record, min_markers)
        if (finding := near_border(record)) is not None:
            yield finding
    yield from examine_skew(records)
    if (same := same_camera_twice(records)) is not None:
        yield same
    elif (sides := examine_sides(records)) is not None:
        yield sides
    yield from examine_views(records, model)
    if model is not None and settings.trials is not None:
        yield from examine_coverage(model, settings.trials, records)
    yield from _save_pictures(records, pictures)


def lock_cameras(plan: RunPlan, locks: ExitStack) -> str:
    """Take the locks of the cell's cameras as long as ``locks`` lasts; returns which two are the same camera, else ''.

    Raises AlreadyRunningError if another process holds one.
    """
    owners: dict[Path, str] = {}
    for section in plan.cell.camera:
        path = hardware_lock_path(plan.directories.runtime.parent, section.driver, section.options)
        if path is None:
            continue
        if path in owners:
            return f"{owners[path]!r} and {section.name!r} are one and the same camera"
        locks.enter_context(ChannelLock(path, f"camera {section.name!r}"))
        owners[path] = section.name
    return ""


def watch_cameras(plan: RunPlan, seconds: float) -> list[CameraRecord]:
    """Open all cameras, observe them for ``seconds`` from their first frames, release them."""
    clock = MonotonicClock()
    records, watched = [], []
    for section, description in zip(plan.cell.camera, plan.cameras, strict=True):
        record = CameraRecord(description)
        records.append(record)
        driver, detector = make_camera(section, plan.driver_context(clock, section))
        camera = WatchedCamera(record, driver, detector)
        watched.append(camera)
        try:
            driver.configure()
            driver.activate()
        except DriverError as error:
            record.error = str(error)
    try:
        give_up_ns = clock.now_ns() + int(FIRST_FRAME_S * 1e9)
        until_ns = 0
        while not until_ns or clock.now_ns() < until_ns:
            for camera in watched:
                camera.poll()
            everybody = all(record.seen or record.error for record in records)
            if not until_ns and (everybody or clock.now_ns() > give_up_ns):
                until_ns = clock.now_ns() + int(seconds * 1e9)
                for camera in watched:
                    camera.begin()
            time.sleep(POLL_S)
    finally:
        for camera in watched:
            camera.finish()
    return records


def annotated(image: ImageArray, observation: CameraObservation) -> ImageArray:
    """The image in colour with the detected markers: circles, ids, standard deviations enlarged a hundredfold."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for marker, (u, v), C in zip(observation.ids.tolist(), observation.pixels, observation.covariances, strict=True):
        centre = (round(u * 16), round(v * 16))
        sigma = float(np.sqrt(0.5 * np.trace(C)))
        cv2.circle(picture, centre, 16 * 9, GREEN, 1, cv2.LINE_AA, 4)
        cv2.circle(picture, centre, max(16, round(16 * 100 * sigma)), RED, 1, cv2.LINE_AA, 4)
        cv2.putText(
            picture, str(marker), (round(u) + 10, round(v) - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, GREEN, 1, cv2.LINE_AA
        )
    caption = f"{observation.camera}: {observation.ids.size} markers; red: 100 standard deviations"
    cv2.putText(picture, caption, (8, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, GREEN, 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def _save_pictures(records: list[CameraRecord], directory: Path) -> Iterator[ExaminationFinding]:
    saved = []
    for record in records:
        if record.frame is None or not record.seen:
            continue
        path = directory / f"{record.name}.png"
        try:
            directory.mkdir(parents=True, exist_ok=True)
            done, data = cv2.imencode(".png", annotated(record.frame.image, record.seen[-1]))
            if not done:
                raise OSError(f"{path}: the picture could not be encoded as PNG")
            path.write_bytes(data.tobytes())
        except OSError as error:
            yield ExaminationFinding("pictures", None, f"not saved: {error}", "--pictures DIR that can be written")
            return
        saved.append(str(path))
    if saved:
        yield ExaminationFinding(
            "pictures", True, "what each camera sees, and what was found in it: " + ", ".join(saved)
        )


# -- whether what it sees is one body ------------------------------------------------------------------------
# Checks of ``stereoservo doctor`` on pairs of cameras: whether simultaneous observations fit the cell's model or the
# epipolar constraint, and how much of the calibration motion lies inside the images.


FITS_PX = 0.5
"""Largest rms reprojection error of one point's views; above it the cameras are reported as moved."""
MATCHES = 10
"""Markers that two cameras must have in common to test the epipolar constraint: 7 of them determine it."""
AT_REST_PX = 1.0
"""Upper bound of the scatter of markers at rest: means over time are compared."""
WORKSPACE_SHARE = 0.9
SAME_PX = 0.5
"""Two cameras are the same if each shows every marker this close to its position in the other."""


def examine_views(records: Sequence[CameraRecord], model: CellModel | None) -> Iterator[ExaminationFinding]:
    """Findings on the simultaneous observations of pairs of cameras."""
    seen = [record for record in records if len(record.seen) >= 2]
    if len(seen) < 2:
        return
    moving = {record.name: scatter for record in seen if (scatter := marker_scatter(record) or 0.0) > AT_REST_PX}
    if moving:
        told = ", ".join(f"by {scatter:.1f} px in {name}" for name, scatter in moving.items())
        yield ExaminationFinding(
            "views " + "-".join(record.name for record in seen),
            None,
            f"the markers move meanwhile ({told}): views are compared where the arm stands",
        )
        return
    cameras = [] if model is None else [c for r in seen for c in model.cameras if c.name == r.name]
    if len(cameras) == len(seen):
        yield _by_model(seen, cameras)
        return
    for first, second in pairwise(seen):
        yield _by_epipolar(first, second)


def _common(records: Sequence[CameraRecord]) -> tuple[list[int], FloatArray]:
    """Markers seen by all cameras, and their raw pixels (c, k, 2)."""
    means = [mean_observations(record) for record in records]
    ids = sorted(set.intersection(*(set(found.tolist()) for found, _, _ in means)))
    pixels = [np.array([pixels[found.tolist().index(i)] for i in ids]).reshape(-1, 2) for found, pixels, _ in means]
    return ids, np.array(pixels)


def reprojection_rms(cameras: Sequence[CameraModel], pixels: FloatArray) -> float:
    """Rms reprojection error [px] per coordinate of triangulated points in raw pixels (c, k, 2); NaN if none."""
    Ps = np.array([camera.matrix for camera in cameras])
    ideal = np.array([undistort(camera.lens, p) for camera, p in zip(cameras, pixels, strict=True)])
    points = triangulate(Ps, ideal)
    raw = np.array([distort(camera.lens, m) for camera, m in zip(cameras, project_many(Ps, points), strict=True)])
    squares = (raw - pixels) ** 2
    free = squares[np.isfinite(squares)].size - 3 * int(np.isfinite(points[:, 0]).sum())
    return float(np.sqrt(np.nansum(squares) / free)) if free > 0 else float("nan")


def _by_model(records: Sequence[CameraRecord], cameras: Sequence[CameraModel]) -> ExaminationFinding:
    ids, pixels = _common(records)
    name = "views " + "-".join(record.name for record in records)
    if not ids:
        return ExaminationFinding(name, None, "no marker is seen by all of them at once: nothing to compare")
    rms = reprojection_rms(cameras, pixels)
    summary = f"{len(ids)} markers seen by all leave {rms:.3f} px by the model's cameras"
    if rms <= FITS_PX:
        return ExaminationFinding(name, True, summary)
    for order in permutations(range(len(cameras))):
        if order == tuple(range(len(cameras))):
            continue
        if reprojection_rms([cameras[k] for k in order], pixels) <= FITS_PX:
            swapped = ", ".join(
                f"{r.name!r} shows what {cameras[k].name!r} did"
                for r, k in zip(records, order, strict=True)
                if r.name != cameras[k].name
            )
            return ExaminationFinding(
                name, False, f"{summary}: {swapped}", "exchange their sources, or their cables; none has moved"
            )
    return ExaminationFinding(
        name,
        False,
        f"{summary}; {FITS_PX:g} is the limit for cameras that stand where they stood: one has moved or zoomed",
        "re-anchor it (the running daemon does, once it sees enough), or `stereoservo calibrate`",
    )


def _by_epipolar(first: CameraRecord, second: CameraRecord) -> ExaminationFinding:
    ids, pixels = _common([first, second])
    name = f"views {first.name}-{second.name}"
    if len(ids) < MATCHES:
        return ExaminationFinding(
            name, None, f"{len(ids)} markers are seen by both; the epipolar constraint needs {MATCHES} to say anything"
        )
    sigma = float(np.median(np.concatenate([mean_observations(first)[2], mean_observations(second)[2]])))
    try:
        F, inliers = fundamental_robust(pixels[0], pixels[1], max(sigma, 0.05))
    except GeometryError as error:
        return ExaminationFinding(name, None, f"no epipolar constraint yet: {error}")
    distances = epipolar_distances(F, pixels[0], pixels[1])
    rms = float(np.sqrt(np.mean(distances[inliers] ** 2)))
    summary = f"{int(inliers.sum())} of {len(ids)} markers agree on one epipolar geometry, {rms:.3f} px"
    if inliers.all():
        return ExaminationFinding(name, True, summary)
    off = [marker for marker, inside in zip(ids, inliers, strict=True) if not inside]
    return ExaminationFinding(
        name,
        False,
        f"{summary}; markers {off} do not",
        "are they mistaken for others, or is there a second plate in view?",
    )


def same_camera_twice(records: Sequence[CameraRecord], pixels: float = SAME_PX) -> ExaminationFinding | None:
    """Finding on two cameras that show the same picture: every marker within ``pixels`` [px] of the other's."""
    for k, first in enumerate(records):
        for second in records[k + 1 :]:
            ids, at, _ = mean_observations(first)
            others, where, _ = mean_observations(second)
            if len(ids) < 4 or list(ids) != list(others):
                continue
            if abs(at - where).max() <= pixels:
                return ExaminationFinding(
                    f"cameras {first.name}-{second.name}",
                    False,
                    f"{first.name!r} and {second.name!r} show one and the same picture: one camera given twice",
                    "camera.options of one of them: source",
                )
    return None


def examine_coverage(
    model: CellModel, trials: TrialSettings, records: Sequence[CameraRecord]
) -> Iterator[ExaminationFinding]:
    """Findings on the share of the trial motions inside each camera's image, by the model, at all corners of two
    joints.
    """
    configurations = _corners(trials)
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    points = np.array([model.marker_points @ chain.displacement(q).T for q in configurations])
    for record in records:
        camera = next((c for c in model.cameras if c.name == record.name), None)
        if camera is None:
            continue
        m = points.reshape(-1, 4) @ camera.matrix.T
        raw = distort(camera.lens, m[:, :2] / m[:, 2:])
        inside = (raw >= 0).all(axis=1) & (raw[:, 0] <= camera.width - 1) & (raw[:, 1] <= camera.height - 1)
        share = float(inside.mean())
        summary = f"{100 * share:.0f} % of the markers' places in the calibrated range are in the picture"
        wide = share >= WORKSPACE_SHARE
        yield ExaminationFinding(
            f"{record.name} coverage",
            True if wide else None,
            summary,
            "" if wide else "a shorter lens, more distance, or goals that keep to the middle",
        )


def _corners(trials: TrialSettings) -> FloatArray:
    reach = np.where(np.isfinite(trials.range), trials.range, 0.0)
    found = [trials.base]
    for i, j in product(range(reach.size), repeat=2):
        for a, b in product((-1.0, 1.0), repeat=2):
            q = trials.base.copy()
            q[i] += a * reach[i]
            if i != j:
                q[j] += b * reach[j]
            found.append(q)
    return np.array(found)
