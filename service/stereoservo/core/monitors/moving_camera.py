"""Cameras declared mobile: re-estimated but unused while they move (from tool and other cameras), used again at rest
(thesis 9, fig. 9.1).

A static mobile camera is treated like any other. While it moves, laws continue without it: the model keeps its last
static pose, as after a drop-out, and in every frame its displacement is fitted to the markers at the positions given by
the joints, corrected by the static cameras. Once several frames agree, it is static again: the model takes the mean of
their poses, and goals stated in its pixels are reprojected. This requires proof, by a static camera or static points,
that the camera moved and not the arm.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from stereoservo.calibration.change.change_detection_kernel import (
    ROUNDS,
    Displaced,
    DisplacementGroup,
    ObservedPoints,
    fit_displacement,
)
from stereoservo.calibration.change.hypothesis_test import chi2_quantile
from stereoservo.core.context import Emit, RefusalError, StepContext
from stereoservo.core.model_arrays import ModelArrays, with_unit_height
from stereoservo.core.monitor_state import (
    LATE_S,
    MOVED,
    STALE_PERIODS,
    MobileCamera,
    ModelDiagnosis,
    standing_camera,
)
from stereoservo.core.monitors.camera_relocalization import AT_REST, begin, carry_all, unknown_cameras
from stereoservo.core.monitors.fault_isolation import (
    FEWEST_ON_ARM,
    FEWEST_STATIC,
    LEAST_PX,
    REMEDIES,
    named,
    thresholds_of,
)
from stereoservo.core.move import goal_of
from stereoservo.core.prediction import (
    MODEL_SIGMA_PX,
    FrameResiduals,
    Prediction,
    chain_at,
    gate_threshold,
    pixels_now,
    predict,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState, Holding
from stereoservo.geometry.cameras import camera_centre
from stereoservo.kinematics.kernels import (
    exp_twist,
    multiply4_into,
    project_points,
    transform_points,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import FeatureTarget, IncidenceTarget, Target
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import BoolArray, FloatArray

FREEDOMS = 6
REFUSED_FRAMES = 2
"""Consecutive unexplained frames after which a camera counts as moving."""
STILL_FRAMES = 10
STILL_PX = 0.1
"""Apparent motion [px rms] allowed for a static camera in that time in addition to its noise: models are not exact."""
STILL_CHANCE = 1e-4
"""Probability that noise alone looks like motion, for one frame."""
HAND_OVER_S = 2.0
"""Time [s] after which an unexplained camera at rest is relocalized like a displaced one, if no goal runs."""

_STILL_CHI2 = chi2_quantile(STILL_CHANCE, FREEDOMS)


def start(
    state: CoreState, settings: CoreSettings, arrays: ModelArrays, reanchored: tuple[str, ...], emit: Emit
) -> None:
    """Adapt to a new model in use: of the cameras ``reanchored`` alone, or (empty) of all."""
    state.adjusted = tuple(name for name in state.adjusted if reanchored and name not in reanchored)
    metric = arrays.metric_basis is not None
    for c, camera in enumerate(settings.cameras):
        if not camera.mobile or not metric:
            state.mobile[c] = None
        elif state.mobile[c] is None or not reanchored or camera.name in reanchored:
            state.mobile[c] = standing_camera()
    names = ", ".join(camera.name for camera in settings.cameras if camera.mobile)
    if names and not metric:
        emit(
            "warning",
            name=names,
            message=f"mobile: {names} cannot be adjusted while it moves, for the model is not metric: it is treated "
            "like a camera that stands, and relocalized at rest",
        )


def with_adjusted(state: CoreState, model: CellModel, reanchored: tuple[str, ...]) -> CellModel:
    """A relocalized model in which mobile cameras that are not among the ``reanchored`` have their current matrices."""
    if state.model is None or not reanchored:
        return model
    here = {camera.name: camera for camera in state.model.cameras}
    cameras = tuple(
        here[camera.name] if camera.name in state.adjusted and camera.name not in reanchored else camera
        for camera in model.cameras
    )
    return msgspec.structs.replace(model, cameras=cameras)


# -- every frame ----------------------------------------------------------------------------------------------


def see(
    state: CoreState, settings: CoreSettings, arrays: ModelArrays, camera: int, frame: FrameResiduals,
    prediction: Prediction, q: FloatArray, emit: Emit,
) -> FrameResiduals:  # fmt: skip
    """Process one frame of a camera, with the arm at ``q`` (n,) at its shutter time; returns the residuals that may be
    compared with the model.
    """
    mobile = state.mobile[camera]
    if mobile is None or settings.cameras[camera].name in unknown_cameras(state):
        return frame
    hidden = msgspec.structs.replace(frame, seen=np.zeros_like(frame.seen))
    if state.lifecycle in (Lifecycle.FAULT, Lifecycle.UNCONFIGURED):
        return hidden if mobile.moving else frame  # readings of a faulty drive must not be used to judge cameras
    points, observed, weights = _known(state, arrays, camera, frame, prediction, q)
    basis, gate = arrays.metric_basis, gate_threshold(settings.gate_sigma)
    assert basis is not None
    P = arrays.matrices[camera]
    found = adjust(moved_matrix(P, mobile.reference), points, observed, weights, basis, gate)
    if not mobile.moving:
        late = late_alone(observed - pixels_of(P, points), frame.velocity, weights)
        if late or not _sets_out(state, settings, arrays, camera, found, int((weights > 0.0).sum())):
            return frame
        _set_out(mobile, camera, settings, frame.t_shutter_ns, emit)
        state.cameras[camera].rejected_frames = 0
    mobile.seen = int((weights > 0.0).sum())
    if found is None:
        mobile.lost += 1
        mobile.still, mobile.doubtful = 0, False
    else:
        _follow(mobile, P, points, frame, found)
        mobile.static_moved = _static_moved(P, mobile.way, points, found.weights, len(arrays.marker_ids))
        mobile.lost, mobile.found_ns = 0, frame.t_shutter_ns
    return hidden


def _known(
    state: CoreState, arrays: ModelArrays, camera: int, frame: FrameResiduals, prediction: Prediction, q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (k, 4) at the positions given by the corrected joints ``q``, with the static ones; the pixels at which the
    camera saw them (k, 2) and their weights (k,) [1/px].
    """
    H = chain_at(arrays, q + state.block.correction)[0]
    points = np.concatenate((transform_points(H, arrays.marker_points), arrays.scene_points))
    observed = np.concatenate((prediction.pixels[0], arrays.scene_pixels[camera])) + frame.innovation
    variance = 0.5 * (frame.covariance[:, 0, 0] + frame.covariance[:, 1, 1]) + MODEL_SIGMA_PX**2
    weights = np.where(frame.seen, 1.0 / np.sqrt(variance), 0.0)
    weights[: len(state.watching.masked)] *= 1.0 - state.watching.masked
    return points, observed, weights


