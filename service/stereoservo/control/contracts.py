"""Contract of control laws as a pytest suite for any law, third-party ones included: velocities are finite,
deterministic, independent of the projective frame and within given rates, and converge on a virtual two-camera cell.

Subclass `LawContract` in a test module and set ``law``; pytest runs the rest::

    class TestMine(LawContract):
        law = mine.LAW
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from stereoservo.control.law import Law, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import OPTIONS
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.screws import exp_twist, twist_matrix
from stereoservo.kinematics.composition import Composition, displacement, moved_operators
from stereoservo.numerics.arrays import FloatArray

PLATE = np.array([[-0.05, -0.05, 0, 1], [0.05, -0.05, 0, 1], [0.05, 0.05, 0, 1], [-0.05, 0.05, 0, 1.0]])
DT_S = 0.04


@dataclass
class VirtualCell:
    """A six-joint arm with a plate of four markers in front of two cameras, expressed in a projective frame.

    ``frame`` (4, 4) maps metric rig coordinates [m] to the frame in which the law works. The arm has three prismatic
    and three revolute joints, the latter through the plate's centroid; ``q`` (6,) are its joints.
    """

    frame: FloatArray
    q: FloatArray

    def __post_init__(self) -> None:
        focal = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
        cameras = [
            focal
            @ exp_twist(twist_matrix(np.zeros(3), np.array([0.0, -s * 0.17, 0.0])))[:3]
            @ exp_twist(twist_matrix(np.array([s * 0.1, 0.0, 0.0]), np.zeros(3)))
            for s in (1.0, -1.0)
        ]
        inverse = np.linalg.inv(self.frame)
        centre = np.array([0.0, 0.0, 1.1])
        joints = [twist_matrix(axis, np.zeros(3)) for axis in np.eye(3)]
        joints += [twist_matrix(-np.cross(axis, centre), axis) for axis in np.eye(3)]
        tilt = twist_matrix(np.zeros(3), np.array([0.2, -0.15, 0.3]))
        move = np.eye(4)
        move[:3, 3] = centre
        self.home = PLATE @ (move @ exp_twist(tilt)).T
        self.generators = self.frame @ np.array(joints) @ inverse
        self.matrices = np.ascontiguousarray(np.array(cameras) @ inverse)
        centres = np.array([[-s * 0.1, 0.0, 0.0, 1.0] for s in (1.0, -1.0)])
        self.camera_centres = centres @ self.frame.T

    def points(self, q: FloatArray) -> FloatArray:
        """Markers (4, 4) at joints ``q``, in the frame, of height 1."""
        return self.home @ self.frame.T @ displacement(self.generators, Composition.BASE_FIRST, q).T

    def scene(self, q: FloatArray, cameras: tuple[float, float] = (1.0, 1.0)) -> Scene:
        """The scene at joints ``q``; ``cameras`` are the weights [1/px] of their markers, 0 for a camera that sees
        nothing.
        """
        points = self.points(q)
        return Scene(
            moved_operators(self.generators, Composition.BASE_FIRST, q),
            int(Composition.BASE_FIRST),
            self.matrices,
            self.camera_centres,
            points,
            project_many(self.matrices, points),
            np.outer(cameras, np.ones(4)),
        )

    def task(self, scene: Scene, q_goal: FloatArray, *, known: bool = True) -> Task:
        """The goal of the plate at joints ``q_goal``; without ``known`` by its pixels alone, its pose unknown."""
        targets = self.points(q_goal)
        shown = targets if known else np.zeros_like(targets)
        return Task(
            project_many(self.matrices, targets), np.ones((2, 4)), np.zeros((2, 4, 2)), shown,
            np.full(4, float(known)), scene.points.mean(axis=0), shown.mean(axis=0), np.arange(3),
        )  # fmt: skip


def random_frame(rng: np.random.Generator) -> FloatArray:
    """A well-conditioned projective frame (4, 4)."""
    while True:
        frame: FloatArray = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
        if np.linalg.det(frame) > 0.2 and np.linalg.cond(frame) < 8.0:
            return frame


def error_px(scene: Scene, task: Task) -> float:
    """Largest distance [px] of a marker from its set-point over both cameras."""
    return float(np.sqrt(((scene.pixels - task.set_points) ** 2).sum(axis=-1)).max())


class LawContract:
    """Tests of a law: subclass it under pytest and set ``law``.

    Required: a well-formed and finite velocity, the same for the same input, independent of the projective frame,
    within the given rates, and descent to the goal in closed loop, with one camera too if the law declares it.
    """

    law: Law
    start_rad = 0.15
    """Largest initial displacement of each joint [rad or m]; a third of it for prismatic ones."""
    converged_px = 0.05
    steps = 400
    """Steps of `DT_S` with gain 1/s after which the error must be below ``converged_px``."""

    @pytest.fixture(params=[0, 1, 2])
    def cell(self, request: pytest.FixtureRequest) -> VirtualCell:
        """A random virtual cell whose goal is at joints zero."""
        rng = np.random.default_rng(request.param)
        amplitude = self.start_rad * np.array([1, 1, 1, 3, 3, 3]) / 3.0
        return VirtualCell(random_frame(rng), amplitude * rng.uniform(-1.0, 1.0, 6))

    def run(self, scene: Scene, task: Task, options: Options) -> LawStep:
        """One step of the law."""
        return self.law.step(scene, task, options)

    def problem(self, cell: VirtualCell, *, known: bool = True) -> tuple[Scene, Task]:
        """The scene at the start and the goal."""
        scene = cell.scene(cell.q)
        return scene, cell.task(scene, np.zeros(6), known=known)

    def test_its_description_is_whole(self) -> None:
        law = self.law
        assert isinstance(law, Law)
        assert law.summary.strip()
        assert "\n" not in law.summary
        assert set(law.options) <= set(OPTIONS)
        assert len(law.components) == len(law.units)

    @pytest.mark.parametrize("dt_s", [0.0, DT_S])
    def test_a_step_is_well_formed_and_finite(self, cell: VirtualCell, dt_s: float) -> None:
        step = self.run(*self.problem(cell), Options(1.0, dt_s))
        count = len(self.law.components)
        assert step.velocity.shape == (6,)
        assert step.velocity.dtype == np.float64
        assert np.isfinite(step.velocity).all()
        assert len(step.error) == len(step.allowed) == len(step.status) == count
        assert np.isfinite(step.conditioning)
        assert isinstance(self.law.reasons(step), tuple)

    def test_the_same_input_gives_the_same_bits_and_is_not_changed(self, cell: VirtualCell) -> None:
        scene, task = self.problem(cell)
        before = [np.array(value, copy=True) for value in (*scene, *task)]
        first = self.run(scene, task, Options(1.0, DT_S))
        kept = first.velocity.tobytes()
        other = VirtualCell(cell.frame, -cell.q)
        self.run(*self.problem(other), Options(0.5, DT_S))
        assert self.run(scene, task, Options(1.0, DT_S)).velocity.tobytes() == kept
        assert first.velocity.tobytes() == kept
        for old, new in zip(before, (*scene, *task), strict=True):
            np.testing.assert_array_equal(old, new)

    def test_the_command_does_not_depend_on_the_projective_frame(self, cell: VirtualCell) -> None:
        options = Options(1.0, DT_S, damping=0.0)
        velocities = [
            self.run(*self.problem(VirtualCell(frame, cell.q)), options).velocity for frame in (cell.frame, np.eye(4))
        ]
        np.testing.assert_allclose(velocities[0], velocities[1], rtol=0, atol=1e-6 * np.abs(velocities[1]).max())

    def test_it_reduces_its_own_error(self, cell: VirtualCell) -> None:
        """Finite differences along the velocity: the error decreases; for a law without components, the error in the
        images.
        """
        scene, task = self.problem(cell)
        step = self.run(scene, task, Options(1.0))
        assert np.abs(step.velocity).max() > 0.0
        small = 1e-4
        moved = cell.scene(cell.q + small * step.velocity)
        if self.law.components:
            after = self.run(moved, cell.task(moved, np.zeros(6)), Options(1.0)).error
            assert np.abs(after).sum() < np.abs(step.error).sum()
            assert (np.abs(after) <= np.abs(step.error) + 1e-6).all()
        else:
            gone = ((moved.pixels - task.set_points) ** 2).sum() - ((scene.pixels - task.set_points) ** 2).sum()
            assert gone < 0.0

    def test_it_rests_at_its_goal(self, cell: VirtualCell) -> None:
        scene = cell.scene(np.zeros(6))
        step = self.run(scene, cell.task(scene, np.zeros(6)), Options(1.0, DT_S))
        assert np.abs(step.velocity).max() < 1e-6

    @pytest.mark.parametrize("cameras", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
    def test_it_descends_in_closed_loop(self, cell: VirtualCell, cameras: tuple[float, float]) -> None:
        if 0.0 in cameras and self.law.one_camera == "refused":
            pytest.skip("the law declares that it needs two cameras")
        q = cell.q.copy()
        scene, task = self.problem(cell)
        first = error_px(scene, task)
        for _ in range(self.steps):
            scene = cell.scene(q, cameras)
            task = cell.task(scene, np.zeros(6))
            if error_px(scene, task) < self.converged_px:
                break
            q = q + DT_S * self.run(scene, task, Options(1.0, DT_S)).velocity
        assert first > 20 * self.converged_px
        left_px = error_px(scene, task)
        assert left_px < self.converged_px, f"{left_px:.3g} px are left after {self.steps} steps"

    def test_it_keeps_the_rates_that_it_is_given(self, cell: VirtualCell) -> None:
        scene, task = self.problem(cell)
        free = self.run(scene, task, Options(20.0, DT_S)).velocity
        turn, speed = self._rates(scene, task, free)
        limited = self.run(
            scene, task, Options(20.0, DT_S, rotation_rate=turn / 4, translation_rate=speed / 4)
        ).velocity
        allowed = 1.01 * max(1, len(self.law.components) - 1)
        found = self._rates(scene, task, limited)
        assert found[0] <= allowed * turn / 4
        assert found[1] <= 1.01 * speed / 4

    @staticmethod
    def _rates(scene: Scene, task: Task, velocity: FloatArray) -> tuple[float, float]:
        """Rotation rate [rad/s] of the body and speed of its centre in the frame's coordinates."""
        twist = np.tensordot(velocity, scene.operators, axes=1)
        return float(np.sqrt(max(0.0, -0.5 * np.trace(twist @ twist)))), float(np.linalg.norm(twist @ task.centre))

    def test_a_goal_without_a_pose_moves_only_laws_that_need_none(self, cell: VirtualCell) -> None:
        scene, task = self.problem(cell, known=False)
        velocity = self.run(scene, task, Options(1.0, DT_S)).velocity
        assert np.isfinite(velocity).all()
        if self.law.needs_pose:
            assert not velocity.any()
        else:
            assert velocity.any()
