"""Base of the simulated camera drivers: shutter grid, latency, drop-outs, and the arm's pose at the shutter time."""

from __future__ import annotations

import zlib
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraDescription, CameraObservation, DriverContext, DriverError, Frame
from stereoservo_drivers.lifecycle import DriverLifecycle, LifecycleState
from stereoservo_drivers.simulated_arm import cell_of_context
from stereoservo_sim.world.body import LIGHT
from stereoservo_sim.world.history import FILE_NAME, HistoryError, TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell, solid_cell, workpiece_cell
from stereoservo_sim.world.workpiece import Moved, MovedFile, MovedFileError, moved_pose

NonNegative = Annotated[float, Meta(ge=0)]
HOLD_NS = 100_000_000


class Bump(Moved, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Displacement of the camera, in its own frame, at ``at_s`` after activation."""

    at_s: NonNegative


class ArmByRow(NamedTuple):
    """Joint positions (n,) when the ``first``, ``middle`` and ``last`` of an image's ``height`` rows were exposed."""

    first: FloatArray
    middle: FloatArray
    last: FloatArray
    height: int

    @property
    def moves(self) -> bool:
        """Whether the rows see the arm at different positions."""
        return not (np.array_equal(self.first, self.middle) and np.array_equal(self.last, self.middle))

    def at(self, row: float) -> FloatArray:
        """Joint positions (n,) when ``row`` was exposed; for a row outside of the image, those of the nearest one."""
        t = float(np.clip(2.0 * row / (self.height - 1) - 1.0, -1.0, 1.0))
        bend = 0.5 * (self.first + self.last) - self.middle
        return self.middle + 0.5 * t * (self.last - self.first) + t * t * bend


class CameraOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of every simulated camera.

    ``view``: camera of the simulated rig (default: the one with the driver's own name).
    ``k1``: lens distortion, Brown's first coefficient about the principal point; 0 is a pinhole.
    ``moved``: displacement of the camera from its place in the rig, in its own frame.
    ``bumps``: the same from a given time on, each replacing the previous one; so does the file
    ``simulated-camera-NAME.json`` in the runtime directory.
    ``workpiece``: there is one beside the body; the file ``simulated-workpiece.json`` there has its pose or motion for
    every frame (`stereoservo_sim.world.workpiece`), and with cameras on the arm that of the body.
    ``solid``: the arm holds a solid without markers in place of the marker body; ``light``: direction towards the lamp
    that shades it, in the world.
    Shutters open at ``k / rate_hz + phase_s``; a frame arrives ``latency_s`` later, and its stamp is the arrival minus
    ``told_latency_s`` (default: the true one).
    ``drop_rate``: probability that a frame is lost.
    ``dropouts``: spans [s, s] after activation without frames.
    ``freeze_after_s``: from then on the picture is frozen though frames keep arriving.
    ``readout_s``: from the exposure of the first row to that of the last, of a rolling shutter; the stamp is the middle
    row's.
    ``breathing``: relative oscillation of the focal length by an autofocus, with the period ``breathing_s``.
    ``seed``: of noise and losses (default: the context's).
    """

    view: str = ""
    k1: float = 0.0
    moved: Moved = Moved()
    bumps: tuple[Bump, ...] = ()
    workpiece: bool = False
    solid: bool = False
    light: tuple[float, float, float] = LIGHT
    rate_hz: Annotated[float, Meta(ge=1, le=1000)] = 30.0
    latency_s: NonNegative = 0.012
    told_latency_s: NonNegative | None = None
    phase_s: NonNegative = 0.0
    drop_rate: Annotated[float, Meta(ge=0, le=1)] = 0.0
    dropouts: tuple[tuple[float, float], ...] = ()
    freeze_after_s: float | None = None
    readout_s: Annotated[float, Meta(ge=0, le=0.2)] = 0.0
    breathing: Annotated[float, Meta(ge=0, le=0.2)] = 0.0
    breathing_s: Annotated[float, Meta(gt=0)] = 10.0
    seed: int | None = None


class SimulatedCamera:
    """A camera of the simulated cell. It sees the arm at its true pose at the shutter time.

    It is static in front of the arm, or mounted on it in front of a static body, by the cell file's ``mount``.
    ``blackout`` may be set while it runs: no frame arrives until it is cleared. Before the simulated arm has ever moved
    the camera shows it at the cell's base; while the arm's process is silent, at its last position.
    """

    driver = "simulated"
    call_budget_us = 5000.0

    def __init__(self, options: CameraOptions, context: DriverContext) -> None:
        self.name = context.camera
        self.cell = self._cell = _cell_of(options, context, self.driver)
        self._options = options
        self._context = context
        view = options.view or context.camera
        try:
            self.camera = self.cell.camera(view, options.k1, options.moved)
        except KeyError as error:
            raise DriverError("option", f"driver {self.driver!r}: view: {error.args[0]}", view=view) from error
        except ValueError as error:
            raise DriverError("option", f"driver {self.driver!r}: moved: {error}") from error
        self._place = self._given = options.moved
        self._bumped = MovedFile(context.runtime_dir, f"simulated-camera-{self.name}.json")
        if not self.camera.sees_whole_image:
            raise DriverError(
                "option",
                f"driver {self.driver!r}: k1: {options.k1:g} leaves the corners of this camera's image dark; "
                f"{self.camera.least_k1:.3f} or more is valid",
                k1=options.k1,
            )
        if options.readout_s > 2.0 * options.latency_s:
            raise DriverError(
                "option",
                f"driver {self.driver!r}: readout_s: {options.readout_s:g}; at most {2.0 * options.latency_s:g} is "
                "valid, twice latency_s: a frame does not arrive before its last row",
                readout_s=options.readout_s,
            )
        self._life = DriverLifecycle(f"camera driver {self.driver!r} ({self.name})")
        self._history: TrueJointHistory | None = None
        self._seed = context.seed if options.seed is None else options.seed
        self._period_ns = 1e9 / options.rate_hz
        told_s = options.latency_s if options.told_latency_s is None else options.told_latency_s
        self._stamped_late_ns = round((options.latency_s - told_s) * 1e9)
        self._next = 0
        self._activated_ns = 0
        self._frozen: FloatArray | None = None
        self._workpiece = MovedFile(context.runtime_dir)
        self._workpiece_pose: FloatArray | None = None
        self._target_moved, self._moved_ns = Moved(), 0
        self.focus = 1.0
        """Focal length relative to its mean."""
        self.blackout = False

    def deliver(
        self, seq: int, t_shutter_ns: int, t_received_ns: int, arm: ArmByRow, rng: np.random.Generator
    ) -> Frame | CameraObservation:
        """Frame or observation of the ``arm`` as each row sees it and the workpiece at its pose."""
        raise NotImplementedError

    def bump(self, moved: Moved) -> None:
        """Displace the camera by ``moved`` from its pose in the rig, from the next shutter on. Raises ValueError."""
        self._given = moved
        self._put(moved)

    def _put(self, moved: Moved) -> None:
        if moved != self._place:
            self.camera = self.cell.camera(self._options.view or self.name, self._options.k1, moved)
            self._place = moved

    def _stand(self, t_shutter_ns: int) -> None:
        """Apply the current displacement: from the file, else from the newest bump. Raises DriverError."""
        since = (t_shutter_ns - self._activated_ns) * 1e-9
        due = [bump for bump in self._options.bumps if bump.at_s <= since]
        given = self._given if not due else Moved(due[-1].shift_m, due[-1].turn_deg)
        try:
            self._put(self._bumped.now(given))
        except MovedFileError as error:
            raise DriverError("moved", str(error), path=str(self._bumped.path)) from error

    def workpiece_pose(self) -> FloatArray | None:
        """Pose (4, 4) of the workpiece in the world; None if the cell has none."""
        return self._workpiece_pose

    def describe_as(
        self, delivers: Literal["frames", "observations"], marker_ids: tuple[int, ...] = ()
    ) -> CameraDescription:
        """The description, given what is delivered."""
        return CameraDescription(
            driver=self.driver,
            name=self.name,
            width=self.camera.width,
            height=self.camera.height,
            rate_hz=self._options.rate_hz,
            delivers=delivers,
            call_budget_us=self.call_budget_us,
            marker_ids=marker_ids,
        )

    def configure(self) -> None:
        """Set up the camera, also after :meth:`close`; the arm may start later. Raises DriverError."""
        self._life.require("configure()", LifecycleState.CREATED, LifecycleState.CONFIGURED, LifecycleState.CLOSED)
        self._life.state = LifecycleState.CONFIGURED

    def activate(self) -> None:
        """Deliver frames from the next shutter on. Raises DriverError."""
        self._life.require("activate()", LifecycleState.CONFIGURED, LifecycleState.ACTIVE)
        if self._life.state is LifecycleState.CONFIGURED:
            self._activated_ns = self._context.clock.now_ns()
            self._next = self._grid(self._activated_ns) + 1
        self._life.state = LifecycleState.ACTIVE

    def poll(self) -> list[Frame] | list[CameraObservation]:
        """The newest frame that has arrived since the last poll, or none. Raises DriverError."""
        self._life.require("poll()", LifecycleState.ACTIVE)
        now_ns = self._context.clock.now_ns()
        k = self._grid(now_ns - round(self._options.latency_s * 1e9))
        if k < self._next:
            return []
        t_shutter_ns = self._shutter(k)
        q = self._arm_at(t_shutter_ns, now_ns)
        if q is None:
            return []
        self._move_target(t_shutter_ns)
        if not self._stands_still(t_shutter_ns):
            self._stand(t_shutter_ns)
            since = (t_shutter_ns - self._activated_ns) * 1e-9
            swing = float(np.sin(2.0 * np.pi * since / self._options.breathing_s))
            self.focus = 1.0 + self._options.breathing * swing
        self._next = k + 1
        rng = np.random.default_rng((self._seed & 0xFFFFFFFF, zlib.crc32(self.name.encode()), k))
        if self._lost(t_shutter_ns, rng):
            return []
        arm = self._by_row(q, t_shutter_ns, now_ns)
        return [self.deliver(k, t_shutter_ns + self._stamped_late_ns, now_ns, arm, rng)]  # type: ignore[return-value]

    def deactivate(self) -> None:
        """Stop delivering frames. Idempotent."""
        if self._life.state is LifecycleState.ACTIVE:
            self._life.state = LifecycleState.CONFIGURED

    def close(self) -> None:
        """Release. Idempotent; never raises."""
        self.deactivate()
        if self._history is not None and self._history.path is not None:
            self._history.close()
        self._history = None
        self._life.state = LifecycleState.CLOSED

    def _grid(self, t_ns: int) -> int:
        k = int((t_ns - self._options.phase_s * 1e9) // self._period_ns)
        return k if self._shutter(k) <= t_ns else k - 1

    def _shutter(self, k: int) -> int:
        return round(k * self._period_ns + self._options.phase_s * 1e9)

    def _lost(self, t_shutter_ns: int, rng: np.random.Generator) -> bool:
        since = (t_shutter_ns - self._activated_ns) * 1e-9
        unlucky = bool(rng.random() < self._options.drop_rate)
        return unlucky or self.blackout or any(start <= since < end for start, end in self._options.dropouts)

    def _by_row(self, q: FloatArray, t_shutter_ns: int, now_ns: int) -> ArmByRow:
        """The arm as the rows see it, the middle one at ``q`` (n,)."""
        first = last = q
        half_ns = round(0.5e9 * self._options.readout_s)
        if half_ns and not self._stands_still(t_shutter_ns):
            first, last = (self._arm_at(t_shutter_ns + late, now_ns) for late in (-half_ns, half_ns))
            self._frozen = q
        return ArmByRow(q if first is None else first, q, q if last is None else last, self.camera.height)

    def _arm_at(self, t_ns: int, now_ns: int) -> FloatArray | None:
        """Joint positions at the shutter, or None while the arm's process has not reached that time."""
        if self._stands_still(t_ns) and self._frozen is not None:
            return self._frozen
        history = self._open_history(now_ns)
        if history is None:
            q: FloatArray | None = self.cell.base
        else:
            q = history.at(t_ns)
            if q is None:
                newest = history.newest()
                if newest is None:
                    q = self.cell.base
                elif now_ns - t_ns > HOLD_NS:
                    q = newest[1]
        self._frozen = q
        return q

    def _stands_still(self, t_ns: int) -> bool:
        after = self._options.freeze_after_s
        return after is not None and (t_ns - self._activated_ns) * 1e-9 >= after

    def _move_target(self, t_ns: int) -> None:
        """Set the pose at ``t_ns`` of what moves by itself: the workpiece or, for cameras on the arm, the body. Raises
        DriverError.
        """
        part, stand = self._cell.workpiece, self._cell.stand
        if (part is None and stand is None) or (self._stands_still(t_ns) and self._moved_ns):
            return
        try:
            moved = self._workpiece.now(t_ns=t_ns)
        except MovedFileError as error:
            raise DriverError("workpiece", str(error), path=str(self._workpiece.path)) from error
        self._moved_ns = t_ns
        if part is not None:
            self._workpiece_pose = part.pose(moved)
        elif stand is not None and moved != self._target_moved:
            self._target_moved = moved
            self.cell = replace(self._cell, stand=moved_pose(stand, moved))

    def _open_history(self, now_ns: int) -> TrueJointHistory | None:
        shared = self._context.services.get("world")
        if isinstance(shared, TrueJointHistory):
            return self._checked(shared)
        if self._history is not None:
            newest = self._history.newest()
            silent = newest is None or abs(now_ns - newest[0]) > HOLD_NS
            if not (silent and self._history.replaced()):
                return self._history
            self._history.close()
            self._history = None
        path = self._context.runtime_dir / FILE_NAME
        if path.exists():
            try:
                self._history = self._checked(TrueJointHistory.open(path))
            except HistoryError as error:
                raise DriverError("history", str(error), path=str(path)) from error
        return self._history

    def _checked(self, history: TrueJointHistory) -> TrueJointHistory:
        joints = len(self.cell.robot.joints)
        if history.joints != joints:
            raise DriverError(
                "history", f"the simulated arm has {history.joints} joints; this camera's cell has {joints}"
            )
        return history


def _cell_of(options: CameraOptions, context: DriverContext, driver: str) -> SimulatedCell:
    if options.solid:
        if context.mount != "eye_to_hand" or context.arm.get("urdf") or options.workpiece:
            raise DriverError(
                "option",
                f"driver {driver!r}: solid: one is simulated on the embedded arm only, before standing cameras (mount "
                "'eye_to_hand') and without a workpiece",
                mount=context.mount,
            )
        return solid_cell(options.light)
    if not options.workpiece:
        return cell_of_context(context.arm, context, driver)
    if context.mount != "eye_to_hand" or context.arm.get("urdf"):
        raise DriverError(
            "option",
            f"driver {driver!r}: workpiece: one is simulated before standing cameras only (mount 'eye_to_hand'), and "
            "the embedded arm",
            mount=context.mount,
        )
    return workpiece_cell()
