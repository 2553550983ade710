"""Experiment: examination of recordings of joints and pixels of random cells, with an injected fault (a camera's bump,
a drifted joint zero, late stamps, dropped frames) or none: faults found, their onsets, and false reports.

Three in four have joints with unknown axes: a calibration motion, then work. The others have known hand poses, at
work. A third have errors of the joints (ripple and noise of the encoder), or of the poses.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.calibration.examination.examination import (
    RecordingCause,
    RecordingReport,
    examine_views,
)
from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.known_arm import KINDS, NAMES, free_arm
from stereoservo.calibration.trial_data import CalibrationError, TrialCamera
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.experiment import cases
from stereoservo_sim.experiments.figures import Figures, sorted_values
from stereoservo_sim.progress import ProgressCall, silent
from stereoservo_sim.summaries import count_row
from stereoservo_sim.world.random_cells import random_case
from stereoservo_sim.world.synthetic import SyntheticCell, rotation, translation

Fault = Literal["camera_moved", "joint_zero", "late_stamps", "dropped_frames"]

FRAME_S, SAMPLE_S = 1.0 / 15.0, 0.005
STOPS, WAY_S, REST_S = 9, 0.2, 0.2
WORK_S = 14.0
NOISES = (0.03, 0.5)
"""Noise [px], log-uniform."""
BUMPS, DRIFTS = (2.0, 30.0), (1.0, 10.0)
"""Change of the pixels [px], rms, log-uniform."""
LATE = (0.01, 0.08)
"""Lateness of the stamps [s]."""
SHARES: dict[str, float] = {
    "": 0.2,
    "camera_moved": 0.45,
    "joint_zero": 0.15,
    "late_stamps": 0.15,
    "dropped_frames": 0.05,
}
ALSO_DROPPED = 0.2
POSES, IMPERFECT = 0.25, 0.33
RIPPLE, ENCODER = 1e-4, 3e-5
"""Amplitude and standard deviation of the readings' errors [rad]."""
POSE_M = 1e-4
"""Standard deviation of stated poses [m]; of their rotations the same number [rad]."""
INSIDE = 0.05, 0.95
"""Range of onsets as a share of a recording."""
WITHIN = 2
"""Largest error in frames of a correct onset."""


@dataclass(frozen=True)
class TrueFault:
    """Injected fault: its ``kind`` and ``subject``, from ``frame`` of each camera on, as delivered (0: throughout)."""

    kind: Fault
    subject: str
    frame: int = 0
    size: float = 0.0
    time_s: float = 0.0


@dataclass
class _Truth:
    """A recording under construction: frames at ``times`` (f,), true ``joints`` (f, n) at them, by camera."""

    cell: SyntheticCell
    sigma: float
    times: FloatArray
    path_times: FloatArray
    path: FloatArray
    poses: bool
    imperfect: bool
    trial_frames: int
    faults: list[TrueFault] = field(default_factory=list)


@dataclass(frozen=True)
class ExaminedCase:
    """A generated recording, and its injected faults."""

    seed: int
    views: RecordedViews
    faults: tuple[TrueFault, ...]
    poses: bool
    imperfect: bool
    in_trials: bool
    sigma: float


def examined_case(seed: int) -> ExaminedCase:
    """The recording of ``seed``, reproducible."""
    rng = np.random.default_rng([seed, 20])
    case = random_case(seed)
    poses, imperfect = bool(rng.random() < POSES), bool(rng.random() < IMPERFECT)
    path_times, path, trial_s = _path(case.cell, rng, poses)
    times = np.arange(2 * FRAME_S, path_times[-1] - 2 * FRAME_S, FRAME_S)
    truth = _Truth(
        case.cell, float(np.exp(rng.uniform(*np.log(NOISES)))), times, path_times, path, poses, imperfect,
        int((times < trial_s).sum()),
    )  # fmt: skip
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    views = _recorded(truth, kind, rng)
    dropped = kind == "dropped_frames" or bool(rng.random() < ALSO_DROPPED)
    if dropped:
        views = _with_drops(views, truth, rng)
    in_trials = any(0 < one.frame < truth.trial_frames for one in truth.faults if one.kind != "dropped_frames")
    return ExaminedCase(seed, views, tuple(truth.faults), poses, imperfect, in_trials, truth.sigma)