def _follow(mobile: MobileCamera, P: FloatArray, points: FloatArray, frame: FrameResiduals, found: Adjusted) -> None:
    """Update the camera's pose by an explained frame, and decide whether it has moved since the frames before."""
    then = moved_matrix(P, mobile.reference)
    motion = np.empty((4, 4))
    multiply4_into(mobile.reference, found.D, motion)
    used = found.weights > 0.0
    distance = shift_px(then, moved_matrix(P, motion), points, used)
    noise = 0.5 * (frame.covariance[:, 0, 0] + frame.covariance[:, 1, 1])
    # The pixels of an estimate of six parameters deviate by chi-square with six degrees of freedom in total; those of
    # two, by twice that.
    random = math.sqrt(2.0 * _STILL_CHI2 * float(noise[used].sum())) / float(used.sum())
    if mobile.still == 0 or distance > STILL_PX + random:
        mobile.reference = motion
        mobile.twists = np.zeros(FREEDOMS)
        mobile.still, mobile.doubtful = 1, False
    else:
        mobile.twists = mobile.twists + found.twist
        mobile.still += 1
    mobile.way = motion
    mobile.moved_px = shift_px(P, moved_matrix(P, motion), points, used)


def _static_moved(P: FloatArray, motion: FloatArray, points: FloatArray, weights: FloatArray, markers: int) -> bool:
    """Whether enough static points, after the ``markers`` in ``points``, moved in the image with the camera."""
    static = weights > 0.0
    static[:markers] = False
    return int(static.sum()) >= FEWEST_STATIC and shift_px(P, moved_matrix(P, motion), points, static) >= LEAST_PX


