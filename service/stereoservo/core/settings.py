"""Constant settings of the control core (joints, limits, cameras, calibration motion, collision thresholds), which
`core_settings` builds from cell file and driver descriptions and validates.
"""

from __future__ import annotations

from functools import lru_cache

import msgspec
import numpy as np

from stereoservo.control.law_registry import LAWS, UnknownLawError
from stereoservo.messages.cell_file import (
    MAX_JOINTS,
    MAX_MARKERS,
    CellFile,
    CellFileError,
    JointLimit,
    Mount,
    check_joints,
    check_limits,
)
from stereoservo.messages.goals import LawName, PointSource
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraDescription, JointDriverDescription, JointKindName

FINEST_ARRIVAL = 5e-4
"""Smallest distance to its target [rad or m] within which a joint has arrived, however fine its encoder."""
ARRIVAL_STEPS = 0.75
"""The same for coarse encoders, in encoder steps: some reading is always within half a step of a target."""
SLACK = 1e-3  # tolerance of a cell's limits beyond the drive's, for rounding [rad or m]
LARGEST_RANGE: dict[JointKindName, float] = {"revolute": 0.6, "prismatic": 0.2}
"""Range to either side of the base if the cell file states none [rad or m]."""


class CameraSettings(msgspec.Struct, frozen=True):
    """A camera as the core sees it: size [px], rate [Hz], its detector's marker ids and systematic error [px]."""

    name: str
    width: int
    height: int
    rate_hz: float
    mount: Mount
    marker_ids: tuple[int, ...]
    systematic_px: float = 0.0
    mobile: bool = False


class MotionLimits(msgspec.Struct, frozen=True, eq=False):
    """Limits of the motion; all arrays in joint order, in [rad] or [m] and seconds.

    ``position_margin``: distance kept from the keep-outs and the ends of the position range.
    ``keep_outs`` (k, n, 2): boxes (low, high) in joint space, ±inf where a joint does not bound the box.
    ``coast_s``: how long a law may run on prediction [s].
    """

    position_min: FloatArray
    position_max: FloatArray
    velocity_max: FloatArray
    acceleration_max: FloatArray
    position_margin: float
    keep_outs: FloatArray
    keep_out_names: tuple[str, ...]
    coast_s: float
    joint_timeout_s: float


class LimitSettings(MotionLimits, frozen=True, eq=False):
    """Limits of a cell: the tighter of drive and cell file.

    ``command_timeout_s``: without a command for so long, the drives stop on their own.
    """

    speed_scale: float
    command_timeout_s: float = 0.1


class TrialSettings(msgspec.Struct, frozen=True, eq=False):
    """Trial motions in joint order; see `messages.cell_file.CalibrationSection`.

    ``range`` (n,): NaN if the programme itself determines how far the joint may move.
    """

    base: FloatArray
    range: FloatArray
    stops: int
    frames: int
    settle_s: float
    speed_scale: float
    min_markers: int
    min_range: float
    wait_s: float
    together: int = 0
    """Number of stops at which all joints are offset from the base."""
    spread_joint: int = -1
    """Joint that visits ``spread_offsets`` (p,) [rad or m] from its base at the stops of other joints; -1: none."""
    spread_offsets: FloatArray = msgspec.field(default_factory=lambda: np.zeros(1))
    sweeps: bool = False
    """Whether the joints sweep without stopping."""


class ContactSettings(msgspec.Struct, frozen=True, eq=False):
    """Collision monitoring, in joint order; see `messages.cell_file.ContactSection`.

    ``efforts``, ``following_errors`` (n,): stated thresholds, NaN if they are to be learnt. ``effort_units``: for
    messages to people.
    """

    enabled: bool
    efforts: FloatArray
    following_errors: FloatArray
    factor: float
    samples: int
    effort_units: tuple[str, ...]


