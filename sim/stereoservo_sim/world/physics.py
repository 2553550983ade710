"""Joint simulation of the arm in pybullet, without a window."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.plugins import missing_extra
from stereoservo_sim.world.mechanics import GRAVITY
from stereoservo_sim.world.robots import Robot, UrdfPosition, roll_pitch_yaw, urdf
from stereoservo_sim.world.velocity_drives import RigidPlant

MAX_TORQUE = 1000.0
POSITION_GAIN = 0.2


class PhysicsError(Exception):
    """pybullet cannot be used; the message states the cause."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the output of C code."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(descriptor) for descriptor in (1, 2)]
    try:
        with open(os.devnull, "wb") as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
            yield
            ctypes.CDLL(None).fflush(None)  # C's own buffers
    finally:
        for descriptor, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)


def import_pybullet() -> Any:
    """Import pybullet without the message that its C code prints. Raises PhysicsError."""
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    try:
        with _quiet():
            import pybullet
    except ImportError as error:
        raise PhysicsError(missing_extra(error) or f"pybullet cannot be imported: {error}") from error
    return pybullet


@dataclass(frozen=True)
class LoadedRobot:
    """An arm in a simulation: the id of its body, the indices of its k joints, and of the link of the flange.

    The engine's positions (k,) are ``coupling`` (k, n) times the robot's plus ``offsets`` (k,): coupled joints are one
    of the robot's. ``beside``: joints outside the arm, with their rest positions; ``moving``: all joints that move.
    """

    body: int
    joints: list[int]
    coupling: FloatArray
    offsets: FloatArray
    flange: int
    beside: dict[int, float]
    moving: list[int]


def load_robot(bullet: Any, client: int, robot: Robot) -> LoadedRobot:
    """Load an arm into a simulation, the joints beside it at rest. Raises PhysicsError if the engine cannot."""
    with tempfile.TemporaryDirectory() as folder, _quiet():
        path = Path(folder) / "arm.urdf"
        path.write_text(robot.text or urdf(robot), "utf-8")
        try:
            body = int(
                bullet.loadURDF(
                    str(path),
                    robot.mounted[:3, 3].tolist(),
                    bullet.getQuaternionFromEuler(roll_pitch_yaw(robot.mounted).tolist()),
                    useFixedBase=True,
                    physicsClientId=client,
                )
            )
        except bullet.error as error:
            raise PhysicsError(
                f"pybullet cannot load {robot.name}: {error} (a mesh that it cannot read? driver 'fake' and "
                "background = 'arm' need none)"
            ) from error
    infos = [
        bullet.getJointInfo(body, k, physicsClientId=client)
        for k in range(bullet.getNumJoints(body, physicsClientId=client))
    ]
    index = {info[1].decode(): k for k, info in enumerate(infos)}
    links = {info[12].decode(): k for k, info in enumerate(infos)}
    moving = [k for k, info in enumerate(infos) if info[2] != bullet.JOINT_FIXED]
    positions = robot.positions or tuple(UrdfPosition(joint.name, k) for k, joint in enumerate(robot.joints))
    joints = [index[one.name] for one in positions]
    coupling = np.zeros((len(joints), len(robot.joints)))
    for k, one in enumerate(positions):
        coupling[k, one.joint] = one.factor
    offsets = np.array([one.offset for one in positions])
    beside = {}
    for k in moving:
        low, high = infos[k][8:10]
        if k not in joints:
            beside[k] = min(max(0.0, low), high) if low < high else 0.0
            bullet.resetJointState(body, k, beside[k], physicsClientId=client)
    return LoadedRobot(body, joints, coupling, offsets, links[robot.flange], beside, moving)