def _sets_out(
    state: CoreState, settings: CoreSettings, arrays: ModelArrays, camera: int, found: Adjusted | None, seen: int
) -> bool:
    """Whether a frame shows that a static camera starts to move: a displacement above the noise explains it, or nothing
    does, and the previous frames were rejected, too.
    """
    if _others_contradict(state, settings):
        return False
    if found is None:
        return seen >= FEWEST and state.cameras[camera].rejected_frames >= REFUSED_FRAMES
    ratio = thresholds_of(settings, len(arrays.marker_ids), len(settings.cameras)).ratios[FREEDOMS]
    return bool(found.before - found.chi2 > ratio)


def _set_out(mobile: MobileCamera, camera: int, settings: CoreSettings, now_ns: int, emit: Emit) -> None:
    mobile.moving, mobile.since_ns, mobile.found_ns = True, now_ns, now_ns
    name = settings.cameras[camera].name
    message = f"camera {name} moves: it is adjusted in every frame, and used again once it stands"
    emit("health", message=message, name="camera_moving", cameras=(name,))


def _others_contradict(state: CoreState, settings: CoreSettings) -> bool:
    """Whether permanently static cameras reject their observations, too: then this camera is not the cause."""
    return any(
        estimate.rejected_frames > 0
        for camera, estimate in zip(settings.cameras, state.cameras, strict=True)
        if not camera.mobile
    )


# -- every step -----------------------------------------------------------------------------------------------


def takes(context: StepContext) -> bool:
    """Whether the diagnosis is that cameras have moved, and all of them are mobile: then they are adjusted."""
    state = context.state
    verdict = state.watching.verdict
    if verdict.kind not in MOVED:
        return False
    named = [c for c, camera in enumerate(context.settings.cameras) if camera.name in verdict.subjects]
    if any(state.mobile[c] is None for c in named) or unknown_cameras(state):
        return False
    for c in named:
        mobile = state.mobile[c]
        assert mobile is not None
        if not mobile.moving:
            _set_out(mobile, c, context.settings, context.now_ns, context.emit)
    state.watching.verdict, state.watching.last = ModelDiagnosis(), []
    return True


def step(context: StepContext) -> None:
    """Use cameras that are static again; the estimate of the present is then repeated."""
    state, settings = context.state, context.settings
    arrays = context.arrays
    if arrays is None:
        return
    for c, mobile in enumerate(state.mobile):
        if mobile is None or not mobile.moving:
            continue
        if settings.cameras[c].name in unknown_cameras(state):
            state.mobile[c] = standing_camera()  # it is relocalized at rest
        elif mobile.still >= STILL_FRAMES and state.planning is None and not state.pending_reanchored:
            mobile.doubtful = not _proven(c, context)
            if not mobile.doubtful:
                _resume_moved(c, mobile, context)
            elif mobile.moved_px < LEAST_PX:
                _resume_unmoved(c, context)
        elif mobile.lost:
            _hand_over(c, mobile, context)
    if context.arrays is not None and context.arrays is not arrays:
        context.derived.use(context.arrays)


def _proven(c: int, context: StepContext) -> bool:
    """Whether it is proven that the camera moved, and not the arm relative to its joint readings.

    Proof: another camera that does not move sees the arm (for a mobile one: where the joints predict it); or static
    points moved.
    """
    state, m = context.state, len(context.state.watching.masked)
    mobile = state.mobile[c]
    if mobile is not None and mobile.static_moved:
        return True
    for d, camera in enumerate(context.settings.cameras):
        sighting, other = state.watching.sightings[d], state.mobile[d]
        age_s = (context.now_ns - sighting.t_ns) * 1e-9
        recent = not sighting.looked or age_s * camera.rate_hz <= STALE_PERIODS
        static = other is None or (not other.moving and state.cameras[d].rejected_frames == 0)
        if d != c and static and recent and int(sighting.seen[:m].sum()) >= FEWEST_ON_ARM:
            return True
    return False


