"""Joint simulation of the arm in pybullet, without a window."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.robots import Robot, urdf
from stereoservo_sim.world.velocity_drives import RigidPlant

MAX_TORQUE = 1000.0
POSITION_GAIN = 0.2


class PhysicsError(Exception):
    """pybullet cannot be used; the message holds the cause."""


def import_pybullet() -> Any:
    """Import pybullet without the message that its C code prints. Raises PhysicsError."""
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(descriptor) for descriptor in (1, 2)]
    try:
        with open(os.devnull, "wb") as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
            import pybullet

            ctypes.CDLL(None).fflush(None)  # what sits in C's own buffers
    except ImportError as error:
        raise PhysicsError(f"pybullet cannot be imported: {error}") from error
    finally:
        for descriptor, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
    return pybullet


def load_robot(bullet: Any, client: int, robot: Robot) -> int:
    """Load an arm into a simulation; returns its body number."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{robot.name}.urdf"
        path.write_text(urdf(robot))
        return int(bullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client))


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
        self._count = len(robot.joints)
        self._forces = [MAX_TORQUE] * self._count
        self._gains = [POSITION_GAIN] * self._count
        self._velocity_gains = [1.0] * self._count
        self._bullet.setTimeStep(step_s, physicsClientId=self._client)
        self._bullet.setGravity(0, 0, -9.81, physicsClientId=self._client)
        self._arm = load_robot(self._bullet, self._client, robot)
        self._joints = list(range(self._count))
        for joint in self._joints:
            self._bullet.changeDynamics(
                self._arm,
                joint,
                linearDamping=0,
                angularDamping=0,
                jointDamping=0,
                physicsClientId=self._client,
            )
        self.place(positions)

    def place(self, positions: FloatArray) -> None:
        """Set the joints to ``positions`` (n,), at rest, without moving there."""
        for joint, position in zip(self._joints, positions.tolist(), strict=True):
            self._bullet.resetJointState(self._arm, joint, position, physicsClientId=self._client)
        self.positions = positions.copy()
        self.velocities = np.zeros(self._count)
        still = [0.0] * self._count
        self.efforts = np.array(
            self._bullet.calculateInverseDynamics(
                self._arm, positions.tolist(), still, still, physicsClientId=self._client
            )
        )

    def follow(self, set_positions: FloatArray, set_velocities: FloatArray, h: float) -> None:
        """Advance by ``h`` [s], one step of the engine, towards set-points (n,), (n,)."""
        self._bullet.setJointMotorControlArray(
            self._arm,
            self._joints,
            self._bullet.POSITION_CONTROL,
            targetPositions=set_positions.tolist(),
            targetVelocities=set_velocities.tolist(),
            forces=self._forces,
            positionGains=self._gains,
            velocityGains=self._velocity_gains,
            physicsClientId=self._client,
        )
        self._bullet.stepSimulation(physicsClientId=self._client)
        states = self._bullet.getJointStates(self._arm, self._joints, physicsClientId=self._client)
        self.positions = np.array([state[0] for state in states])
        self.velocities = np.array([state[1] for state in states])
        self.efforts = np.array([state[3] for state in states])

    def flange(self) -> FloatArray:
        """Pose (4, 4) of the flange as the engine sees it, for checks against the closed form."""
        state = self._bullet.getLinkState(
            self._arm, self._count, computeForwardKinematics=True, physicsClientId=self._client
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
