"""Data that the stages of one core step share: the workspace of the kernels, and, for Python, accepted inputs, the
monitors' findings, the velocity output and refused requests.

Workspace: the second argument of the kernels beside the block, one flat record of fixed size. It holds the inputs of
one step, the constants of settings and model, the core's Python state as far as this step needs it, and the results. It
is not part of the memory: it follows from inputs, settings, model and state.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.control.faces import FaceChoice
from stereoservo.control.law import Law, Scene, Task
from stereoservo.core.block import JOINTS, Shapes, packed_type, views
from stereoservo.core.cycle import Event, StepInputs
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitors.following import LAG_S, of_kinds
from stereoservo.core.prediction import (
    SEEN_SLACK_NS,
    FrameResiduals,
    Prediction,
    gate_threshold,
    improbable,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import MAX_CAMERAS, MAX_JOINTS, MAX_MARKERS
from stereoservo.messages.goals import PlanReport
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Health
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.devices import CameraObservation, JointState

LENS_SIZE = 7
"""Largest number of lens parameters."""
MAX_FRAMES = 4 * MAX_CAMERAS
"""Largest number of frames that a step processes: the newest ones."""


class Numbers(ctypes.Structure):
    """The numbers at the head of the record."""

    period_s: float
    lasting_ns: int
    tip_first: int
    worst: int
    missing: float
    lens_size: int
    known_s: float
    filter_s: float
    gate: float
    joints: int
    cameras: int
    markers: int
    composition: int
    viewing_count: int
    measured: int
    error_px: float
    conditioning: float
    gain: float
    gain_near: float
    gain_far: float
    gain_slope: float
    tolerance_px: float
    time_limit_s: float
    hold_frames: int
    now_ns: int
    dt_s: float
    stop: int
    frames: int
    has_sent: int
    joints_given: int
    joints_ns: int
    joints_seq: int
    joints_whole: int
    tells_efforts: int
    tells_following: int
    elapsed_s: float
    nominal_s: float
    longest_gap_s: float
    joint_timeout_s: float
    frame_timeout_s: float
    active_before: int
    active: int
    faulty: int
    modelled: int
    frames_as_stops: int
    erring: int
    stopped: int
    by_images: int
    watches_following: int
    watches_loads: int
    learning: int
    rounds_in_python: int
    quiet: int
    paused: int
    has_goal: int
    markers_needed: int
    joints_found: int
    frames_passed: int
    frames_refused: int
    gap: int
    contact_watched: int
    contact: int
    following: int
    looked_at: int
    inconsistent: int
    any_masked: int
    followed: int
    seen: int
    run_found: int
    rests: int
    jacobian_choice: int
    compensates: int
    needs_features: int
    speed_scale: float
    runs: int
    features_ns: int
    added: int
    finite: int
    allowed_scale: float
    scale: float
    scaled_by: int
    share: float
    shared_by: int
    limited: int
    _fields_ = [
        (name, ctypes.c_double if kind == "float" else ctypes.c_int64) for name, kind in __annotations__.items()
    ]


ARRAYS: Shapes = {
    "velocity_max": JOINTS, "lag": JOINTS, "play": JOINTS, "answers": JOINTS, "friction": JOINTS,
    "effort_limits": JOINTS, "following_limits": JOINTS, "stated_effort_limits": JOINTS,
    "stated_following_limits": JOINTS, "generators": ("joints", 4, 4), "kinds": JOINTS, "zero": JOINTS,
    "marker_points": ("markers", 4), "matrices": ("cameras", 3, 4),
    "lenses": ("cameras", LENS_SIZE), "scene_pixels": ("cameras", "rows", 2), "row_ids": ("rows",), "row_of": ("rows",),
    "camera_rates": ("cameras",), "noise_chi2": (MAX_MARKERS + 1,),
    "sample": (4, "joints"), "operators": ("joints", 4, 4), "points": ("markers", 4),
    "predicted": ("cameras", "markers", 2), "jacobian": ("cameras", "markers", 2, "joints"),
    "weights": ("cameras", "markers"), "pixels": ("cameras", "markers", 2),
    "frame_q": JOINTS, "frame_innovation": ("rows", 2), "frame_spread": ("rows", 2, 2), "frame_noise": ("rows",),
    "frame_seen": ("rows",), "frame_velocity": ("rows", 2), "unseen_px": ("cameras", "markers"),
    "camera_centres": ("cameras", 4), "no_rates": ("cameras", "markers", 2),
    "used": ("cameras",), "wanted": ("cameras", "markers"), "set_points": ("cameras", "markers", 2),
    "target_points": ("markers", 4), "target_known": ("markers",), "centre_weights": ("markers",), "centre_body": (4,),
    "centre_target": (4,), "face": (3,), "eyes": ("cameras", 4),
    "usable": ("cameras", "markers"), "body": ("markers", 4), "centre": (4,),
    "velocity": JOINTS, "components": (2, 3), "component_status": (3,),
    "q": JOINTS, "sent": JOINTS, "masked": ("markers",), "unknown": ("cameras",), "offset_rule": ("cameras",),
    "stated_offset_ns": ("cameras",), "image_sizes": ("cameras", 2), "joint_deviations": JOINTS,
    "limits": (4, "joints"), "bounds": (4,), "friction_most": JOINTS, "friction_travel": JOINTS, "raw": JOINTS,
    "outermost": JOINTS, "previous": JOINTS, "acted": JOINTS, "result": (1 + 3 * MAX_JOINTS,),
    "arrived_camera": (MAX_FRAMES,), "arrived_seq": (MAX_FRAMES,), "arrived_ns": (MAX_FRAMES,),
    "arrived_count": (MAX_FRAMES,), "arrived_found": (MAX_FRAMES,), "arrived_ids": (MAX_FRAMES, MAX_MARKERS),
    "arrived_pixels": (MAX_FRAMES, MAX_MARKERS, 2), "arrived_covariances": (MAX_FRAMES, MAX_MARKERS, 2, 2),
}  # fmt: skip
INTEGERS = (
    "row_ids", "row_of", "face", "component_status", "unknown", "offset_rule", "stated_offset_ns", "arrived_camera",
    "arrived_seq", "arrived_ns", "arrived_count", "arrived_found", "arrived_ids",
)  # fmt: skip
OTHER_TYPES = {"kinds": np.uint8, "frame_seen": np.uint8, **dict.fromkeys(INTEGERS, np.int64)}
WORKSPACE = packed_type(Numbers, ARRAYS, OTHER_TYPES, {})
_INPUTS = struct.Struct("=qd9q")
"""Layout of the numbers of a step's inputs in the record, ``now_ns`` to ``tells_following``."""
_INPUTS_AT = Numbers.now_ns.offset  # type: ignore[attr-defined]
NOISE_CHI2 = np.array([improbable(2.0 * count) for count in range(MAX_MARKERS + 1)])
"""Limit of a frame's chi-square by its number of markers: `improbable` for pure noise."""
Limits = tuple[FloatArray, FloatArray]


