"""Fake drivers: an arm computed without physics, and cameras that deliver marker positions; with fault injection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.ports.devices import (
    CameraDescription,
    CameraObservation,
    CommandReport,
    DriverContext,
    DriverError,
    JointSpec,
    JointState,
)
from stereoservo_drivers.options import decode_options
from stereoservo_drivers.simulated_arm import ArmOptions, SimulatedArm, cell_of_context
from stereoservo_drivers.simulated_camera import ArmByRow, CameraOptions, SimulatedCamera
from stereoservo_sim.world.camera_rig import PinholeCamera
from stereoservo_sim.world.velocity_drives import DriveBank, IdealPlant, Plant

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=1)]
SHUTTER_ROUNDS = 3
"""Row of the image assumed to show a marker of a moving arm."""


class Faults(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Injected faults of a fake arm; may be changed while it runs (``driver.faults``).

    Each call counts from 1 over the driver's life.
    ``fail_write``, ``fail_read``: that call and later ones raise DriverError (``connection_lost``).
    ``fail_activate``: activate() raises.
    ``freeze_encoder_after``: from that read on positions, velocities and stamp are frozen (no feedback).
    ``stuck_encoder_after``: positions are frozen, the stamp continues.
    ``drop_writes_after``: later commands do not reach the drives, though reported as sent.
    ``delay_s``: age of the states.
    ``gain``: the drives run at this multiple of the command.
    ``block_after``: from that write on an obstacle blocks the joint ``block_joint`` (empty: the one that is then
    fastest) at its position, in its direction of motion.
    """

    fail_write: Count | None = None
    fail_read: Count | None = None
    fail_activate: bool = False
    freeze_encoder_after: Count | None = None
    stuck_encoder_after: Count | None = None
    drop_writes_after: Count | None = None
    delay_s: NonNegative = 0.0
    gain: float = 1.0
    block_after: Count | None = None
    block_joint: str = ""


class FakeJoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One joint of a fake arm [rad or m, s]."""

    name: str
    kind: Literal["revolute", "prismatic"] = "revolute"
    min: float = -3.0
    max: float = 3.0
    velocity: Positive = 1.0
    acceleration: Positive = 4.0


class FakeJointOptions(ArmOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of the fake arm. ``joints``: its joints (default: those of the simulated cell's arm)."""

    joints: tuple[FakeJoint, ...] = ()
    faults: Faults = msgspec.field(default_factory=Faults)


class FakeJointDriver(SimulatedArm):
    """An arm whose joints follow ideal drives; see :class:`Faults` for its injected faults."""

    driver = "fake"
    call_budget_us = 500.0

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        decoded = decode_options(FakeJointOptions, options, self.driver)
        if decoded.joints and decoded.urdf:
            raise DriverError("option", "driver 'fake': joints and urdf both say which arm it is; one is valid")
        cell = cell_of_context(options, context, self.driver)
        joints, base, robot = cell.robot.joints, cell.base, cell.robot if not decoded.joints else None
        if decoded.joints:
            joints = tuple(JointSpec(j.name, j.kind, j.min, j.max, j.velocity, j.acceleration) for j in decoded.joints)
            base = np.clip(np.zeros(len(joints)), [j.min for j in decoded.joints], [j.max for j in decoded.joints])
        super().__init__(decoded, context, joints, base, robot)
        self.faults = decoded.faults
        self._reads = 0
        self._writes = 0
        self._frozen: JointState | None = None
        self._past: list[JointState] = []
        self._plant: IdealPlant | None = None
        self._blocked = False
        names = [joint.name for joint in joints]
        if self.faults.block_joint and self.faults.block_joint not in names:
            raise DriverError(
                "option",
                f"driver 'fake': faults.block_joint: no joint {self.faults.block_joint!r}; joints: {', '.join(names)}",
            )

    def make_plant(self, positions: FloatArray) -> Plant:
        """A plant of ideal joints."""
        self._plant = IdealPlant(positions)
        return self._plant

    def activate(self) -> None:
        """Release the brakes, at rest. Raises DriverError."""
        if self.faults.fail_activate:
            raise DriverError("fault", "fake arm: activate() fails as ordered (faults.fail_activate)")
        super().activate()

    def read_state(self) -> JointState:
        """Encoder readings, as altered by injected faults. Raises DriverError."""
        state = super().read_state()
        self._reads += 1
        faults = self.faults
        if _due(faults.fail_read, self._reads):
            raise DriverError("connection_lost", f"fake arm: read {self._reads} fails as ordered", retry=True)
        if faults.delay_s > 0:
            state = self._delayed(state)
        frozen = _due(faults.freeze_encoder_after, self._reads)
        stuck = _due(faults.stuck_encoder_after, self._reads)
        if not frozen and not stuck:
            self._frozen = state
            return state
        held = self._frozen if self._frozen is not None else state
        if frozen:
            return held
        return JointState(
            state.seq, state.t_ns, held.positions, np.zeros_like(held.velocities), held.efforts, held.following_errors
        )

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Command velocities (n,). Raises DriverError."""
        self._writes += 1
        if _due(self.faults.fail_write, self._writes):
            raise DriverError("connection_lost", f"fake arm: write {self._writes} fails as ordered", retry=True)
        return super().write_velocity(qd)

    def send(self, bank: DriveBank, now_ns: int, asked: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
        """Send a command to the drives, unless an injected fault drops it."""
        if _due(self.faults.block_after, self._writes) and not self._blocked:
            self._block(asked)
        if _due(self.faults.drop_writes_after, self._writes):
            return asked.copy(), ()
        if self.faults.gain != 1.0:
            super().send(bank, now_ns, asked * self.faults.gain)
            return asked.copy(), ()
        return super().send(bank, now_ns, asked)

    def _block(self, asked: FloatArray) -> None:
        """Block a joint by an obstacle, once it moves."""
        assert self._plant is not None  # configured: the lifecycle was checked
        named = [k for k, joint in enumerate(self._joints) if joint.name == self.faults.block_joint]
        joint = named[0] if named else int(np.abs(asked).argmax())
        if asked[joint] != 0.0:
            self._plant.walls[1 if asked[joint] > 0.0 else 0, joint] = self._plant.positions[joint]
            self._blocked = True

    def _delayed(self, state: JointState) -> JointState:
        self._past.append(state)
        limit = state.t_ns - round(self.faults.delay_s * 1e9)
        while len(self._past) > 1 and self._past[1].t_ns <= limit:
            self._past.pop(0)
        return self._past[0]


class FakeCameraOptions(CameraOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of a fake camera. ``noise_px``: sigma of each coordinate; ``marker_drop_rate``: probability of missing a
    marker.
    """

    noise_px: NonNegative = 0.05
    marker_drop_rate: Annotated[float, Meta(ge=0, le=1)] = 0.0


