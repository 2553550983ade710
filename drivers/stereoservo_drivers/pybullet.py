"""Drivers of the simulated cell: an arm in the physics engine pybullet, and cameras that render images.

pybullet itself is imported only by the arm, when it is configured: the servo process loads no image code, the camera
process no physics.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraDescription, DriverContext, DriverError, Frame
from stereoservo_drivers.options import decode_options
from stereoservo_drivers.simulated_arm import ArmOptions, SimulatedArm, cell_of_context
from stereoservo_drivers.simulated_camera import ArmByRow, CameraOptions, SimulatedCamera
from stereoservo_sim.world.lighting import Lighting
from stereoservo_sim.world.velocity_drives import Plant

if TYPE_CHECKING:
    from stereoservo_sim.world.rendering import Renderer

NonNegative = Annotated[float, Meta(ge=0)]


class PybulletJointOptions(ArmOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of the pybullet arm: the same as of every simulated arm."""


class PybulletJointDriver(SimulatedArm):
    """The simulated cell's arm in pybullet: rigid bodies, drives with limited acceleration, encoders."""

    driver = "pybullet"
    call_budget_us = 2000.0

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        decoded = decode_options(PybulletJointOptions, options, self.driver)
        cell = cell_of_context(options, context, self.driver)
        super().__init__(decoded, context, cell.robot.joints, cell.base, cell.robot)
        self._arm = cell.robot

    def make_plant(self, positions: FloatArray) -> Plant:
        """The arm in a physics engine of its own. Raises DriverError."""
        from stereoservo_sim.world.physics import PhysicsError, PybulletPlant

        try:
            return PybulletPlant(self._arm, positions, self.step_ns * 1e-9)
        except PhysicsError as error:
            raise DriverError("physics", str(error)) from error


class PybulletCameraOptions(CameraOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of a rendering camera. ``noise``: sigma [grey levels]; ``blur``: sigma of the lens [px]; ``lighting``:
    variation of the scene's light and of the exposure.
    """

    noise: NonNegative = 2.0
    blur: NonNegative = 0.7
    background: Literal["arm", "plain", "pybullet"] = "arm"
    lighting: Lighting | None = None


class PybulletCameraDriver(SimulatedCamera):
    """A camera of the simulated cell that delivers rendered grey images."""

    driver = "pybullet"
    call_budget_us = 10_000.0

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self._render = decode_options(PybulletCameraOptions, options, self.driver)
        super().__init__(self._render, context)
        self._renderer: Renderer | None = None

    def describe(self) -> CameraDescription:
        """Size and rate; delivers frames."""
        return self.describe_as("frames")

    def configure(self) -> None:
        """Load the renderer and draw once, so that no later frame waits for compilation. Raises DriverError."""
        super().configure()
        if self._renderer is None:
            self._renderer = self._redraw()
            self._renderer.render(self.cell.base, np.random.default_rng(0))

    def _redraw(self) -> Renderer:
        from stereoservo_sim.world.rendering import Renderer, RenderSettings

        options = self._render
        settings = RenderSettings(options.blur, options.noise, options.background, options.lighting)
        try:
            return Renderer(self.cell, self.camera, settings)
        except Exception as error:
            from stereoservo_sim.world.physics import PhysicsError  # loaded if the background is pybullet's

            if isinstance(error, PhysicsError):
                raise DriverError("physics", str(error)) from error
            raise

    def deliver(
        self, seq: int, t_shutter_ns: int, t_received_ns: int, arm: ArmByRow, rng: np.random.Generator
    ) -> Frame:
        """The image with the ``arm`` at its pose."""
        assert self._renderer is not None  # active: the lifecycle was checked
        if self._renderer.camera is not self.camera:  # the camera was bumped
            self._renderer = self._redraw()
        self._renderer.cell = self.cell  # its content may move
        return Frame(
            camera=self.name,
            seq=seq,
            t_shutter_ns=t_shutter_ns,
            t_received_ns=t_received_ns,
            image=self._renderer.render(
                arm.middle,
                rng,
                self.workpiece_pose(),
                focus=self.focus,
                at_row=arm.at if arm.moves else None,
                t_s=(t_shutter_ns - self._activated_ns) * 1e-9,
            ),
        )