class CoreSettings(msgspec.Struct, frozen=True, eq=False):
    """Everything constant that a step may depend on."""

    cell: str
    joint_names: tuple[str, ...]
    joint_kinds: tuple[JointKindName, ...]
    cameras: tuple[CameraSettings, ...]
    limits: LimitSettings
    trials: TrialSettings | None
    home: FloatArray | None
    rate_hz: float
    law: LawName
    points: PointSource
    gain: float
    tolerance_px: float
    hold_frames: int
    time_limit_s: float
    filter_s: float
    gate_sigma: float
    watch_following: bool = True
    """False if commands are computed but never written (dry run)."""
    contact: ContactSettings | None = None
    scene_ids: tuple[int, ...] = ()
    """Ids that are permanently static: ``[scene] static``."""
    body_moves: bool = False
    """For cameras on the arm: the observed body moves on its own: ``[scene] moves``."""
    reanchor: bool = True
    """Whether a camera that was moved is relocalized automatically."""
    resolution: tuple[float, ...] = ()
    """Steps of the joints' encoders [rad or m], 0: fine; empty: all are fine."""

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Every marker id that some camera can report, sorted."""
        return tuple(sorted({i for camera in self.cameras for i in camera.marker_ids}))

    @property
    def arrival(self) -> FloatArray:
        """Distance (n,) [rad or m] to its target within which a joint has arrived, from its encoder's
        step; read-only.
        """
        return _arrival(self.resolution, len(self.joint_names))

    def joint_unit(self, joint: int) -> str:
        """Unit of a joint's positions."""
        return "rad" if self.joint_kinds[joint] == "revolute" else "m"

    def arrival_origin(self, joint: int) -> str:
        """A joint's arrival tolerance and its origin, as text for people."""
        tolerance = float(self.arrival[joint])
        if tolerance <= FINEST_ARRIVAL:
            return f"tolerance {tolerance:.4g}"
        step = self.resolution[joint]
        return f"tolerance {tolerance:.4g}, {ARRIVAL_STEPS:g} of its encoder's step of {step:.4g}"


@lru_cache(maxsize=32)
def _arrival(resolution: tuple[float, ...], joints: int) -> FloatArray:
    steps = np.array(resolution if resolution else (0.0,) * joints)
    tolerance: FloatArray = np.maximum(FINEST_ARRIVAL, ARRIVAL_STEPS * steps)
    tolerance.setflags(write=False)
    return tolerance


MIN_MARKERS = 3
"""Number of markers that determine the pose of a free body."""
RIGID_FREEDOMS = 6
FEWEST_MARKERS = (1,) * RIGID_FREEDOMS + (MIN_MARKERS,) * (MAX_JOINTS + 1 - RIGID_FREEDOMS)
"""Least number of markers that a goal has to show, by the number of joints. For an arm of fewer than six joints fewer
are sufficient, because the goal must be reachable.
"""


