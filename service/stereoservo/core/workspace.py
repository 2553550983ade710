"""What compiled kernels take beside the block: the constants of settings and model, and room for the results of one
step, as one flat record of fixed size. Nothing of it is remembered: it follows from settings, model and block.
"""

from __future__ import annotations

import ctypes
from operator import is_
from typing import Any

import numpy as np

from stereoservo.control.face_choice import FaceChoice, law_scene
from stereoservo.control.law import LawStep, Scene, Task
from stereoservo.core.block import JOINTS, Shapes, packed_type, views
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitors.following import LAG_S, of_kinds
from stereoservo.core.prediction import SEEN_SLACK_NS, Prediction
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import ServoGoal
from stereoservo.numerics.arrays import FloatArray, IntArray


class Numbers(ctypes.Structure):
    """The numbers at the head of the record."""

    period_s: float
    lasting_ns: int
    tip_first: int
    worst: int
    missing: float
    joints: int
    cameras: int
    markers: int
    composition: int
    eye_count: int
    measured: int
    error_px: float
    conditioning: float
    _fields_ = [
        (name, ctypes.c_double if kind == "float" else ctypes.c_int64)
        for name, kind in __annotations__.items()
    ]


ARRAYS: Shapes = {
    "velocity_max": JOINTS, "lag": JOINTS, "play": JOINTS, "answers": JOINTS, "friction": JOINTS,
    "effort_limits": JOINTS, "following_limits": JOINTS, "stated_effort_limits": JOINTS,
    "stated_following_limits": JOINTS, "generators": ("joints", 4, 4), "kinds": JOINTS, "zero": JOINTS,
    "marker_points": ("markers", 4), "matrices": ("cameras", 3, 4),
    "sample": (4, "joints"), "operators": ("joints", 4, 4), "points": ("markers", 4),
    "predicted": ("cameras", "markers", 2), "jacobian": ("cameras", "markers", 2, "joints"),
    "weights": ("cameras", "markers"), "pixels": ("cameras", "markers", 2),
    "camera_centres": ("cameras", 4), "no_rates": ("cameras", "markers", 2),
    "used": ("cameras",), "wanted": ("cameras", "markers"), "set_points": ("cameras", "markers", 2),
    "target_points": ("markers", 4), "target_known": ("markers",), "centre_weights": ("markers",), "centre_body": (4,),
    "centre_target": (4,), "face": (3,), "eyes": ("cameras", 4),
    "usable": ("cameras", "markers"), "body": ("markers", 4), "centre": (4,),
    "velocity": JOINTS, "components": (2, 3), "component_status": (3,),
}  # fmt: skip
WORKSPACE = packed_type(Numbers, ARRAYS, {"kinds": np.uint8, "face": np.int64, "component_status": np.int64})
Limits = tuple[FloatArray, FloatArray]
NOTHING, NO_STATUS = np.zeros(0), np.zeros(0, dtype=np.int64)