class Workspace:
    """Workspace of the kernels: constants, inputs and results. ``record`` (1,) of type `WORKSPACE` holds all of it, and
    is what kernels take.

    Inputs of the step, written by `core.ingest`: the time ``now_ns`` and the period ``dt_s``, at most the nominal one
    ``nominal_s``; whether the ``stop`` was raised; the joint ``sample`` (4, n) (positions, velocities, efforts,
    following errors; ``joints_given``: there is a sample, ``joints_whole``: it is complete for every joint) with
    ``joints_ns`` and ``joints_seq``; the velocity ``sent`` (n,) by the driver in place of the last command, if
    ``has_sent``; and ``frames`` in arrays ``arrived_…``, for each its ``camera`` (-1: unknown), ``seq``, stamp ``ns``,
    ``count`` of markers (-1: arrays of other shapes), ``ids``, ``pixels``, ``covariances``.

    Settings: ``period_s`` of the loop, and the longest ages of inputs; ``velocity_max`` (n,); the ``lag`` [rad or m] of
    a healthy joint's drive and ``play``, ``answers``, ``friction`` of `monitors.following.of_kinds` (n,);
    ``lasting_ns``, the time for which an observation has a weight; for the gate of a frame: the squared distance
    ``gate``, the time ``known_s`` for which an innovation is valid, and the time constant ``filter_s`` of its filter;
    ``camera_rates`` (c,), ``image_sizes`` (c, 2). ``effort_limits``, ``following_limits`` (n,): those of the model, and
    those stated in the cell file.
    ``limits`` (4, n) and ``bounds`` (4,): of the safety stage, see `core.command.SafetyLimits`. Model: the fields of
    `ModelArrays`, its lenses of ``lens_size`` numbers; ``joint_deviations`` (n,) of joint readings with errors.

    State for this step, written by `core.servo_core.arrange`: the lifecycle, ``active_before`` the driver's last report
    and ``active`` with it; ``modelled``: there is a model; ``frames_as_stops``: Python processes the frames;
    ``erring``: joints may deviate from their readings; the arm is ``stopped``, ``paused``; what is monitored;
    ``rounds_in_python``: Python examines the rounds of frames; ``quiet``: none of the last ones needed an explanation;
    ``masked`` (m,); for each camera whether its pose is ``unknown`` and the rule for the offset of its stamps
    (``offset_rule``).

    Results of a step: the joints ``q`` (n,), the results of `ingest` for ``joints``, ``frames`` and the ``gap`` of the
    loop; the fields of the ``prediction``, ``weights`` (c, m) and ``pixels`` (c, m, 2); the results of the monitors:
    ``contact``, ``following``, the joint ``worst`` with its travel ``missing``; for a round the cameras that were
    examined (``looked_at``) and those that are ``inconsistent`` with noise, as bit masks. For the frame processed
    last: joints ``frame_q`` (n,), the fields of `residuals`, and until the prediction of the present is written that of
    its camera alone, ``of_frame``.

    Goal that a law works on (``has_goal``), as in `state.ServoGoal`: cameras ``used`` (c,), set-points that count,
    ``wanted`` (c, m), the target positions of its markers, its centre, the three markers of its ``face`` and the
    centres ``eyes`` of the ``viewing_count`` cameras that must keep it visible; as in `sources.law.GoalError`,
    ``usable``, and ``body`` and ``centre`` at present, and whether an ``error_px`` was ``measured``; whether its
    progress was measured in this step (``followed``), how many of its markers were ``seen``, and the result
    ``run_found`` of `account_run`. Its ``gain`` at present, and the goal's gains, tolerance and limits, as in
    `state.LawRun`. Results of a law: see `control.law.Law`. ``scene`` and ``task``: those that laws take; ``loaded``
    and ``faced``: the goal and the face that they belong to.

    Motion: the source's ``velocity`` (n,), the other fields of `core.context.SourceOutput`, and ``raw`` (n,), the
    velocity with friction compensation. Results of `core.command`: ``finite`` to ``shared_by``, ``acted`` (n,),
    ``previous`` (n,), the previous command. ``result`` (1 + 3n,): values of a step for recordings, see
    `core.cycle.StepResult`. ``arrays``: all arrays by name.
    """

    def __init__(self, settings: CoreSettings, load_limits: Limits | None, stated: Limits) -> None:
        self.record: np.ndarray[Any, Any] = np.zeros(1, WORKSPACE)
        self._counts = {
            "joints": len(settings.joint_names),
            "cameras": len(settings.cameras),
            "markers": 0,
            "rows": 0,
        }
        self.arrays: dict[str, Any] = {}
        self._view()
        self._bytes = self.record.view(np.uint8).data
        self.numbers = Numbers.from_buffer(self._bytes)
        self.numbers.joints, self.numbers.cameras = self._counts["joints"], self._counts["cameras"]
        self.numbers.period_s = 1.0 / settings.rate_hz
        self.numbers.lasting_ns = int(settings.limits.coast_s * 1e9) + SEEN_SLACK_NS
        self.numbers.known_s, self.numbers.filter_s = settings.limits.coast_s + 1.0, settings.filter_s
        self.numbers.gate = gate_threshold(settings.gate_sigma)
        self.numbers.joint_timeout_s = settings.limits.joint_timeout_s
        self.numbers.watches_following = settings.watch_following
        given = self.arrays
        given["noise_chi2"][:] = NOISE_CHI2
        given["camera_rates"][:] = [camera.rate_hz for camera in settings.cameras]
        for sizes, camera in zip(given["image_sizes"], settings.cameras, strict=True):
            sizes[:] = camera.width, camera.height
        given["velocity_max"][:] = settings.limits.velocity_max
        given["lag"][:] = LAG_S * settings.limits.velocity_max
        given["play"][:], given["answers"][:], given["friction"][:] = of_kinds(
            settings.joint_kinds, settings.resolution
        )
        self.limit_loads(load_limits)
        efforts, following = stated
        given["stated_effort_limits"][:], given["stated_following_limits"][:] = efforts, following

    def limit_loads(self, limits: Limits | None) -> None:
        """Set the collision thresholds of efforts and following errors, (n,) each; None: infinite, so they are never
        exceeded.
        """
        self.numbers.watches_loads = limits is not None
        efforts, following = limits or (np.inf, np.inf)
        self.arrays["effort_limits"][:], self.arrays["following_limits"][:] = efforts, following

    def use(self, arrays: ModelArrays) -> None:
        """Use a model from now on."""
        self._counts["markers"], self._counts["rows"] = len(arrays.marker_points), len(arrays.row_ids)
        self._view()
        numbers, given = self.numbers, self.arrays
        numbers.markers, numbers.tip_first = len(arrays.marker_points), arrays.tip_first
        numbers.composition = arrays.composition
        for name in (
            "generators",
            "kinds",
            "zero",
            "marker_points",
            "matrices",
            "camera_centres",
            "row_ids",
            "row_of",
        ):
            given[name][:] = getattr(arrays, name)
        self.numbers.lens_size = arrays.lenses.shape[1]
        given["lenses"][:, : arrays.lenses.shape[1]] = arrays.lenses
        given["scene_pixels"][:, : len(arrays.scene_points)] = arrays.scene_pixels
        self.unseen_px[:] = arrays.unseen_px
        given["joint_deviations"][:] = np.sqrt(arrays.joint_variances)
        numbers.modelled, numbers.erring = True, arrays.joint_accuracy is not None
        present = self.prediction
        self.scene = Scene(
            present.operators,
            arrays.composition,
            given["matrices"],
            given["camera_centres"],
            given["body"],
            self.pixels,
            given["usable"],
        )
        self.task = Task(
            given["set_points"], given["wanted"], given["no_rates"], given["target_points"], given["target_known"],
            given["centre"], given["centre_target"], given["face"],
        )  # fmt: skip
        self.loaded: tuple[Any, ...] = ()
        self.faced: FaceChoice | None = None

    def put_numbers(self, *numbers: float) -> None:
        """Write the numbers of a step's inputs, in their order in `Numbers`. Raises struct.error for integers of more
        than 64 bits.
        """
        _INPUTS.pack_into(self._bytes, _INPUTS_AT, *numbers)

    def put_frame(
        self, k: int, camera: int, stamp: tuple[int, int], sights: tuple[IntArray, FloatArray, FloatArray]
    ) -> None:
        """Write frame ``k`` of a step. Arrays of other shapes than stated count as wrong.

        ``camera``: index of its camera.
        ``stamp``: sequence number and shutter stamp [ns].
        ``sights``: ids (s,), raw pixels (s, 2) and covariances (s, 2, 2) of its markers.
        """
        given, count = self.arrays, len(sights[0])
        if count > MAX_MARKERS or sights[1].shape != (count, 2) or sights[2].shape != (count, 2, 2):
            count = -1
        else:
            given["arrived_ids"][k, :count] = sights[0]
            given["arrived_pixels"][k, :count], given["arrived_covariances"][k, :count] = sights[1:]
        given["arrived_camera"][k], given["arrived_count"][k] = camera, count
        given["arrived_seq"][k], given["arrived_ns"][k] = stamp

    def _view(self) -> None:
        given = self.arrays = views(self.record, ARRAYS, self._counts)
        self.sample: FloatArray = given["sample"]
        self.q: FloatArray = given["q"]
        self.sent: FloatArray = given["sent"]
        self.raw: FloatArray = given["raw"]
        self.load_limits: Limits = given["effort_limits"], given["following_limits"]
        self.stated_load_limits: Limits = given["stated_effort_limits"], given["stated_following_limits"]
        self.weights: FloatArray = given["weights"]
        self.velocity: FloatArray = given["velocity"]
        self.result: FloatArray = given["result"][: 1 + 3 * self._counts["joints"]]
        self.pixels: FloatArray = given["pixels"]
        self.prediction = Prediction(given["operators"], given["points"], given["predicted"], given["jacobian"])
        self.of_frame = Prediction(given["operators"], given["points"], given["predicted"][:1], given["jacobian"][:1])
        self.frame_q: FloatArray = given["frame_q"]
        self.unseen_px: FloatArray = given["unseen_px"]

    def residuals(self, t_shutter_ns: int) -> FrameResiduals:
        """The residuals of the frame that was processed last."""
        given = self.arrays
        return FrameResiduals(
            t_shutter_ns,
            given["frame_innovation"],
            given["frame_spread"],
            given["frame_noise"],
            given["frame_seen"].view(np.bool_),
            given["frame_velocity"],
        )


