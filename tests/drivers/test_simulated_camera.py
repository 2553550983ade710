"""Simulated cameras: when shutters open, what is shown, and what gets lost."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.fake import FakeCameraDriver, FakeJointDriver
from stereoservo_drivers.pybullet import PybulletCameraDriver
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell, simulated_cell
from stereoservo_sim.world.workpiece import Moved, MovedFile

MS = 1_000_000
CELL = demo_cell()


class Cell:
    """A fake arm and cameras in one process on a virtual clock."""

    def __init__(self, tmp_path, cameras, arm=True, shared=True):
        self.clock = VirtualClock()
        self.world = TrueJointHistory.in_memory(6)
        self.services = {"world": self.world} if shared else {}
        self.path = tmp_path
        self.arm = None
        if arm:
            self.arm = FakeJointDriver({}, self.context())
            self.arm.configure()
            self.arm.activate()
        self.cameras = [kind(options, self.context(options.get("view", "left"))) for kind, options in cameras]
        for camera in self.cameras:
            camera.configure()
            camera.activate()

    def context(self, camera=""):
        return DriverContext(self.clock, "t", self.path, self.path, camera, 1, self.services)

    def run(self, seconds, velocity=None, period_ns=4 * MS):
        items = [[] for _ in self.cameras]
        for _ in range(round(seconds * 1e9 / period_ns)):
            self.clock.advance_to(self.clock.now_ns() + period_ns)
            if self.arm is not None:
                self.arm.read_state()
                if velocity is not None:
                    self.arm.write_velocity(np.asarray(velocity))
            for k, camera in enumerate(self.cameras):
                items[k] += camera.poll()
        return items


def fake(**options):
    return FakeCameraDriver, options


def test_shutters_open_on_the_grid_and_frames_come_after_the_latency(tmp_path):
    cell = Cell(tmp_path, [fake(rate_hz=50.0, latency_s=0.01, phase_s=0.003)])
    (items,) = cell.run(1.0)
    assert len(items) == 50
    for item in items:
        assert item.t_shutter_ns % (20 * MS) == 3 * MS
        assert 10 * MS <= item.t_received_ns - item.t_shutter_ns < 14 * MS
    assert {b.seq - a.seq for a, b in pairwise(items)} == {1}


def test_markers_are_where_the_arm_was_at_the_shutter(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.0, latency_s=0.03)])
    (items,) = cell.run(1.0, velocity=[0.2, -0.1, 0.1, 0.3, 0.2, -0.5])
    moved = np.linalg.norm(items[-1].pixels[0] - items[0].pixels[0])
    assert moved > 20
    for item in items:
        truth = CELL.truth_pixels(cell.world.at(item.t_shutter_ns))["left"]
        assert item.ids.tolist() == list(range(14))
        assert np.abs(item.pixels - truth).max() < 1e-6


def test_each_row_of_a_rolling_shutter_shows_the_arm_at_its_own_time(tmp_path):
    readout_s, rows = 0.03, CELL.rig.cameras[0].height
    cell = Cell(tmp_path, [fake(noise_px=0.0, latency_s=0.03, readout_s=readout_s)])
    (items,) = cell.run(1.5, velocity=[0.2, -0.1, 0.1, 0.3, 0.2, -0.5])
    skews = []
    for item in items[20:]:
        for marker, pixel in enumerate(item.pixels):
            late_ns = round((pixel[1] / (rows - 1) - 0.5) * readout_s * 1e9)
            truth = CELL.truth_pixels(cell.world.at(item.t_shutter_ns + late_ns))["left"][marker]
            assert np.abs(pixel - truth).max() < 2e-3
            skews.append(np.linalg.norm(pixel - CELL.truth_pixels(cell.world.at(item.t_shutter_ns))["left"][marker]))
    assert max(skews) > 0.1  # what the shutter does is no rounding


def test_a_rolling_shutter_is_rendered_band_by_band(tmp_path):
    shutter = {"latency_s": 0.03, "readout_s": 0.03}
    drawn = PybulletCameraDriver, {"noise": 0.0, "background": "plain", **shutter}
    cell = Cell(tmp_path, [drawn, fake(noise_px=0.0, **shutter)])
    frames, items = cell.run(0.8, velocity=[0.2, -0.1, 0.1, 0.3, 0.2, -0.5])
    detector, frame, item = DotDetector({}, cell.context("left")), frames[-1], items[-1]
    found = detector.detect(frame, None)
    still = CELL.truth_pixels(cell.world.at(item.t_shutter_ns))["left"][found.ids]
    expected = item.pixels[np.searchsorted(item.ids, found.ids)]
    assert len(found.ids) == 14
    assert np.abs(found.pixels - expected).max() < 0.04  # a band sees all of its rows at once
    assert np.abs(still - expected).max() > 0.1


def test_a_rolling_shutter_that_ends_after_the_frame_is_there_is_refused(tmp_path):
    with pytest.raises(DriverError, match=r"readout_s: 0\.03; at most 0\.024"):
        Cell(tmp_path, [fake(latency_s=0.012, readout_s=0.03)])


def test_an_autofocus_that_breathes_swings_the_picture_about_its_centre(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.0, breathing=0.02, breathing_s=2.0)])
    (items,) = cell.run(2.5)
    centre = CELL.rig.cameras[0].K[:2, 2]
    truth = CELL.truth_pixels(CELL.base)["left"] - centre
    factors = []
    for item in items:
        factor = float((item.pixels - centre).ravel() @ truth.ravel() / (truth**2).sum())
        assert np.allclose(item.pixels - centre, factor * truth, atol=1e-9)
        factors.append(factor)
    assert max(factors) == pytest.approx(1.02, abs=1e-4)
    assert min(factors) == pytest.approx(0.98, abs=1e-4)


def test_a_picture_that_stands_still_does_not_breathe_and_is_that_of_one_time(tmp_path):
    options = {"noise_px": 0.0, "latency_s": 0.03, "freeze_after_s": 0.3}
    cell = Cell(tmp_path, [fake(**options, readout_s=0.03, breathing=0.02, breathing_s=1.7)])
    (items,) = cell.run(1.0, velocity=[0.2, -0.1, 0.1, 0.3, 0.2, -0.5])
    frozen = [item.pixels for item in items[-15:]]
    assert all(np.array_equal(pixels, frozen[0]) for pixels in frozen)


def test_noise_is_gaussian_with_the_declared_covariance(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.2, rate_hz=200.0)])
    (items,) = cell.run(2.0)
    errors = np.concatenate([item.pixels - CELL.truth_pixels(CELL.base)["left"] for item in items])
    assert len(errors) > 5000
    assert errors.std() == pytest.approx(0.2, rel=0.03)
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert np.allclose(items[0].covariances, np.eye(2) * 0.04)


def test_cameras_have_noise_of_their_own(tmp_path):
    cell = Cell(tmp_path, [fake(view="left"), fake(view="right"), fake(view="left", seed=77)])
    first, second, third = cell.run(0.2)
    truth = CELL.truth_pixels(CELL.base)
    errors = [
        first[0].pixels - truth["left"],
        second[0].pixels - truth["right"],
        third[0].pixels - truth["left"],
    ]
    assert not np.allclose(errors[0], errors[1])
    assert not np.allclose(errors[0], errors[2])


@pytest.mark.parametrize("kind", [FakeCameraDriver, PybulletCameraDriver])
def test_the_same_run_gives_the_same_data_bit_for_bit(tmp_path, kind):
    runs = []
    for _ in range(2):
        (items,) = Cell(tmp_path, [(kind, {"drop_rate": 0.3})]).run(0.5, velocity=np.full(6, 0.1))
        runs.append([(item.seq, (item.image if hasattr(item, "image") else item.pixels).tobytes()) for item in items])
    assert runs[0] == runs[1]
    assert 3 < len(runs[0]) < 14


def test_frames_get_lost_in_dropouts_and_blackouts(tmp_path):
    cell = Cell(tmp_path, [fake(dropouts=[[0.2, 0.5]])])
    start = cell.clock.now_ns()
    (items,) = cell.run(1.0)
    since = np.array([item.t_shutter_ns - start for item in items]) * 1e-9
    assert not np.any((since >= 0.2) & (since < 0.5))
    assert np.any(since < 0.2)
    assert np.any(since > 0.5)
    cell.cameras[0].blackout = True
    assert cell.run(0.3) == [[]]
    cell.cameras[0].blackout = False
    assert len(cell.run(0.3)[0]) >= 8


def test_markers_get_lost_at_the_given_rate(tmp_path):
    cell = Cell(tmp_path, [fake(marker_drop_rate=0.25, rate_hz=200.0)])
    (items,) = cell.run(2.0)
    seen = sum(len(item.ids) for item in items) / (14 * len(items))
    assert seen == pytest.approx(0.75, abs=0.03)


def test_a_frozen_picture_keeps_coming(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.0, freeze_after_s=0.3)])
    (items,) = cell.run(1.0, velocity=np.full(6, 0.2))
    late = [item for item in items if item.t_shutter_ns > 1_320 * MS]
    assert len(late) > 10
    assert all(np.array_equal(item.pixels, late[0].pixels) for item in late)
    assert np.abs(items[0].pixels - late[0].pixels).max() > 1


def test_a_marker_that_is_turned_away_is_not_delivered(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.0)])
    (items,) = cell.run(3.0, velocity=[0, 0, 0, 0, 0.9, 0])
    assert len(items[0].ids) == 14
    q = cell.world.at(items[-1].t_shutter_ns)
    expected = CELL.body.ids[CELL.visible(q, CELL.rig.camera("left"))]
    assert items[-1].ids.tolist() == expected.tolist()
    assert len(items[-1].ids) < 14


def test_before_the_arm_exists_it_is_shown_at_the_base(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.0)], arm=False, shared=False)
    (items,) = cell.run(0.2)
    assert np.allclose(items[-1].pixels, CELL.truth_pixels(CELL.base)["left"])


def test_an_arm_that_appears_later_and_restarts_is_followed(tmp_path):
    cell = Cell(tmp_path, [fake(noise_px=0.0)], arm=False, shared=False)
    cell.run(0.1)
    cell.arm = FakeJointDriver({}, cell.context())
    cell.arm.configure()
    cell.arm.activate()
    velocity = [0.1, 0, 0, 0, 0, 0.4]
    (items,) = cell.run(0.5, velocity)
    history = TrueJointHistory.open(tmp_path / FILE_NAME)
    truth = CELL.truth_pixels(history.at(items[-1].t_shutter_ns))["left"]
    assert np.abs(items[-1].pixels - truth).max() < 1e-6
    cell.arm.close()
    cell.arm = None
    silent = history.newest()[1]
    (items,) = cell.run(0.5)  # its process is gone: the picture stands
    assert np.abs(items[-1].pixels - CELL.truth_pixels(silent)["left"]).max() < 1e-6
    (tmp_path / FILE_NAME).unlink()
    cell.arm = FakeJointDriver({"start": {"j6": 0.3}}, cell.context())
    cell.arm.configure()
    (items,) = cell.run(0.5)
    expected = CELL.base.copy()
    expected[5] = 0.3
    assert np.abs(items[-1].pixels - CELL.truth_pixels(expected)["left"]).max() < 1e-6


def test_a_frame_waits_for_an_arm_that_is_a_little_late(tmp_path):
    """Polled before the arm has written its state of the shutter time, the camera delivers at the next
    poll.
    """
    cell = Cell(tmp_path, [fake(noise_px=0.0, latency_s=0.0, rate_hz=250.0)])
    camera = cell.cameras[0]
    cell.clock.advance_to(cell.clock.now_ns() + 4 * MS)
    cell.arm.read_state()
    camera.poll()
    cell.clock.advance_to(cell.clock.now_ns() + 4 * MS)
    assert camera.poll() == []
    cell.arm.read_state()
    (item,) = camera.poll()
    assert item.t_shutter_ns == cell.clock.now_ns()


@pytest.mark.parametrize(("mount", "k1"), [("eye_to_hand", -0.3), ("eye_in_hand", 0.0), ("eye_in_hand", -0.15)])
def test_lens_and_mount_of_the_cell_file_are_what_is_shown(tmp_path, mount, k1):
    """Fake and rendering camera alike, with the arm in motion: against OpenCV, by the arm's own kinematics."""
    cell = Cell(tmp_path, [], shared=True)
    cameras = []
    for kind, options in ((FakeCameraDriver, {"noise_px": 0.0}), (PybulletCameraDriver, {"noise": 0.0})):
        context = replace(cell.context("right"), mount=mount)
        cameras.append(kind({"k1": k1, **options}, context))
        cameras[-1].configure()
        cameras[-1].activate()
    cell.cameras = cameras
    observations, frames = cell.run(0.4, velocity=[0.1, -0.1, 0.1, 0.3, 0.2, -0.5])
    detector = DotDetector({}, cell.context("right"))
    simulated = simulated_cell(mount)
    camera = simulated.rig.camera("right")
    assert len(observations) == len(frames) > 8
    for observation, frame in zip(observations, frames, strict=True):
        q = cell.world.at(observation.t_shutter_ns)
        to_camera = camera.world_to_camera
        pose = simulated.flange(q)
        if mount == "eye_in_hand":
            pose = np.linalg.inv(pose) @ simulated.stand
        points = simulated.body.marker_points @ pose[:3, :3].T + pose[:3, 3]
        rotation, _ = cv2.Rodrigues(to_camera[:3, :3])
        lens = np.array([k1, 0, 0, 0.0])
        expected = cv2.projectPoints(points, rotation, to_camera[:3, 3], camera.K, lens)[0][:, 0]
        assert np.abs(observation.pixels - expected[observation.ids]).max() < 1e-6
        found = detector.detect(frame, None)
        assert len(found.ids) == 14
        assert np.abs(found.pixels - expected[found.ids]).max() < 0.02