def _path(cell: SyntheticCell, rng: np.random.Generator, poses: bool) -> tuple[FloatArray, FloatArray, float]:
    """Times (j,) and joints (j, n) of the calibration motion, if joints are recorded, then work; and its start."""
    way, rest = round(WAY_S / SAMPLE_S), round(REST_S / SAMPLE_S)
    ease = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, way + 1) / way)
    rows = [cell.home[None]]
    stops = np.zeros((0, len(cell.home))) if poses else np.vstack([cell.stops(STOPS)[0], cell.home])
    for stop in stops:
        here = rows[-1][-1]
        rows += [here + ease[:, None] * (stop - here), np.repeat(stop[None], rest, axis=0)]
    begins = sum(len(part) for part in rows) * SAMPLE_S
    t = np.arange(0.0, WORK_S * (2.0 if poses else 1.0), SAMPLE_S)
    n = len(cell.home)
    rates, phases = rng.uniform(0.1, 0.35, (2, n)), rng.uniform(0.0, 2.0 * np.pi, (2, n))
    swing = np.sin(2.0 * np.pi * t[:, None, None] * rates + phases).mean(axis=1)
    begin = np.minimum(t / 0.5, 1.0)[:, None]
    rows.append(cell.home + 0.6 * cell.ranges * swing * begin * begin * (3.0 - 2.0 * begin))
    path = np.vstack(rows)
    return np.arange(len(path)) * SAMPLE_S, path, begins


def _recorded(truth: _Truth, kind: str, rng: np.random.Generator) -> RecordedViews:
    """The recording with one injected fault of a kind, or none."""
    cell, times = truth.cell, truth.times
    frame = int(rng.integers(int(INSIDE[0] * len(times)), int(INSIDE[1] * len(times))))
    camera, joint = int(rng.integers(2)), int(rng.integers(len(cell.home)))
    late = np.zeros((2, len(times)))
    bumped, drift = cell, np.zeros_like(cell.home)
    name = f"cam{camera}"
    if kind == "late_stamps":
        frame = 0 if rng.random() < 0.5 else frame
        size = float(rng.uniform(*LATE))
        late[camera, frame:] = size
        truth.faults.append(TrueFault("late_stamps", name, frame, size))
    later = np.arange(len(times)) >= frame
    shown = np.array([[np.interp(times + late[c], truth.path_times, q) for q in truth.path.T] for c in range(2)])
    shown = shown.transpose(0, 2, 1)
    if kind == "camera_moved":
        size = float(np.exp(rng.uniform(*np.log(BUMPS))))
        bumped = _bumped(cell, camera, size, shown[camera, later], rng)
        truth.faults.append(TrueFault("camera_moved", name, frame, size))
    if kind == "joint_zero":
        size = float(np.exp(rng.uniform(*np.log(DRIFTS))))
        drift = _drift(cell, joint, size, shown[0, later])
        truth.faults.append(
            TrueFault(
                "joint_zero",
                "" if truth.poses else cell.joint_names[joint],
                frame,
                float(drift[joint]),
                float(times[frame]) - 1e-6,
            )
        )
    pixels = np.empty((2, len(times), len(cell.body), 2))
    for part, seen in ((~later, cell), (later, bumped)):
        offset = drift if part is later else 0.0 * drift
        for c in range(2) if part.any() else ():
            pixels[c, part] = seen.pixels(shown[c, part] + offset)[c]
            inside = seen.in_view(shown[c, part] + offset)[c]
            pixels[c, part] = np.where(inside[..., None], pixels[c, part], np.nan)
    pixels += rng.normal(0.0, truth.sigma, pixels.shape)
    return _views(truth, pixels, rng)