class FakeCameraDriver(SimulatedCamera):
    """A camera that delivers the markers of the simulated cell as observations: raw pixels plus Gaussian
    noise.
    """

    driver = "fake"
    call_budget_us = 2000.0

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self._fake = decode_options(FakeCameraOptions, options, self.driver)
        self._view: tuple[Any, ...] = ()
        super().__init__(self._fake, context)

    def describe(self) -> CameraDescription:
        """Size, rate, marker ids; delivers observations."""
        part = self.cell.workpiece
        ids = self.cell.body.ids if part is None else np.append(self.cell.body.ids, part.body.ids)
        return self.describe_as("observations", tuple(int(i) for i in ids))

    def deliver(
        self, seq: int, t_shutter_ns: int, t_received_ns: int, arm: ArmByRow, rng: np.random.Generator
    ) -> CameraObservation:
        """The markers that this camera sees for the current pose of the ``arm``."""
        q, camera = arm.middle, self.camera.focused(self.focus)
        pixels, seen = self._without_noise(camera, q)
        if arm.moves:
            for marker in range(len(pixels)):
                for _ in range(SHUTTER_ROUNDS):
                    pixels[marker] = self._image_of(camera, arm.at(pixels[marker, 1]))[marker]
        ids = self.cell.body.ids
        part, pose = self.cell.workpiece, self.workpiece_pose()
        if part is not None and pose is not None:
            beside, _ = self.cell.in_world(camera, q).image_of(part.marker_positions(pose))
            pixels, ids = np.concatenate([pixels, beside]), np.append(ids, part.body.ids)
            seen = np.append(seen, self.cell.workpiece_visible(q, pose, camera))
        # The same numbers are drawn for any visibility: one marker's visibility does not change another's noise.
        noise = rng.standard_normal(pixels.shape) * self._fake.noise_px
        seen &= rng.random(len(seen)) >= self._fake.marker_drop_rate
        k = int(np.count_nonzero(seen))
        sigma = max(self._fake.noise_px, 1e-3)
        return CameraObservation(
            camera=self.name,
            seq=seq,
            t_shutter_ns=t_shutter_ns,
            t_received_ns=t_received_ns,
            ids=ids[seen],
            pixels=(pixels + noise)[seen],
            covariances=np.broadcast_to(np.eye(2) * sigma**2, (k, 2, 2)).copy(),
        )

    def _without_noise(self, camera: PinholeCamera, q: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (k, 2) of the body's markers, and which of them are seen (k,); cached for an arm at rest."""
        view = (q.tobytes(), self.camera, self.focus, self.cell)
        if not self._view or self._view[:4] != view:
            self._view = (*view, self._image_of(camera, q), self.cell.visible(q, camera))
        return self._view[4].copy(), self._view[5].copy()

    def _image_of(self, camera: PinholeCamera, q: FloatArray) -> FloatArray:
        return self.cell.in_world(camera, q).image_of(self.cell.marker_positions(q))[0]


def _due(limit: int | None, count: int) -> bool:
    return limit is not None and count >= limit
