"""The drivers of the simulated cell keep the contracts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from stereoservo.ports.devices import CameraDriver, DriverContext, JointDriver
from stereoservo_drivers.contracts import CameraDriverContract, JointDriverContract
from stereoservo_drivers.fake import FakeCameraDriver, FakeJointDriver
from stereoservo_drivers.pybullet import PybulletCameraDriver, PybulletJointDriver
from stereoservo_sim.world.history import TrueJointHistory


class TestFakeArm(JointDriverContract):
    def make_driver(self, context: DriverContext) -> JointDriver:
        return FakeJointDriver({}, context)


class TestFakeGantry(JointDriverContract):
    def make_driver(self, context: DriverContext) -> JointDriver:
        joints = [
            {"name": "x", "kind": "prismatic", "min": -0.5, "max": 0.5, "velocity": 0.3, "acceleration": 1.0},
            {"name": "turn", "velocity": 2.0, "acceleration": 8.0},
        ]
        auxiliary = [
            {"name": "gripper", "kind": "prismatic", "low": 0.0, "high": 0.08, "velocity": 0.1},
            {"name": "light", "kind": "digital"},
        ]
        return FakeJointDriver({"joints": joints, "rate_hz": 500.0, "auxiliary": auxiliary}, context)


class TestPybulletArm(JointDriverContract):
    def make_driver(self, context: DriverContext) -> JointDriver:
        return PybulletJointDriver({}, context)


class TestPybulletArmInRealTime(JointDriverContract):
    real_time = True
    brake_s = 0.3

    def make_driver(self, context: DriverContext) -> JointDriver:
        return PybulletJointDriver({}, context)


class TestFakeCamera(CameraDriverContract):
    def make_driver(self, context: DriverContext) -> CameraDriver:
        return FakeCameraDriver({}, context)


class TestPybulletCamera(CameraDriverContract):
    def make_driver(self, context: DriverContext) -> CameraDriver:
        return PybulletCameraDriver({}, context)


class TestPybulletCameraInRealTime(CameraDriverContract):
    real_time = True
    camera_name = "right"

    def make_driver(self, context: DriverContext) -> CameraDriver:
        return PybulletCameraDriver({"rate_hz": 60.0}, context)


class TestFakeCameraOfASharedWorld(CameraDriverContract):
    """In one process the history may be an object; the arm has stood still since the clock began."""

    def make_context(self, tmp_path: Path) -> DriverContext:
        world = TrueJointHistory.in_memory(6)
        return replace(super().make_context(tmp_path), services={"world": world})

    def make_driver(self, context: DriverContext) -> CameraDriver:
        return FakeCameraDriver({}, context)