def _resume_unmoved(c: int, context: StepContext) -> None:
    """End an apparent motion: the camera has the pose that the model states."""
    name = context.settings.cameras[c].name
    context.state.mobile[c] = standing_camera()
    message = f"camera {name} shows what it showed before it seemed to set out: it stands where it stood"
    context.emit("health", name="ok", message=message, cameras=(name,))


def _resume_moved(c: int, mobile: MobileCamera, context: StepContext) -> None:
    """Set the camera's pose to the mean of the frames that agree."""
    state, arrays, model = context.state, context.arrays, context.state.model
    assert arrays is not None
    assert model is not None
    assert context.weights is not None
    name = context.settings.cameras[c].name
    motion = mean_motion(mobile, arrays)
    matrices = arrays.matrices.copy()
    matrices[c] = moved_matrix(arrays.matrices[c], motion)
    new = _arrays_with(arrays, matrices)
    carry_all(new, (c,), (model.epoch, model.epoch), context)
    state.model = msgspec.structs.replace(
        model,
        cameras=tuple(
            msgspec.structs.replace(camera, matrix=matrices[c].copy()) if camera.name == name else camera
            for camera in model.cameras
        ),
    )
    state.adjusted = (*state.adjusted, *(() if name in state.adjusted else (name,)))
    state.mobile[c] = standing_camera()
    estimate = state.cameras[c]
    estimate.seen_ns[:] = 0
    estimate.innovation[:] = 0.0
    context.emit(
        "camera_adjusted",
        id=goal_of(state.source),
        name=name,
        cameras=(name,),
        matrix=matrices[c].copy(),
        epoch=model.epoch,
        message=f"camera {name} stands again, {(context.now_ns - mobile.since_ns) * 1e-9:.1f} s after it set out: "
        f"turned by {math.degrees(angle(motion)):.3g} degrees, its picture moved by {mobile.moved_px:.3g} px",
    )
    prediction = predict(new, context.q)
    weights = context.weights.copy()
    weights[c] = 0.0
    context.arrays, context.prediction, context.weights = new, prediction, weights
    context.pixels = pixels_now(prediction, state.cameras)


def mean_motion(mobile: MobileCamera, arrays: ModelArrays) -> FloatArray:
    """Displacement (4, 4) from the camera's last static pose to the mean of the frames that agree."""
    assert arrays.metric_basis is not None
    twist = mobile.twists / max(float(mobile.still), 1.0)
    motion = np.empty((4, 4))
    multiply4_into(mobile.reference, exp_twist((twist[:, None, None] * arrays.metric_basis).sum(axis=0)), motion)
    return motion


def _hand_over(c: int, mobile: MobileCamera, context: StepContext) -> None:
    """Relocalize a camera like a displaced one if it is at rest, sees enough and is still lost."""
    state, settings = context.state, context.settings
    waited_s = (context.now_ns - mobile.found_ns) * 1e-9
    resting = bool((np.abs(state.block.command) < AT_REST).all())
    if waited_s < HAND_OVER_S or mobile.seen < FEWEST or not settings.reanchor or state.reanchoring is not None:
        return
    if resting and isinstance(state.source, Holding) and not state.queue and state.planning is None:
        name = settings.cameras[c].name
        text = f"camera {name} moved, and no frame of it was explained for {waited_s:.1f} s"
        begin(ModelDiagnosis("camera_moved", (name,), moved_px=mobile.moved_px, text=text), context)


# -- queries of other stages ----------------------------------------------------------------------------------


def prediction_for_priors(arrays: ModelArrays, context: StepContext) -> tuple[Prediction, list[int], tuple[str, ...]]:
    """For the priors: the prediction with moving cameras at their current poses, the indices of these cameras, and the
    names of those whose pose is unknown.
    """
    state, settings = context.state, context.settings
    assert context.prediction is not None
    unknown = unknown_cameras(state)
    moving = [c for c, mobile in enumerate(state.mobile) if mobile is not None and mobile.moving]
    if not moving:
        return context.prediction, moving, unknown
    matrices = arrays.matrices.copy()
    for c in moving:
        mobile = state.mobile[c]
        assert mobile is not None
        matrices[c] = moved_matrix(arrays.matrices[c], mobile.way)
        if mobile.place == "lost":
            unknown = (*unknown, settings.cameras[c].name)
    corrected = predict(_arrays_with(arrays, matrices), context.q + state.block.correction)
    pixels, jacobian = context.prediction.pixels.copy(), context.prediction.jacobian.copy()
    pixels[moving], jacobian[moving] = corrected.pixels[moving], corrected.jacobian[moving]
    return msgspec.structs.replace(context.prediction, pixels=pixels, jacobian=jacobian), moving, unknown