class PybulletPlant(RigidPlant):
    """The arm as rigid bodies under gravity. Drives follow their set-points by position and velocity, so nothing
    sags. ``efforts`` (n,) [N m]: motor torques of the last step; at rest, those that balance gravity.
    """

    def __init__(self, robot: Robot, positions: FloatArray, step_s: float) -> None:
        self._bullet = import_pybullet()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("pybullet refuses another simulation in this process")
        self._step_s = step_s
        self._bullet.setTimeStep(step_s, physicsClientId=self._client)
        self._mounted = robot.mounted[:3, :3]
        self._pull(GRAVITY)
        loaded = load_robot(self._bullet, self._client, robot)
        self._loaded, self._arm, self._joints = loaded, loaded.body, loaded.joints
        self._forces = [MAX_TORQUE] * len(loaded.joints)
        self._gains = [POSITION_GAIN] * len(loaded.joints)
        self._velocity_gains = [1.0] * len(loaded.joints)
        self._from_engine = np.linalg.pinv(loaded.coupling)
        for joint in loaded.moving:
            self._bullet.changeDynamics(
                self._arm, joint, linearDamping=0, angularDamping=0, jointDamping=0, physicsClientId=self._client
            )
        self._places = [loaded.moving.index(joint) for joint in loaded.joints]
        for joint, rest in loaded.beside.items():
            self._bullet.setJointMotorControl2(
                self._arm,
                joint,
                self._bullet.POSITION_CONTROL,
                targetPosition=rest,
                force=MAX_TORQUE,
                physicsClientId=self._client,
            )
        self.place(positions)

    def _pull(self, gravity: FloatArray) -> None:
        self._bullet.setGravity(*gravity.tolist(), physicsClientId=self._client)

    def place(self, positions: FloatArray) -> None:
        """Set the joints to ``positions`` (n,), at rest, without motion."""
        own = self._loaded.coupling @ positions + self._loaded.offsets
        for joint, position in zip(self._joints, own.tolist(), strict=True):
            self._bullet.resetJointState(self._arm, joint, position, physicsClientId=self._client)
        self.positions = positions.copy()
        self.velocities = np.zeros(len(positions))
        rests = [self._loaded.beside.get(joint, 0.0) for joint in self._loaded.moving]
        for place, position in zip(self._places, own.tolist(), strict=True):
            rests[place] = position
        still = [0.0] * len(rests)
        self._pull(self._mounted.T @ GRAVITY)  # inverse dynamics takes the base's frame as the world's
        balanced = self._bullet.calculateInverseDynamics(self._arm, rests, still, still, physicsClientId=self._client)
        self._pull(GRAVITY)
        self.efforts = np.array(balanced)[self._places] @ self._loaded.coupling

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Advance by ``h`` [s], one step of the engine, towards set-points (n,), (n,)."""
        self._bullet.setJointMotorControlArray(
            self._arm,
            self._joints,
            self._bullet.POSITION_CONTROL,
            targetPositions=(self._loaded.coupling @ set_positions + self._loaded.offsets).tolist(),
            targetVelocities=(self._loaded.coupling @ set_velocities).tolist(),
            forces=self._forces,
            positionGains=self._gains,
            velocityGains=self._velocity_gains,
            physicsClientId=self._client,
        )
        self._bullet.stepSimulation(physicsClientId=self._client)
        states = self._bullet.getJointStates(self._arm, self._joints, physicsClientId=self._client)
        own = np.array([(state[0], state[1], state[3]) for state in states])
        self.positions = self._from_engine @ (own[:, 0] - self._loaded.offsets)
        self.velocities = self._from_engine @ own[:, 1]
        self.efforts = own[:, 2] @ self._loaded.coupling

    def flange(self) -> FloatArray:
        """Pose (4, 4) of the flange as computed by the engine, for checks against the closed form."""
        state = self._bullet.getLinkState(
            self._arm, self._loaded.flange, computeForwardKinematics=True, physicsClientId=self._client
        )
        pose = np.eye(4)
        pose[:3, :3] = np.array(self._bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        pose[:3, 3] = state[4]
        return pose

    def close(self) -> None:
        """End the simulation. Idempotent."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1
