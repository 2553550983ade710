"""A workpiece beside the moving body, through rendered images: "put this onto that" after it has been moved, incidences
on its markers, and goals that outlive a moved camera. Judged by the Euclidean truth.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.gateway.observation_cache import MarkerObservation, ObservationCache
from stereoservo.gateway.persistence import TaughtStore
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.gateway.publisher import EventLog
from stereoservo.gateway.teaching import TaughtGoalRegistry
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import CellFile, check_cell, load_cell_file
from stereoservo.messages.goals import Feature, IncidenceSpec, IncidenceTarget, JointTarget, TaughtTarget
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import Clock, DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.fake import FakeCameraDriver
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator, LockstepRefusalError
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.rendering import Renderer, RenderSettings
from stereoservo_sim.world.simulated_cell import DEMO_GOALS, workpiece_cell
from stereoservo_sim.world.workpiece import FILE_NAME, Motion, Moved, MovedFile, MovedFileError

CELL = workpiece_cell()
PART = CELL.workpiece
assert PART is not None
BODY, STANDING = tuple(range(14)), tuple(range(14, 28))
FILE = load_cell_file(shipped_cell_path("workpiece"))
NAMES = CELL.robot.joint_names
SHOWN = CELL.base + np.array([0.10, -0.10, 0.15, 0.30, -0.30, -0.40])
"""Where the goal is taught [rad]."""
MOVED = Moved((-0.031, 0.023, 0.022), (12.6, 6.2, 13.1))
"""44 mm and 19 degrees: the goal on the workpiece goes 155 mm away from where it was taught."""
TIMEOUT_S = 900
"""40 s on a quiet core; shared ones, and kernels that are compiled first, need a multiple."""
MM_PER_PX = 1e3 * 1.4**2 / (800.0 * 0.20)
"""What a pixel of disparity is in depth at the body, 1.4 m away: focal length 800 px, baseline 0.2 m."""


# -- the simulated workpiece ----------------------------------------------------------------------------------


def seen_apart(q: np.ndarray, pose: np.ndarray) -> bool:
    """Whether both cameras see every marker of body and workpiece, and their plates lie apart in the images."""
    for camera in CELL.rig.cameras:
        if not CELL.visible(q, camera).all() or not CELL.workpiece_visible(q, pose, camera).all():
            return False
        body, part = CELL.truth_pixels(q)[camera.name], camera.image_of(PART.marker_positions(pose))[0]
        gap = np.maximum(body.min(axis=0) - part.max(axis=0), part.min(axis=0) - body.max(axis=0))
        if gap.max() < 28.0:  # the plates reach 18 px and 12 px beyond their dots
            return False
    return True


def test_the_workpiece_hides_the_body_at_no_stop_and_no_goal() -> None:
    assert FILE.calibration is not None
    for index, name in enumerate(NAMES):
        for offset in np.linspace(-1, 1, FILE.calibration.stops) * FILE.calibration.range[name]:
            q = CELL.base.copy()
            q[index] += offset
            assert seen_apart(q, PART.stand), (name, offset)
    assert all(seen_apart(q, PART.stand) for q in (SHOWN, *DEMO_GOALS.values()))
    assert seen_apart(SHOWN, PART.pose(MOVED))
    points = PART.body.marker_points - PART.body.marker_points.mean(axis=0)
    assert np.linalg.svd(points)[1][2] > 0.01  # in no plane


def test_it_moves_about_its_own_middle_by_the_worlds_axes() -> None:
    pose = PART.pose(Moved((0.01, 0.02, 0.03), (0.0, 0.0, 90.0)))
    assert np.allclose(pose[:3, 3] - PART.stand[:3, 3], [0.01, 0.02, 0.03])
    assert np.allclose(pose[:3, 0], [-PART.stand[1, 0], PART.stand[0, 0], PART.stand[2, 0]])
    assert np.array_equal(PART.pose(Moved()), PART.stand)


def test_a_turntable_turns_it_about_an_axis_beside_it() -> None:
    table = Motion(turn_rate_deg_s=(0.0, 0.0, 30.0), about_m=(0.1, 0.0, 0.0), since_ns=0)
    for t_s in (0.0, 1.0, 3.0):
        pose = PART.pose(table.at(round(t_s * 1e9)))
        angle = np.deg2rad(30.0 * t_s)
        R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        np.testing.assert_allclose(pose[:3, :3], R @ PART.stand[:3, :3], atol=1e-12)
        centre = PART.stand[:3, 3] + (0.1, 0.0, 0.0)
        np.testing.assert_allclose(pose[:3, 3], centre + R @ (-0.1, 0.0, 0.0), atol=1e-12)


def test_the_file_moves_it_and_nonsense_is_refused_with_what_would_be_valid(tmp_path: Path) -> None:
    file = MovedFile(tmp_path)
    assert file.now() == Moved()
    MovedFile(tmp_path).write(MOVED)
    assert file.now() == MOVED
    (tmp_path / FILE_NAME).write_text('{"shift_m": [0.02, 0, 0.01], "turn_deg": [0, 0, 15]}\n')  # as from a shell
    assert file.now() == Moved((0.02, 0.0, 0.01), (0.0, 0.0, 15.0))
    for text in (
        "",
        "[1, 2]",
        '{"shift_m": [0.1, 0.2]}',
        '{"shift_mm": [1, 2, 3]}',
        '{"shift_m": [11, 0, 0]}',
    ):
        (tmp_path / FILE_NAME).write_text(text)
        with pytest.raises(MovedFileError, match=r"simulated-workpiece.json: .*such a file holds"):
            file.now()
    (tmp_path / FILE_NAME).unlink()
    assert file.now() == Moved()
    with pytest.raises(ValueError, match="finite"):
        file.write(Moved((float("nan"), 0.0, 0.0)))


def context(path: Path, mount: Any = "eye_to_hand") -> DriverContext:
    return DriverContext(VirtualClock(), "t", path, path, "left", 1, {}, mount)


@pytest.mark.parametrize(
    ("options", "mount", "why"),
    [
        ({"workpiece": True}, "eye_in_hand", "before standing cameras only"),
        ({"moved": {"shift_m": [float("nan"), 0.0, 0.0]}}, "eye_to_hand", "moved"),
        ({"moved": {"turn_deg": [200.0, 0.0, 0.0]}}, "eye_to_hand", "moved"),
    ],
)
def test_options_that_cannot_be_are_refused(tmp_path: Path, options: Any, mount: Any, why: str) -> None:
    with pytest.raises(DriverError, match=why):
        FakeCameraDriver(options, context(tmp_path, mount))


def test_a_moved_camera_sees_from_there() -> None:
    left = CELL.rig.camera("left")
    moved = CELL.camera("left", 0.0, Moved((0.05, 0.0, 0.0)))
    assert np.allclose(moved.centre - left.centre, 0.05 * left.world_to_camera[0, :3])
    turned = CELL.camera("left", 0.0, Moved(turn_deg=(0.0, 0.0, 90.0)))  # about its own line of sight
    points = CELL.marker_positions(CELL.base)
    u, v = (left.image_of(points)[0] - left.K[:2, 2]).T
    assert np.allclose(turned.image_of(points)[0] - left.K[:2, 2], np.stack([v, -u], axis=1))


@pytest.mark.parametrize("pose", [PART.stand, PART.pose(MOVED)], ids=["stands", "moved"])
def test_the_detector_finds_it_where_it_is_with_and_without_a_prior_of_the_body(
    tmp_path: Path, pose: np.ndarray
) -> None:
    """The prior says nothing of the workpiece, and yet it is seen."""
    for camera in CELL.rig.cameras:
        image = Renderer(CELL, camera, RenderSettings()).render(SHOWN, np.random.default_rng(3), pose)
        frame = Frame(camera.name, 1, 0, 0, image)
        body = CELL.truth_pixels(SHOWN)[camera.name]
        prior = Prior(camera.name, 0, np.arange(14), body + 0.5, np.zeros((14, 2)), np.tile(np.eye(2), (14, 1, 1)))
        truth = np.concatenate([body, camera.image_of(PART.marker_positions(pose))[0]])
        detector = DotDetector({"beside": ["c", "d"]}, context(tmp_path))
        assert detector.describe().marker_ids == (*BODY, *STANDING)
        for known in (None, prior):
            found = detector.detect(frame, known)
            assert found.ids.tolist() == [*BODY, *STANDING]
            assert np.linalg.norm(found.pixels - truth, axis=1).max() < 0.03
        assert DotDetector({}, context(tmp_path)).detect(frame, prior).ids.tolist() == list(BODY)
    with pytest.raises(DriverError, match="no face 'z' is printed; there are a, b, c, d"):
        DotDetector({"beside": ["z"]}, context(tmp_path))
    with pytest.raises(DriverError, match="used twice"):
        DotDetector({"beside": ["a"]}, context(tmp_path))


# -- in closed loop -------------------------------------------------------------------------------------------


def workpiece_file(*, images: bool, **moved: Any) -> CellFile:
    """The shipped cell, shorter trial motions; ``images``: rendered, fewer than it has. ``moved``: cameras, by name."""
    tree = tomllib.loads(shipped_cell_path("workpiece").read_text())
    tree["calibration"] |= {"stops": 5, "frames": 2, "speed_scale": 1.0}
    tree["servo"]["hold_frames"] = 6
    tree["joints"] = {"driver": "fake"}
    for camera in tree["camera"]:
        if images:
            camera["options"] |= {"background": "arm", "rate_hz": 12.0}
        else:
            camera["driver"], camera["options"] = "fake", {"noise_px": 0.01, "workpiece": True}
            del camera["detector"], camera["detector_options"]
        if camera["name"] in moved:
            camera["options"]["moved"] = moved[camera["name"]]
    return check_cell(tree)


class VirtualSights(ObservationCache):
    """What the cameras see now, by the clock of the cell instead of the gateway's."""

    def __init__(self, systematic_px: dict[str, float], clock: Clock) -> None:
        super().__init__(systematic_px)
        self._clock = clock

    def now(self, now_ns: int) -> dict[str, dict[int, MarkerObservation]]:
        return super().now(self._clock.now_ns())