Motion = tuple[Callable[[Any, "StepContext"], "SourceOutput | None"], str]
"""The step of a motion source, and the id of the goal that it works on, '' if there is none."""
Emit = Callable[..., None]
"""Appends an event to the step's outputs: its kind, and the event's other fields by keyword."""


@dataclass
class Derived:
    """Values derived from the settings and the model in use: they are kept from step to step, but are no part of the
    state.

    ``nominal_period_ns``: period of the loop.
    ``longest_gap_s``: time without a step after which the arm is stopped.
    ``frame_timeout_s``: age from which on a frame is rejected.
    ``features_fresh_s``: age up to which the features are fresh enough for a law not to coast.
    ``prior_every``: steps between priors.
    ``check_every``: steps between two examinations of why a law is slow or stuck.
    ``laws``: the installed laws, by name.
    ``cameras``: indices by name.
    ``workspace``: the workspace of the kernels, with the constants that they take.
    ``load_limits``: collision thresholds of efforts and following errors, (n,) each; None: collisions are not
    monitored.
    """

    nominal_period_ns: int
    longest_gap_s: float
    frame_timeout_s: float
    features_fresh_s: float
    prior_every: int
    check_every: int
    laws: Mapping[str, Law]
    cameras: Mapping[str, int]
    workspace: Workspace
    arrays: ModelArrays | None = None
    load_limits: tuple[FloatArray, FloatArray] | None = None
    health: tuple[tuple[Any, ...], Health] | None = None
    """The last reported health of the model, with the values that it was built from."""
    motion: Motion = (lambda source, context: None, "")
    """The active source's motion, as `core.move` has arranged it."""
    parameters: tuple[CellModel, Any] | None = None
    """The model whose parameters `core.sources.progress` has computed, and these parameters."""

    def use(self, arrays: ModelArrays) -> None:
        """Use a model from now on."""
        self.arrays = arrays
        self.workspace.use(arrays)