def moving_bits(state: CoreState) -> int:
    """The cameras that move now, as a bit mask."""
    return sum(1 << c for c, mobile in enumerate(state.mobile) if mobile is not None and mobile.moving)


def moving_cameras(state: CoreState, settings: CoreSettings) -> tuple[str, ...]:
    """Names of the cameras that move now."""
    return tuple(
        camera.name
        for camera, mobile in zip(settings.cameras, state.mobile, strict=True)
        if mobile is not None and mobile.moving
    )


def reasons(state: CoreState, settings: CoreSettings) -> tuple[Reason, ...]:
    """The reasons about moving cameras for the status."""
    names = moving_cameras(state, settings)
    if not names:
        return ()
    doubtful = [mobile for mobile in state.mobile if mobile is not None and mobile.moving and mobile.doubtful]
    if len(doubtful) == len(names):
        px = max(mobile.moved_px for mobile in doubtful)
        hint = (
            f"{named(names)} shows the arm {px:.3g} px rms from where its joints report: either the camera moved, or "
            "the arm is not where its joints report (play, joint zeros, the marker body); no camera that stands sees "
            f"the arm, and no {FEWEST_STATIC} static points moved. {REMEDIES}, and a camera that stands and sees the "
            "arm"
        )
        return (Reason("CAMERAS_OR_ARM", "hold", ", ".join(names), px, LEAST_PX, "px", hint),)
    lost = ", ".join(
        camera.name
        for camera, mobile in zip(settings.cameras, state.mobile, strict=True)
        if mobile is not None and mobile.place == "lost"
    )
    hint = "laws go on without it until it stands"
    if lost:
        hint += f"; {lost}: no displacement explains what it sees, turn it back to the markers"
    return (Reason("CAMERA_MOVING", "info", ", ".join(names), hint=hint),)


def refuse_pixels(target: Target, state: CoreState, settings: CoreSettings) -> None:
    """Raises RefusalError for a goal in pixels of a moving camera, because these have no fixed meaning."""
    named: set[str] = set()
    if isinstance(target, IncidenceTarget):
        for spec in target.incidences:
            named |= {*spec.moving.pixels, *spec.fixed.pixels}
        if isinstance(target.secondary, FeatureTarget):
            named |= set(target.secondary.set_points)
    elif isinstance(target, FeatureTarget):
        named |= set(target.set_points)
    refuse_moving(tuple(name for name in moving_cameras(state, settings) if name in named))


def refuse_moving(names: tuple[str, ...]) -> None:
    """Raises RefusalError if one of the cameras ``names``, whose pixels are required, moves."""
    if names:
        raise RefusalError(
            "CAMERA_MOVING",
            f"camera {', '.join(names)} moves: wait for the event camera_adjusted, or leave its pixels out",
            subject=", ".join(names),
        )


def rehearse() -> None:
    """Compile the kernels that frames of static cameras do not use."""
    exp_twist(np.zeros((4, 4)))


# -- algebra --------------------------------------------------------------------------------------------------


def _arrays_with(arrays: ModelArrays, matrices: FloatArray) -> ModelArrays:
    centres = np.array([camera_centre(P) for P in matrices])
    return dataclasses.replace(
        arrays,
        matrices=matrices,
        camera_centres=with_unit_height(centres, arrays.plane_at_infinity),
        scene_pixels=project_points(matrices, arrays.scene_points)[0],
    )


# -- fit of one frame: the displacement, with outliers rejected; whether its time stamp is wrong ---------------------

FEWEST = 4
"""Least number of known points in a frame."""
LEFT_OUT = 2
"""Largest number of wrong observations in a frame."""
UNEXPLAINED_CHANCE = 1e-6