class Workspace:
    """Constants and room; ``record`` (1,) of type `WORKSPACE` is all of it, and what kernels take.

    Of the settings: ``period_s`` of the loop; ``velocity_max`` (n,); the ``lag`` [rad or m] of a healthy joint's drive
    and ``play``, ``answers``, ``friction`` of `monitors.following.of_kinds` (n,); for how long a sight has a weight,
    ``lasting_ns``. Limits (n,) of efforts and following errors: of the model, and those that the cell file states. Of
    the model: as in `ModelArrays`.

    Of a step: the ``sample`` (4, n) of the joints (positions, velocities, efforts, following errors), the fields of its
    ``prediction``, ``weights`` (c, m) and ``pixels`` (c, m, 2), and the joint that follows ``worst``, with what it is
    ``missing``.

    Of the goal that a law works on, as in `state.ServoGoal`: cameras ``used`` (c,), set-points that are ``wanted``
    (c, m), where its markers are to be, its centre, the three markers of its ``face`` and the centres ``eyes`` of the
    ``eye_count`` cameras that keep sight of it; as in `sources.law.GoalError`, ``usable``, ``body`` and ``centre`` now,
    and whether an ``error_px`` was ``measured``. What a law finds: see `control.law.Law`.
    """

    def __init__(self, settings: CoreSettings, load_limits: Limits | None, stated: Limits) -> None:
        self.record: np.ndarray[Any, Any] = np.zeros(1, WORKSPACE)
        self._counts = {"joints": len(settings.joint_names), "cameras": len(settings.cameras), "markers": 0}
        self._arrays: dict[str, Any] = {}
        self._view()
        self.numbers = Numbers.from_buffer(self.record.view(np.uint8).data)
        self.numbers.joints, self.numbers.cameras = self._counts["joints"], self._counts["cameras"]
        self.numbers.period_s = 1.0 / settings.rate_hz
        self.numbers.lasting_ns = int(settings.limits.coast_s * 1e9) + SEEN_SLACK_NS
        given = self._arrays
        given["velocity_max"][:] = settings.limits.velocity_max
        given["lag"][:] = LAG_S * settings.limits.velocity_max
        given["play"][:], given["answers"][:], given["friction"][:] = of_kinds(
            settings.joint_kinds, settings.resolution
        )
        self.limit_loads(load_limits)
        efforts, following = stated
        given["stated_effort_limits"][:], given["stated_following_limits"][:] = efforts, following

    def limit_loads(self, limits: Limits | None) -> None:
        """Collision thresholds (n,), (n,) from here on; None: nothing reaches them."""
        self.watches_loads = limits is not None
        efforts, following = limits or (np.inf, np.inf)
        self._arrays["effort_limits"][:], self._arrays["following_limits"][:] = efforts, following

    def use(self, arrays: ModelArrays) -> None:
        """Work with a model from here on."""
        self._counts["markers"] = len(arrays.marker_points)
        self._view()
        numbers, given = self.numbers, self._arrays
        numbers.markers, numbers.tip_first = len(arrays.marker_points), arrays.tip_first
        numbers.composition = arrays.composition
        for name in ("generators", "kinds", "zero", "marker_points", "matrices", "camera_centres"):
            given[name][:] = getattr(arrays, name)
        present = self.prediction
        self.scene = Scene(
            present.operators, arrays.composition, given["matrices"], given["camera_centres"], given["body"],
            self.pixels, given["usable"],
        )  # fmt: skip
        self.task = Task(
            given["set_points"], given["wanted"], given["no_rates"], given["target_points"], given["target_known"],
            given["centre"], given["centre_target"], given["face"],
        )  # fmt: skip
        self._aim: tuple[Any, ...] = ()
        self._faced: FaceChoice | None = None

    def aim(self, goal: ServoGoal) -> None:
        """Work on a ``goal`` from here on. Its arrays are replaced where it moves, and not written into."""
        aim = (
            goal.used, goal.wanted, goal.set_points, goal.target_points, goal.centre_weights, goal.centre_body,
            goal.centre_target, goal.pose_known,
        )  # fmt: skip
        if len(self._aim) == len(aim) and all(map(is_, aim, self._aim)):
            return
        self._aim, self._faced, given = aim, None, self._arrays
        for name in (
            "used",
            "wanted",
            "set_points",
            "target_points",
            "centre_weights",
            "centre_body",
            "centre_target",
        ):
            given[name][:] = getattr(goal, name)
        given["target_known"][:] = goal.pose_known

    def keep_in_sight(self, choice: FaceChoice) -> None:
        """The law works on the face that was chosen, in the cameras that keep sight of it."""
        if self._faced is choice:
            return
        self.face(choice.triple, law_scene(self.scene, choice).camera_centres)
        self._faced = choice

    def face(self, triple: IntArray, eyes: FloatArray) -> None:
        """The law works on a face of three markers (3,), before cameras with these centres (k, 4)."""
        self._faced, given = None, self._arrays
        given["face"][:], given["eyes"][: len(eyes)] = triple, eyes
        self.numbers.eye_count = len(eyes)

    def law_step(self, components: int) -> LawStep:
        """What the law's kernel has found, of so many components."""
        given, numbers = self._arrays, self.numbers
        velocity = self.velocity.copy()
        if components == 0:
            return LawStep(velocity, NOTHING, NOTHING, NO_STATUS, numbers.conditioning)
        found = given["components"].reshape(-1)[: 2 * components].reshape(2, -1).copy()
        status = given["component_status"][:components].copy()
        return LawStep(velocity, found[0], found[1], status, numbers.conditioning)

    def _view(self) -> None:
        given = self._arrays = views(self.record, ARRAYS, self._counts)
        self.sample: FloatArray = given["sample"]
        self.limits: Limits = given["effort_limits"], given["following_limits"]
        self.stated_limits: Limits = given["stated_effort_limits"], given["stated_following_limits"]
        self.weights: FloatArray = given["weights"]
        self.velocity: FloatArray = given["velocity"]
        self.pixels: FloatArray = given["pixels"]
        self.prediction = Prediction(
            given["operators"], given["points"], given["predicted"], given["jacobian"]
        )