class Ingested(msgspec.Struct, frozen=True, eq=False):
    """The inputs accepted in one step, and the reasons for rejecting the others.

    ``joints``: the sample, if it is new.
    ``observations``: the new ones, each with the index of its camera.
    ``elapsed_s``: time since the last step.
    ``refused_joints``, ``refused_frames`` (index of the camera, reason): of rejected samples and frames.
    ``gap``: reason if the loop was interrupted for too long.
    ``stops``: those of these reasons that stop the arm.
    """

    joints: JointState | None
    observations: tuple[tuple[int, CameraObservation], ...]
    elapsed_s: float
    refused_joints: Reason | None
    refused_frames: tuple[tuple[int, Reason], ...]
    gap: Reason | None
    stops: tuple[Reason, ...]


NOTHING = Ingested(None, (), 0.0, None, (), None, ())


class StepContext:
    """A step as Python sees it: its inputs, the state, and views of the kernels' results so far. One object serves all
    steps of a core, so a goal must copy what it keeps of a step. ``ingested``: the accepted inputs, in steps in which
    Python examines them.

    `core.servo_core.observe` sets ``arrays`` and ``prediction``, ``weights`` (c, m) [1/px] and ideal ``pixels`` (c, m,
    2) of the markers; these need a model.
    ``goals_read``: ids of the goals whose requests were handled in this step; at most one, to limit the computing time.
    ``stays_active``: the active goal's law has a kernel, and the goal has neither ended nor too few markers.
    ``output``: the output of a motion source in Python; None if a kernel has moved the arm, or nothing did.
    ``moved_arrays``: the model with the target body at its current pose.
    """

    def __init__(self, state: CoreState, settings: CoreSettings, derived: Derived, inputs: StepInputs) -> None:
        self.state, self.settings, self.derived = state, settings, derived
        self.events: list[Event] = []
        self.goals_read: list[str] = []
        self.begin(inputs)

    def begin(self, inputs: StepInputs) -> None:
        """Start a step: reset everything but its inputs."""
        self.inputs, self.now_ns = inputs, inputs.now_ns
        # However long the last period was, a command may change only by the step of one nominal period.
        self.dt_s = min(inputs.period_ns, self.derived.nominal_period_ns) * 1e-9
        self._q: FloatArray | None = None
        self.ingested = NOTHING
        self.arrays: ModelArrays | None = None
        self.moved_arrays: ModelArrays | None = None
        self.prediction: Prediction | None = None
        self.weights: FloatArray | None = None
        self.pixels: FloatArray | None = None
        self.output: SourceOutput | None = None
        self.stays_active = False
        if self.goals_read:
            self.goals_read = []
        if self.events:
            self.events = []

    def emit(self, kind: str, **fields: Any) -> None:
        """Append an event to the step's outputs: its kind, and the event's other fields by keyword."""
        self.state.event_seq += 1
        self.events.append(Event(self.state.event_seq, self.now_ns, kind, **fields))  # type: ignore[arg-type]

    @property
    def q(self) -> FloatArray:
        """The measured joint positions (n,), valid for this step only."""
        if self._q is None:
            self._q = self.derived.workspace.q.copy()
        return self._q

    @property
    def observations(self) -> tuple[CameraObservation, ...]:
        """The accepted frames, if Python examines the step's inputs."""
        return tuple([observation for _, observation in self.ingested.observations])

    @property
    def paused(self) -> bool:
        """Whether the active source has to wait in this step."""
        return bool(self.derived.workspace.numbers.paused)