@lru_cache(maxsize=256)
def _unexplained(freedoms: int) -> float:
    """Chi-square above which a frame is not explained."""
    return chi2_quantile(UNEXPLAINED_CHANCE, freedoms)


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A displacement ``D`` (4, 4) of a camera, its ``twist`` (6,), and the quality of its fit: ``weights`` (k,) [1/px]
    of the observations that agree, chi-square ``before`` it and with it.
    """

    D: FloatArray
    twist: FloatArray
    weights: FloatArray
    before: float
    chi2: float


def adjust(
    P: FloatArray, points: FloatArray, observed: FloatArray, weights: FloatArray, basis: FloatArray, gate: float
) -> Adjusted | None:
    """The displacement of camera ``P`` (3, 4) that explains its observations; None if there is none.

    Outliers beyond the gate may be left out one by one, the worst first.
    """
    weights = weights.copy()
    matrices, targets = P[None].copy(), observed[None].copy()
    D, twist = np.empty((4, 4)), np.empty(FREEDOMS)
    side = _side(P, points, weights)
    for _ in range(LEFT_OUT + 1):
        count = int((weights > 0.0).sum())
        if count < FEWEST:
            return None
        seen = ObservedPoints(matrices, points, targets, weights[None])
        chi2, _ = fit_displacement(
            seen, 0, DisplacementGroup(basis, 0, FREEDOMS), len(points), ROUNDS, Displaced(D, twist)
        )
        moved = moved_matrix(P, D)
        if not math.isfinite(chi2) or _side(moved, points, weights) != side:
            return None
        squares = weights**2 * ((observed - pixels_of(moved, points)) ** 2).sum(axis=-1)
        worst = int(squares.argmax())
        if squares[worst] <= gate and chi2 <= _unexplained(2 * count - FREEDOMS):
            before = weights**2 * ((observed - pixels_of(P, points)) ** 2).sum(axis=-1)
            return Adjusted(D.copy(), twist.copy(), weights, float(before.sum()), float(chi2))
        weights[worst] = 0.0
    return None


def late_alone(innovation: FloatArray, velocity: FloatArray, weights: FloatArray) -> bool:
    """Whether innovations (k, 2) of markers with ``velocity`` (k, 2) [px/s] are those of a frame that was taken a
    little earlier or later than stated.
    """
    square = float((weights[:, None] ** 2 * velocity**2).sum())
    if square <= 0.0:
        return False
    late_s = float((weights[:, None] ** 2 * velocity * innovation).sum()) / square
    rest = weights[:, None] * (innovation - late_s * velocity)
    freedoms = 2 * int((weights > 0.0).sum()) - 1
    return abs(late_s) <= LATE_S and float((rest**2).sum()) <= _unexplained(freedoms)


def moved_matrix(P: FloatArray, motion: FloatArray) -> FloatArray:
    """``P motion`` (3, 4), without BLAS."""
    product: FloatArray = (P[:, :, None] * motion[None]).sum(axis=1)
    return product


def angle(motion: FloatArray) -> float:
    """Angle [rad] of a displacement (4, 4) in any frame, by its trace 2 + 2 cos."""
    trace = float(np.trace(motion))
    return math.acos(min(max(0.5 * trace - 1.0, -1.0), 1.0))


def pixels_of(P: FloatArray, points: FloatArray) -> FloatArray:
    """Ideal pixels (k, 2) of points (k, 4)."""
    pixels: FloatArray = project_points(P[None].copy(), points)[0][0]
    return pixels


def _side(P: FloatArray, points: FloatArray, weights: FloatArray) -> float:
    """Sign of the depths of the visible points: +1, -1, or between if they differ."""
    depths = project_points(P[None].copy(), points)[1][0]
    seen = weights > 0.0
    return float(np.sign(depths[seen]).sum()) / max(float(seen.sum()), 1.0)


def shift_px(P: FloatArray, Q: FloatArray, points: FloatArray, used: BoolArray) -> float:
    """Rms distance [px] between the images of the points ``used`` in two cameras."""
    squares = ((pixels_of(P, points) - pixels_of(Q, points)) ** 2).sum(axis=-1)
    return math.sqrt(float(squares[used].sum()) / max(float(used.sum()), 1.0))