def core_settings(
    cell: CellFile,
    joints: JointDriverDescription,
    cameras: tuple[CameraDescription, ...],
    *,
    speed_cap: float = 1.0,
    watch_following: bool = True,
) -> CoreSettings:
    """Settings from cell file and driver descriptions. Raises CellFileError if they do not fit together.

    ``cameras``: in the cell file's order, each with its detector's marker ids.
    ``speed_cap`` (0, 1]: lowers the cell's speed scale (commissioning).
    """
    cell = completed(cell, joints)
    names = tuple(joint.name for joint in joints.joints)
    check_joints(cell, names)
    try:
        LAWS[cell.servo.law]
    except UnknownLawError as error:
        raise CellFileError(cell.cell.name, "servo.law", str(error)) from error
    limits = {limit.joint: limit for limit in cell.safety.limit}
    for spec in joints.joints:
        limit = limits[spec.name]
        if limit.min < spec.position_min - SLACK or limit.max > spec.position_max + SLACK:
            raise CellFileError(
                cell.cell.name,
                "safety.limit",
                f"joint {spec.name!r}: {limit.min:g} to {limit.max:g} is wider than the drive's "
                f"{spec.position_min:.4f} to {spec.position_max:.4f} (are the limits in rad?)",
            )
    camera_settings = tuple(
        CameraSettings(
            description.name, description.width, description.height, description.rate_hz, section.mount,
            tuple(sorted(description.marker_ids)), description.systematic_px, section.mobile,
        )
        for section, description in zip(cell.camera, cameras, strict=True)
    )  # fmt: skip
    reported = {marker for camera in camera_settings for marker in camera.marker_ids}
    if len(reported) > MAX_MARKERS:
        raise CellFileError(
            cell.cell.name,
            "camera.detector_options",
            f"the detectors report {len(reported)} different markers; a cell has at most {MAX_MARKERS}: name those "
            "that are there",
        )
    trials = None if cell.calibration is None else _trial_settings(cell, joints)
    home = None
    if cell.joints.home:
        base = cell.calibration.base if cell.calibration is not None else {}
        missing = [name for name in names if name not in cell.joints.home and name not in base]
        if missing:
            raise CellFileError(cell.cell.name, "joints.home", f"missing for joint(s) {', '.join(missing)}")
        home = np.array([cell.joints.home.get(name, base.get(name, 0.0)) for name in names])
    elif trials is not None:
        home = trials.base
    return CoreSettings(
        cell=cell.cell.name,
        joint_names=names,
        joint_kinds=tuple(joint.kind for joint in joints.joints),
        cameras=camera_settings,
        limits=_limit_settings(cell, joints, speed_cap),
        trials=trials,
        home=home,
        rate_hz=cell.servo.rate_hz,
        law=cell.servo.law,
        points=cell.servo.points,
        gain=cell.servo.gain,
        tolerance_px=cell.servo.tolerance_px,
        hold_frames=cell.servo.hold_frames,
        time_limit_s=cell.servo.time_limit_s,
        filter_s=cell.servo.filter_s,
        gate_sigma=cell.servo.gate_sigma,
        watch_following=watch_following,
        contact=_contact_settings(cell, joints),
        scene_ids=_scene_ids(cell, camera_settings),
        body_moves=_body_moves(cell),
        reanchor=cell.servo.reanchor == "auto",
        resolution=tuple(joint.resolution for joint in joints.joints),
    )


def completed(cell: CellFile, joints: JointDriverDescription) -> CellFile:
    """The cell file completed by values that may be omitted for a simulated arm: limits, and the base of the trial
    motions.

    Raises CellFileError if a stated value does not fit.
    """
    if not joints.simulated:
        return cell
    safety, calibration = cell.safety, cell.calibration
    if not safety.limit:
        safety = msgspec.structs.replace(
            safety,
            limit=tuple(
                JointLimit(j.name, j.position_min, j.position_max, j.velocity_max, j.acceleration_max)
                for j in joints.joints
            ),
        )
    if calibration is not None and joints.home:
        home = {joint.name: value for joint, value in zip(joints.joints, joints.home, strict=True)}
        calibration = msgspec.structs.replace(calibration, base={**home, **calibration.base})
    if safety is cell.safety and calibration is cell.calibration:
        return cell
    found = msgspec.structs.replace(cell, safety=safety, calibration=calibration)
    check_limits(found, cell.cell.name)
    return found


def _limit_settings(cell: CellFile, joints: JointDriverDescription, speed_cap: float) -> LimitSettings:
    """The tighter of the drives' and the cell's limits, in joint order."""
    names = tuple(joint.name for joint in joints.joints)
    limits = {limit.joint: limit for limit in cell.safety.limit}
    return LimitSettings(
        position_min=np.array([max(j.position_min, limits[j.name].min) for j in joints.joints]),
        position_max=np.array([min(j.position_max, limits[j.name].max) for j in joints.joints]),
        velocity_max=np.array([min(j.velocity_max, limits[j.name].velocity) for j in joints.joints]),
        acceleration_max=np.array([min(j.acceleration_max, limits[j.name].acceleration) for j in joints.joints]),
        position_margin=cell.safety.position_margin,
        keep_outs=np.array(
            [[k.ranges.get(name, (-np.inf, np.inf)) for name in names] for k in cell.safety.keep_out]
        ).reshape(len(cell.safety.keep_out), len(names), 2),
        keep_out_names=tuple(k.name for k in cell.safety.keep_out),
        coast_s=cell.safety.coast_s,
        joint_timeout_s=cell.safety.joint_timeout_s,
        speed_scale=cell.safety.speed_scale * speed_cap,
        command_timeout_s=joints.command_timeout_s,
    )