def _bumped(
    cell: SyntheticCell, camera: int, size: float, joints: FloatArray, rng: np.random.Generator
) -> SyntheticCell:
    """The cell with a camera rotated and shifted so that its pixels change by ``size`` [px] rms."""
    axis, shift = rng.normal(size=3), rng.normal(size=3)
    sample = joints[:: max(1, len(joints) // 20)]
    scale = size / float(cell.intrinsics[camera, 0, 0])
    seen = cell
    for _ in range(6):
        turn = np.degrees(scale) * axis / np.linalg.norm(axis)
        move = translation(*(0.3 * scale * shift))
        poses = cell.poses.copy()
        poses[camera] = rotation("x", turn[0]) @ rotation("y", turn[1]) @ rotation("z", turn[2]) @ move @ poses[camera]
        seen = replace(cell, poses=poses)
        apart = seen.pixels(sample)[camera] - cell.pixels(sample)[camera]
        scale *= size / float(np.sqrt((apart**2).sum(axis=-1).mean()))
    return seen


def _drift(cell: SyntheticCell, joint: int, size: float, joints: FloatArray) -> FloatArray:
    """Drift (n,) of one joint's zero that changes the first camera's pixels by ``size`` [px] rms."""
    sample = joints[:: max(1, len(joints) // 20)]
    drift = np.zeros_like(cell.home)
    drift[joint] = 1e-3
    apart = cell.pixels(sample + drift)[0] - cell.pixels(sample)[0]
    return np.asarray(drift * min(size / float(np.sqrt((apart**2).sum(axis=-1).mean())), 50.0))


def _views(truth: _Truth, pixels: FloatArray, rng: np.random.Generator) -> RecordedViews:
    cell, f = truth.cell, len(truth.times)
    keep = slice(None, None, 2)  # samples every 10 ms
    joint_times, joints = truth.path_times[keep], truth.path[keep]
    generators = None
    names, kinds = cell.joint_names, cell.kinds
    if truth.poses:
        hand = np.array([cell.flange(q) for q in joints])
        joints, generators, _ = free_arm(hand)
        joints = np.hstack([joints[:, :3], np.unwrap(joints[:, 3:], axis=0)])
        joints = joints + rng.normal(0.0, POSE_M if truth.imperfect else 1e-9, joints.shape)
        names, kinds = NAMES, KINDS
    elif truth.imperfect:
        phases = rng.uniform(0.0, 2.0 * np.pi, joints.shape[1])
        joints = joints + RIPPLE * np.sin(100.0 * joints + phases) + rng.normal(0.0, ENCODER, joints.shape)
    camera = np.tile([0, 1], f)
    return RecordedViews(
        names, kinds, tuple(TrialCamera(f"cam{c}", cell.width, cell.height) for c in range(2)), cell.marker_ids,
        joint_times, joints, camera, np.repeat(truth.times, 2), np.full(2 * f, -1), np.zeros(2 * f, dtype=np.int64),
        pixels.transpose(1, 0, 2, 3).reshape(2 * f, -1, 2), np.full((2 * f, len(cell.body)), truth.sigma), generators,
    )  # fmt: skip


def _with_drops(views: RecordedViews, truth: _Truth, rng: np.random.Generator) -> RecordedViews:
    """The recording without some frames of one camera; onsets are then stated in the remaining frames."""
    camera, f = int(rng.integers(2)), len(truth.times)
    lost = np.zeros(f, dtype=bool)
    for begin in rng.integers(5, f - 15, int(rng.integers(1, 6))):
        lost[begin : begin + int(rng.integers(1, 11))] = True
    first = int(np.flatnonzero(lost)[0])
    keep = ~((views.camera == camera) & np.repeat(lost, 2))
    name = f"cam{camera}"
    truth.faults = [
        replace(one, frame=one.frame - int(lost[: one.frame].sum())) if one.subject == name else one
        for one in truth.faults
    ]
    truth.faults.append(TrueFault("dropped_frames", name, first, float(lost.sum())))
    return views.select(keep)


class ExaminedVerdict(msgspec.Struct, frozen=True):
    """Verdict on a case: ``true`` faults, those ``found``, with the errors ``late_by`` of their onsets in frames, those
    ``missed``, causes ``falsely`` reported, and those reported beside another as indistinguishable (``unsure``).
    ``not_told``: only dropped frames were examined, since no model could be learnt.
    """

    seed: int
    true: tuple[str, ...]
    found: tuple[str, ...]
    late_by: tuple[int, ...]
    missed: tuple[str, ...]
    falsely: tuple[str, ...]
    unsure: tuple[str, ...]
    poses: bool
    imperfect: bool
    in_trials: bool
    sigma_px: float
    size: float
    seconds: float
    not_told: bool = False
    rms_px: float | None = None
    sizes_in_deviations: tuple[float, ...] = ()


def judged_examination(seed: int) -> ExaminedVerdict:
    """Verdict on the case of ``seed``."""
    case = examined_case(seed)
    begin = time.process_time()
    try:
        report = examine_views(case.views)
    except CalibrationError as error:
        report = None
        refused = error.code
    seconds = time.process_time() - begin
    true = tuple(one.kind for one in case.faults)
    size = case.faults[0].size if case.faults else 0.0
    about = case.poses, case.imperfect, case.in_trials, case.sigma, size, seconds
    plain = ExaminedVerdict(seed, true, (), (), true, (), (), *about)
    if report is None:
        return msgspec.structs.replace(plain, falsely=(refused,))
    return _judged(case, report, plain)


def _judged(case: ExaminedCase, report: RecordingReport, plain: ExaminedVerdict) -> ExaminedVerdict:
    left = list(report.causes)
    found, late_by, missed, unsure, sizes = [], [], [], [], []
    for fault in case.faults:
        match = next((cause for cause in left if _matches(case, fault, cause)), None)
        if match is None:
            missed.append(fault.kind)
            continue
        left.remove(match)
        found.append(fault.kind)
        late_by.append(0 if match.onset is None else _frames_apart(case, fault, match))
        if match.or_else:
            unsure.append(fault.kind)
        if (
            match.deviation
            and match.value is not None
            and fault.kind in ("joint_zero", "late_stamps")
            and fault.subject
        ):
            sizes.append((match.value - fault.size) / match.deviation)
    # For erroneous joints it is true, and the most that is known of a drift that was present during calibration.
    drifted = any(fault.kind == "joint_zero" for fault in case.faults)
    left = [cause for cause in left if cause.kind != "joint_errors" or not (case.imperfect or drifted)]
    falsely = tuple(f"{cause.kind} {cause.subject}".strip() for cause in left if cause.kind != "not_learnt")
    return msgspec.structs.replace(
        plain, found=tuple(found), late_by=tuple(late_by), missed=tuple(missed), falsely=falsely, unsure=tuple(unsure),
        not_told=any(cause.kind == "not_learnt" for cause in left), rms_px=report.rms_px,
        sizes_in_deviations=tuple(round(one, 2) for one in sizes),
    )  # fmt: skip


def _frames_apart(case: ExaminedCase, fault: TrueFault, cause: RecordingCause) -> int:
    """Delay of an onset after the true one in frames of the camera in which it is stated."""
    assert cause.onset is not None
    if fault.kind != "joint_zero":
        return cause.onset.frame - fault.frame
    names = [camera.name for camera in case.views.cameras]
    stamps = case.views.times[case.views.camera == names.index(cause.onset.camera)]
    return cause.onset.frame - int(np.searchsorted(stamps, fault.time_s))


def _matches(case: ExaminedCase, fault: TrueFault, cause: RecordingCause) -> bool:
    """Whether a cause is a fault, or is reported as indistinguishable from it."""
    if case.poses and fault.kind == "joint_zero":
        return cause.kind in ("body_moved", "cameras_moved")  # the arm's joints are not recorded
    named = cause.kind == fault.kind and cause.subject == fault.subject
    return named or bool(cause.or_else and fault.subject and fault.subject in cause.or_else)


def run_examined_recordings(seeds: int, seed: int = 0, progress: ProgressCall = silent) -> dict[str, Any]:
    """Cases ``seed`` to ``seed + seeds - 1``: found by kind, onsets, and false reports."""
    judged = cases(judged_examination, seeds, seed, progress, "recordings")
    rows = []
    for kind in ("camera_moved", "joint_zero", "late_stamps", "dropped_frames"):
        mine = [case for case in judged if kind in case.true]
        hit = [case for case in mine if kind in case.found]
        near = [case for case in hit if abs(case.late_by[case.found.index(kind)]) <= WITHIN]
        rows.append(count_row(f"{kind}: found", len(hit), len(mine)))
        rows.append(count_row(f"{kind}: onset within {WITHIN} frames", len(near), len(hit)))
    rows.append(count_row("recordings with a false cause", sum(bool(c.falsely) for c in judged), len(judged)))
    quiet = [case for case in judged if not [one for one in case.true if one != "dropped_frames"]]
    rows.append(count_row("of those to which nothing was done", sum(bool(c.falsely) for c in quiet), len(quiet)))
    rows.append(count_row("not told, with the reason", sum(c.not_told for c in judged), len(judged)))
    rows.append(count_row("named beside another cause", sum(bool(c.unsure) for c in judged), len(judged)))
    return {
        "title": f"examined-recordings: cases {seed} to {seed + seeds - 1}",
        "rows": rows,
        "onsets": [abs(one) for case in judged for one in case.late_by],
        "sizes_in_deviations": [one for case in judged for one in case.sizes_in_deviations],
        "in_trial_motions": dict(Counter("missed" if c.missed else "found" for c in judged if c.in_trials)),
        "beyond": [
            msgspec.to_builtins(c)
            for c in judged
            if c.missed or c.falsely or c.not_told or any(abs(k) > WITHIN for k in c.late_by)
        ],
        "cpu_s": round(sum(case.seconds for case in judged), 1),
        "thesis": {"note": "none: the thesis has no recordings"},
    }


def draw_examined_recordings(answer: dict[str, Any]) -> Figures:
    """Errors of reported onsets in frames."""
    onsets = {"all causes": answer["onsets"]}
    return {"examined_recordings": sorted_values(onsets, "onset from the true one [frames]", WITHIN)}


def notes_examined_recordings(answer: dict[str, Any]) -> Iterator[str]:
    """Every case with an incorrect result."""
    yield f"faults within the trial motions: {answer['in_trial_motions']}"
    for case in answer["beyond"]:
        yield (
            f"case {case['seed']}: true {case['true']}, missed {case['missed']}, falsely {case['falsely']}, onsets off "
            f"by {case['late_by']} frames (size {case['size']:.3g}, noise {case['sigma_px']:.3g} px)"
        )