class Bench:
    """A cell in lockstep with the gateway's teaching beside it, and the truth about its arm."""

    def __init__(self, file: CellFile, path: Path, model: CellModel | None = None) -> None:
        self.history = TrueJointHistory.in_memory(6, capacity=1 << 16)
        self.truth = true_cell(file)
        self.cell = LockstepCell(
            file, cell_dir=path, runtime_dir=path, services={"world": self.history}, on_step=self._heed
        )
        self.sights = VirtualSights({d.name: d.systematic_px for d in self.cell.descriptions}, self.cell.clock)
        self.model = model
        self.store = TaughtStore(path / "taught.json")
        self.teaching = TaughtGoalRegistry(self.store, self.sights, lambda: self.model, EventLog("b", lambda _: None))
        self.operator = LockstepOperator(self.cell)
        self.operator._epoch = 0 if model is None else model.epoch
        self.workpiece = MovedFile(path)

    def _heed(self, inputs: Any, _: Any) -> None:
        for observation in inputs.observations:
            self.sights.add(observation)

    def calibrate(self) -> CellModel:
        self.cell.run_for(0.5)
        self.operator.enable()
        self.model = self.operator.calibrate()
        return self.model

    def go(self, target: Any, **options: Any) -> np.ndarray:
        """Run a goal to its end and a little longer; where the arm truly is."""
        end = self.operator.goal(target, **options)
        assert end.kind == "goal_reached", end
        self.cell.run_for(0.5)
        newest = self.history.newest()
        assert newest is not None
        return newest[1]

    def show(self, q: np.ndarray, name: str) -> np.ndarray:
        """Teach goal ``name`` at joints ``q``; where the arm truly was."""
        there = self.go(JointTarget(dict(zip(NAMES, q.tolist(), strict=True))))
        self.teaching.taught(self.operator.teach(name))
        return there

    def rigid_error(self, there: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
        """Largest distance of the body's markers at joints ``there`` from ``expected`` (m, 3): [mm], [px]."""
        found = self.truth.marker_positions(there)
        pixels = [
            np.linalg.norm(c.image_of(found)[0] - c.image_of(expected)[0], axis=1) for c in self.truth.rig.cameras
        ]
        return float(1e3 * np.linalg.norm(found - expected, axis=1).max()), float(np.max(pixels))


def stated_px(note: str) -> float:
    """The largest standard deviation of a set-point, as a resolved goal's note states it [px]."""
    found = re.search(r"set-points known to ([\d.]+) px", note)
    assert found is not None, note
    return float(found.group(1)) + 0.005  # it is rounded


def along(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (m, 3) that stood about the workpiece, after it was moved to ``pose``."""
    displacement = pose @ np.linalg.inv(PART.stand)
    return points @ displacement[:3, :3].T + displacement[:3, 3]


@pytest.mark.timeout(TIMEOUT_S)
@pytest.mark.parametrize("images", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_goal_on_a_workpiece_that_has_moved_is_reached_there(tmp_path: Path, images: bool) -> None:
    """Calibrated beside it, taught, moved, reached; then a marker into a plane of it. ``images``: as rendered."""
    bench = Bench(workpiece_file(images=images), tmp_path)
    with bench.cell:
        model = bench.calibrate()
        assert set(model.marker_ids) == set(BODY)  # what stands is left out
        taught = bench.show(SHOWN, "put")
        goal = bench.teaching.goals["put"]
        assert set(goal.target.set_points["left"]) == set(BODY)
        assert set(goal.others["left"]) == set(STANDING)
        bench.workpiece.write(MOVED)
        bench.cell.run_for(0.2)
        with pytest.raises(TransferError, match="move now"):
            bench.teaching.resolve(TaughtTarget("put", "workpiece"))
        bench.cell.run_for(1.0)

        resolved = bench.teaching.resolve(TaughtTarget("put", "workpiece"))
        expected = along(PART.pose(MOVED), bench.truth.marker_positions(taught))
        assert np.linalg.norm(expected - bench.truth.marker_positions(taught), axis=1).min() > 0.1
        sigma = stated_px(resolved.note)
        assert sigma < 0.3, resolved.note
        for camera in bench.truth.rig.cameras:
            wanted = resolved.target.set_points[camera.name]
            right = camera.image_of(expected)[0]
            away = np.array([wanted[marker] for marker in BODY]) - right
            assert np.abs(away).max() < 5.0 * sigma

        there = bench.go(resolved.target, law="cartesian3")
        mm, px = bench.rigid_error(there, expected)
        bound = FILE.servo.tolerance_px + 5.0 * sigma
        assert px < np.sqrt(2.0) * bound
        assert mm < bound * MM_PER_PX

        point_on_plane(bench, there)


def point_on_plane(bench: Bench, before: np.ndarray) -> None:
    """Marker 5 goes into the plane of three markers of the workpiece that stands where it was moved to."""
    spec = IncidenceSpec("point-on-plane", Feature(markers=(5,)), Feature(markers=(15, 21, 24)))
    target, _ = bench.teaching.resolve_incidence(IncidenceTarget((spec,)))
    assert set(target.incidences[0].fixed.pixels) == {"left", "right"}
    there = bench.go(target)
    corners = PART.marker_positions(PART.pose(MOVED))[[1, 7, 10]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)

    def height(q: np.ndarray) -> float:
        return float((bench.truth.marker_positions(q)[5] - corners[0]) @ normal)

    assert abs(height(before)) > 0.05
    # Barycentric coordinates of the marker say how much the plane, known by three small dots, is stretched to it; a
    # dot, 1 m away, is known to 0.005 px, or 1 / (800 · 0.2) m a pixel, and the body as well as the tolerance asks.
    weights = np.linalg.lstsq(
        np.vstack([corners.T, np.ones(3)]), np.append(bench.truth.marker_positions(there)[5], 1.0), rcond=None
    )[0]
    sigma = np.linalg.norm(weights) * np.sqrt(2.0) * 0.005 / (800.0 * 0.2)
    assert abs(height(there)) < 5.0 * sigma + 1e-3 * FILE.servo.tolerance_px * MM_PER_PX


@pytest.mark.slow
@pytest.mark.timeout(TIMEOUT_S)
def test_a_goal_outlives_a_camera_that_was_moved(tmp_path: Path) -> None:
    """Taught with one rig, sent relative to the cameras after one of them was moved and the cell calibrated anew."""
    first = Bench(workpiece_file(images=False), tmp_path)
    with first.cell:
        old = first.calibrate()
        taught = first.show(SHOWN, "put")
    moved = {"shift_m": [0.05, -0.02, 0.03], "turn_deg": [1.0, -2.0, 4.0]}
    second = Bench(workpiece_file(images=False, right=moved), tmp_path, old)
    expected = second.truth.marker_positions(taught)
    away = [
        np.linalg.norm(a.image_of(expected)[0] - b.image_of(expected)[0], axis=1).min()
        for a, b in zip(first.truth.rig.cameras, second.truth.rig.cameras, strict=True)
    ]
    assert away[0] == 0.0
    assert away[1] > 10.0
    with second.cell:
        new = second.calibrate()
        assert new.epoch == old.epoch + 1
        with pytest.raises(LockstepRefusalError, match=f"taught with model epoch {old.epoch}"):
            # without a word about what has changed, its pixels mean nothing any more
            second.go(second.teaching.resolve(TaughtTarget("put")).target)
        resolved = second.teaching.resolve(TaughtTarget("put", "cameras"))
        sigma = stated_px(resolved.note)
        mm, px = second.rigid_error(second.go(resolved.target), expected)
        bound = FILE.servo.tolerance_px + 5.0 * sigma
        assert px < np.sqrt(2.0) * bound
        assert mm < bound * MM_PER_PX