class Finding(msgspec.Struct, frozen=True):
    """A finding of a monitor, as the stage `monitor` acts on it.

    ``stop``: the arm brakes and holds, and every goal ends.
    ``fault``: likewise, and the drives are switched off until a reset.
    ``abort``: the active goal ends.
    ``ended``: message of the goals that end.
    ``message``: message of the event of the stop or fault.
    ``latched``: whether ``reason`` is shown until the cell is resumed.
    """

    effect: Literal["stop", "fault", "abort"]
    reason: Reason
    ended: str
    message: str = ""
    latched: bool = True


class SourceOutput(msgspec.Struct, frozen=True, eq=False):
    """The output of a motion source: joint velocity (n,), whether it must stop without features, whether it has
    finished, and whether it has finished because its goal is ``reached``.
    """

    velocity: FloatArray
    needs_features: bool = False
    speed_scale: float = 1.0
    finished: bool = False
    reached: bool = False
    error_px: float | None = None
    task_error: FloatArray = msgspec.field(default_factory=partial(np.zeros, 0))
    reasons: tuple[Reason, ...] = ()


class RefusalError(Exception):
    """A request is refused: the reason, ``further`` reasons, and for a goal without a path the ``plan``
    that was tried.
    """

    def __init__(
        self,
        code: str,
        hint: str,
        *,
        subject: str = "",
        value: float | None = None,
        threshold: float | None = None,
        unit: str = "",
        further: tuple[Reason, ...] = (),
        plan: PlanReport | None = None,
    ) -> None:
        super().__init__(hint)
        self.reason = Reason(code, "info", subject, value, threshold, unit, hint)
        self.reasons = (self.reason, *further)
        self.plan = plan


COMPILING = (
    "first start of this version on this computer: control laws, path planner and the watch over the model are still "
    "being compiled, which takes a minute or two. Calibration, jog, home and joint goals work already; a model waits, "
    "and goals in the images, teaching and checks are refused: ask again when this reason has gone from the status"
)
"""Message: what is not ready yet, and what is ready."""


def no_model(context: StepContext, hint: str) -> RefusalError:
    """The refusal of a request that needs a model if none is in use; ``hint``: how to get one."""
    if context.inputs.compiling:
        return RefusalError("COMPILING", COMPILING)
    return RefusalError("NO_MODEL", hint)