def _scene_ids(cell: CellFile, cameras: tuple[CameraSettings, ...]) -> tuple[int, ...]:
    known = {marker for camera in cameras for marker in camera.marker_ids}
    unknown = sorted(set(cell.scene.static) - known)
    if unknown:
        raise CellFileError(
            cell.cell.name,
            "scene.static",
            f"no camera's detector reports marker(s) {', '.join(str(i) for i in unknown)}; reported: "
            f"{', '.join(str(i) for i in sorted(known))}",
        )
    body = known - set(cell.scene.static)
    needed = 3 if cell.calibration is None else cell.calibration.min_markers
    if cell.scene.static and len(body) < needed:
        raise CellFileError(
            cell.cell.name,
            "scene.static",
            f"leaves {len(body)} of the {len(known)} markers that the detectors report to the body that the arm moves, "
            f"and calibration needs {needed}: name only what stands still for good",
        )
    return tuple(sorted(set(cell.scene.static)))


def _body_moves(cell: CellFile) -> bool:
    if cell.scene.moves and cell.camera[0].mount != "eye_in_hand":
        raise CellFileError(
            cell.cell.name,
            "scene.moves",
            "the cameras stand, and the body that they see is carried by the arm; a target that moves beside it is "
            "named by the goal that follows it (--follow-markers)",
        )
    return cell.scene.moves


def _contact_settings(cell: CellFile, joints: JointDriverDescription) -> ContactSettings:
    section = cell.safety.contact
    for key, what in (("effort", "efforts"), ("following", "following_errors")):
        if getattr(section, key) and what in joints.lacks:
            raise CellFileError(
                cell.cell.name,
                f"safety.contact.{key}",
                f"states thresholds, and driver {joints.driver!r} is not set to tell {what.replace('_', ' ')}: nothing "
                f"would ever stop for them. Let the drives send them ([joints.options] feedback), or leave {key} out",
            )
    units = joints.effort_units or tuple("N m" if j.kind == "revolute" else "N" for j in joints.joints)
    return ContactSettings(
        enabled=section.enabled,
        efforts=np.array([section.effort.get(j.name, np.nan) for j in joints.joints]),
        following_errors=np.array([section.following.get(j.name, np.nan) for j in joints.joints]),
        factor=section.factor,
        samples=section.samples,
        effort_units=units,
    )


def _trial_settings(cell: CellFile, joints: JointDriverDescription) -> TrialSettings:
    section = cell.calibration
    assert section is not None
    names = tuple(joint.name for joint in joints.joints)
    spread_joint, offsets = -1, np.zeros(1)
    if section.spread is not None:
        spread = section.spread
        spread_joint = names.index(spread.joint)
        limit = next(limit for limit in cell.safety.limit if limit.joint == spread.joint)
        coarse = 2.0 * ARRIVAL_STEPS * joints.joints[spread_joint].resolution
        base, margin = section.base[spread.joint], cell.safety.position_margin + max(SLACK, coarse)
        remaining = min(limit.max - margin - base, base - limit.min - margin)
        requested = spread.range or section.range.get(spread.joint, LARGEST_RANGE[joints.joints[spread_joint].kind])
        if spread.range is not None and spread.range > remaining:
            raise CellFileError(
                cell.cell.name,
                "calibration.spread.range",
                f"is {spread.range:g}; joint {spread.joint!r} has {remaining:.4g} to either side of its base",
            )
        offsets = np.linspace(-1.0, 1.0, spread.positions) * min(requested, remaining)
    return TrialSettings(
        base=np.array([section.base[name] for name in names]),
        range=np.array([section.range.get(name, np.nan) for name in names]),
        stops=section.stops,
        frames=section.frames,
        settle_s=section.settle_s,
        speed_scale=section.speed_scale,
        min_markers=section.min_markers,
        min_range=section.min_range,
        wait_s=section.wait_s,
        together=section.together if len(names) > 1 else 0,
        spread_joint=spread_joint,
        spread_offsets=offsets,
        sweeps=section.motion == "sweeps" and section.spread is None,
    )