def test_a_lens_that_leaves_corners_dark_is_refused(tmp_path):
    context = DriverContext(VirtualClock(), "t", tmp_path, tmp_path, "left")
    with pytest.raises(DriverError, match=r"k1: -0.7 leaves the corners .* dark; -0.591 or more is valid"):
        FakeCameraDriver({"k1": -0.7}, context)


def test_an_unknown_view_and_another_arm_are_refused(tmp_path):
    context = DriverContext(VirtualClock(), "t", tmp_path, tmp_path, "top")
    with pytest.raises(DriverError, match="no camera 'top' in the simulated rig; cameras: left, right"):
        FakeCameraDriver({}, context)
    camera = FakeCameraDriver({"view": "right"}, context)
    assert camera.describe().name == "top"
    arm = FakeJointDriver({"joints": [{"name": "a"}]}, context)
    arm.configure()
    camera.configure()
    camera.activate()
    context.clock.advance_to(2_000 * MS)
    with pytest.raises(DriverError, match="has 1 joints"):
        camera.poll()


def test_camera_that_is_bumped_sees_from_elsewhere_until_the_file_puts_it_back(tmp_path):
    bump = {"at_s": 0.5, "turn_deg": (0.0, 5.0, 0.0), "shift_m": (0.03, 0.0, 0.0)}
    cell = Cell(tmp_path, [fake(view="left", bumps=(bump,), noise_px=0.0)])
    before, after = cell.run(0.4)[0], cell.run(0.4)[0][-1]
    moved = CELL.camera("left", 0.0, Moved((0.03, 0.0, 0.0), (0.0, 5.0, 0.0)))
    truth = moved.image_of(CELL.marker_positions(CELL.base))[0]
    shown = np.searchsorted(CELL.body.ids, after.ids)
    assert np.abs(after.pixels - truth[shown]).max() < 1e-9
    MovedFile(tmp_path, "simulated-camera-left.json").write(Moved())
    back = cell.run(0.2)[0][-1]
    assert np.array_equal(back.pixels, before[-1].pixels)
    MovedFile(tmp_path, "simulated-camera-left.json").path.write_text("{")
    with pytest.raises(DriverError, match=r"simulated-camera-left.json: .*such a file holds"):
        cell.run(0.2)


def test_a_latency_told_wrongly_shifts_the_stamps_and_nothing_else(tmp_path):
    cell = Cell(tmp_path, [fake(latency_s=0.04), fake(latency_s=0.04, told_latency_s=0.03)])
    true, told = cell.run(0.5, [0.5, 0, 0, 0, 0, 0])
    assert len(true) == len(told) > 5
    for one, other in zip(true, told, strict=True):
        assert other.t_shutter_ns - one.t_shutter_ns == 10 * MS
        assert other.t_received_ns == one.t_received_ns
        assert (other.pixels == one.pixels).all()
