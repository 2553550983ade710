"""Recordings with images used again: the same trials, the same model, goals, as the live cell had."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import TrialData, load_trials
from stereoservo.cli.calibrate.stored_trials import RecordedTrialCollector
from stereoservo.cli.main import invoke
from stereoservo.core.cycle import StepInputs, StepOutputs
from stereoservo.daemon.jobs.recorded_set_points import SetPointError, set_points_from_images
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.covariance import pixel_covariances, predicted_pixels
from stereoservo.messages.cell_file import CellFile, check_cell, load_cell_file
from stereoservo.messages.goals import Calibrate
from stereoservo.ports.devices import CameraDriver, CameraObservation, Frame
from stereoservo.ports.image_files import ImageLimits, ImageWriter
from stereoservo.recording.recorded_motion import read_motion, rest_intervals
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.world.simulated_cell import demo_cell

NAMES = tuple(f"j{k}" for k in range(1, 7))
LIMITS = (2.7, 2.3, 2.4, 4.7, 1.8, 4.7)


def fake_cell(**calibration: Any) -> CellFile:
    """The simulated arm without physics, before cameras without pictures."""
    tree = {
        "schema": 1,
        "cell": {"name": "replayed"},
        "joints": {"driver": "fake"},
        "camera": [{"name": name, "driver": "fake"} for name in ("left", "right")],
        "servo": {"rate_hz": 100.0},
        "safety": {
            "limit": [
                {"joint": n, "min": -m, "max": m, "velocity": 1.0, "acceleration": 4.0}
                for n, m in zip(NAMES, LIMITS, strict=True)
            ]
        },
        "calibration": {
            "base": dict(zip(NAMES, demo_cell().base.tolist(), strict=True)),
            "range": dict(zip(NAMES, (0.2, 0.2, 0.2, 0.5, 0.4, 0.6), strict=True)),
            "motion": "stops", "stops": 5, "frames": 2, "settle_s": 0.05, "speed_scale": 1.0, **calibration,
        },
    }  # fmt: skip
    return check_cell(tree)


@dataclass
class Flown:
    """A calibration in lockstep: what it gave live, and what was recorded."""

    recording: Path
    trials: TrialData
    observations: list[CameraObservation]


def pictured_cell(path: Path, stops: int) -> Path:
    """The demo's cell file with a plain background and few stops."""
    text = (resources.files("stereoservo_sim") / "cells" / "demo.toml").read_text()
    for old, new in (
        ('name = "demo"', 'name = "replayed"'),
        ('background = "pybullet"', 'background = "plain"'),
        ("stops = 9", f'motion = "stops"\nstops = {stops}'),
        ("frames = 4", "frames = 2"),
        ("rate_hz = 250.0", "rate_hz = 100.0"),
        ('driver = "pybullet"            # rigid', 'driver = "fake"  # rigid'),
        ("encoder = 1e-6", "# encoder = 1e-6"),
    ):
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)
    return path


def fly(tmp_path: Path, cell: CellFile, record: bool = False) -> Flown:
    """Trial motions in lockstep under the recorder, the cameras' pictures recorded, too, where ``record``."""
    recording = tmp_path / "flight.mcap"
    seen: list[CameraObservation] = []

    def watch(inputs: StepInputs, outputs: StepOutputs) -> None:
        seen.extend(inputs.observations)

    writers: list[ImageWriter] = []
    with LockstepCell(cell, cell_dir=tmp_path, runtime_dir=tmp_path, recording=recording, on_step=watch) as live:
        if record:
            (tmp_path / "flight.images").mkdir()
            writers = record_pictures(live, tmp_path / "flight.images")
        live.run_for(0.3)
        LockstepOperator(live).enable()
        assert live.submit(Calibrate("c" * 8)).accepted
        live.wait_for(lambda event: event.kind == "calibration_finished", 600.0)
        live.run_for(0.5)
    for writer in writers:
        writer.close()
    job = TrialCollector(live.settings)
    for event in live.events:
        job.add(event)
    return Flown(recording, job.trials(), seen)


def record_pictures(live: LockstepCell, images: Path) -> list[ImageWriter]:
    """Record all cameras of a cell in lockstep from now on."""
    writers = []
    for camera, description in zip(live.cameras, live.descriptions, strict=True):
        path = images / f"{description.name}.avi"
        size = description.width, description.height
        writers.append(ImageWriter(path, description.name, size, 30.0, limits=ImageLimits(keep_free_bytes=0)))
        tap(camera, writers[-1])
    return writers


def tap(camera: CameraDriver, writer: ImageWriter) -> None:
    """Have every frame that the driver delivers written."""
    poll = camera.poll

    def recorded() -> Any:
        arrived = poll()
        for frame in arrived:
            assert isinstance(frame, Frame)
            writer.append(frame)
        return arrived

    camera.poll = recorded  # type: ignore[method-assign]


def found_again(flown: Flown, observations: list[CameraObservation]) -> RecordedTrialCollector:
    flight = read_motion(flown.recording)
    assert flight.settings.trials is not None
    gathered = RecordedTrialCollector(flight, flight.settings, flight.settings.trials)
    for name in ("left", "right"):
        gathered.add(o for o in observations if o.camera == name and gathered.wants(name, o.t_shutter_ns))
    return gathered


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("flown"), fake_cell())


def test_the_stops_of_a_flight_are_found_from_its_joints_alone(flown: Flown) -> None:
    """Same stops, same frames, so the same pixels and joints to rounding; nothing else counts as a stop."""
    gathered = found_again(flown, flown.observations)
    events = gathered.events()
    assert [event.trial for event in events] == flown.trials.trials.tolist()
    joints = np.array([event.joints for event in events])
    np.testing.assert_allclose(joints, flown.trials.positions, rtol=0, atol=1e-9)
    for s, event in enumerate(events):
        for c, sample in enumerate(event.samples):
            np.testing.assert_allclose(sample.pixels, flown.trials.pixels[c, s], rtol=0, atol=1e-9)
    assert set(gathered.left_out) <= {"the arm was there before"}


@pytest.mark.slow
def test_a_spread_joint_is_no_second_joint(tmp_path: Path) -> None:
    spread = {"joint": "j6", "positions": 2, "range": 0.5}
    flown = fly(tmp_path, fake_cell(spread=spread, stops=4))
    events = found_again(flown, flown.observations).events()
    assert [event.trial for event in events] == flown.trials.trials.tolist()


def test_sweeps_are_found_from_the_joints_alone(tmp_path: Path) -> None:
    """The same joints sweep, on as many positions but for a few at the ends; and the model is as good."""
    flown = fly(tmp_path, fake_cell(motion="sweeps"))
    job = TrialCollector(read_motion(flown.recording).settings)
    for event in found_again(flown, flown.observations).events():
        job.add(event)
    trials = job.trials()
    joints, live = (np.bincount(of.trials + 1, minlength=7) for of in (trials, flown.trials))
    assert (joints[1:] >= 0.6 * live[1:]).all(), (joints, live)
    models = [fit_model(of, epoch=1).model for of in (trials, flown.trials)]
    q = flown.trials.positions.mean(axis=0) + np.random.default_rng(3).uniform(-0.1, 0.1, (20, 6))
    pixels = [predicted_pixels(model, q) for model in models]
    covariance = sum(pixel_covariances(model, q)[1] for model in models)
    sigmas = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    assert np.abs((pixels[0] - pixels[1]) / sigmas).max() < 5.0


def test_joints_moved_by_hand_are_no_rest(flown: Flown) -> None:
    """The core asks for zero velocity all the while; who pushes the arm ends the rest."""
    flight = read_motion(flown.recording)
    asleep = np.ones_like(flight.asked)
    resting = np.tile(flight.positions[0], (len(flight.positions), 1))
    pushed = resting.copy()
    middle = len(pushed) // 2
    pushed[middle:, 2] += np.minimum(np.arange(len(pushed) - middle) * 1e-3, 0.5)
    replace = {"now_ns": flight.now_ns, "step": flight.step, "joint_ns": flight.joint_ns}
    whole = type(flight)(flight.settings, **replace, asked=asleep, positions=resting, calibration_ns=-1)
    split = type(flight)(flight.settings, **replace, asked=asleep, positions=pushed, calibration_ns=-1)
    assert len(rest_intervals(whole, 0.05)) == 1
    before, after = rest_intervals(split, 0.05)
    assert before.end_ns < flight.joint_ns[middle + 20]
    assert after.begin_ns > flight.joint_ns[middle + 480]


def test_steps_that_are_missing_end_a_rest(flown: Flown) -> None:
    flight = read_motion(flown.recording)
    longest = max(rest_intervals(flight, 0.05), key=lambda rest: rest.end_ns - rest.begin_ns)
    inside = int(np.searchsorted(flight.now_ns, (longest.settled_ns + longest.end_ns) // 2))
    step = flight.step.copy()
    step[inside:] += 5
    holed = type(flight)(
        flight.settings,
        flight.now_ns,
        step,
        flight.asked,
        flight.joint_ns,
        flight.positions,
        flight.calibration_ns,
    )
    assert len(rest_intervals(holed, 0.05)) == len(rest_intervals(flight, 0.05)) + 1


def test_set_points_are_what_the_live_detector_saw(tmp_path: Path) -> None:
    """Half a second at rest in pictures: the mean of five frames of now, and refusals by their reasons."""
    path = pictured_cell(tmp_path / "cell.toml", 4)
    cell = load_cell_file(path)
    images = tmp_path / "flight.images"
    images.mkdir()
    seen: list[CameraObservation] = []
    with LockstepCell(
        cell, cell_dir=tmp_path, runtime_dir=tmp_path, on_step=lambda i, o: seen.extend(i.observations)
    ) as live:
        writers = record_pictures(live, images)
        live.run_for(0.3)
    for writer in writers:
        writer.close()
    found = set_points_from_images(path, images, 0.05, 5)
    assert [one.camera for one in found] == ["left", "right"]
    for one in found:
        mine = [o for o in seen if o.camera == one.camera]
        begin_ns = min(o.t_shutter_ns for o in seen)
        used = [o for o in mine if o.t_shutter_ns >= begin_ns + 50_000_000][:5]
        mean = np.mean([o.pixels for o in used], axis=0)
        assert one.at_s == pytest.approx((used[0].t_shutter_ns - begin_ns) * 1e-9)
        assert list(one.pixels) == used[0].ids.tolist()
        np.testing.assert_allclose(list(one.pixels.values()), mean, rtol=0, atol=1e-9)
        assert one.size == (640, 480)
    for at_s, frames, cause in ((0.2, 5, "fewer --frames"), (9.0, 5, "no frame is at 9.00 s")):
        with pytest.raises(SetPointError, match=cause):
            set_points_from_images(path, images, at_s, frames)
    with pytest.raises(SetPointError, match=r"none of left\.avi, right\.avi"):
        set_points_from_images(path, tmp_path, 0.0, 5)
    assert invoke(["goal", str(path), "--images", str(images), "--at", "9"]) == 1
    assert invoke(["goal", str(path), "park", "--images", str(images)]) == 1


@pytest.mark.slow
def test_a_calibration_from_pictures_is_the_live_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same stops, frames and pixels as the core had, out of the pictures; a model at the noise floor; and damage to
    any of the files is told.
    """
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / "run"))
    path = pictured_cell(tmp_path / "cell.toml", 5)
    flown = fly(tmp_path, load_cell_file(path), record=True)
    images = tmp_path / "flight.images"
    arguments = ["calibrate", str(path), "--images", str(images), "--json"]
    assert invoke(arguments) == 0
    result = msgspec.json.decode(capsys.readouterr().out)
    assert result["covariance_ok"]
    assert result["from_images"]["frames"] == flown.trials.images
    found = load_trials(images / "trials.npz")
    assert found.trials.tolist() == flown.trials.trials.tolist()
    assert found.marker_ids == flown.trials.marker_ids
    np.testing.assert_allclose(found.pixels, flown.trials.pixels, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.sigmas, flown.trials.sigmas, rtol=1e-6)
    np.testing.assert_allclose(found.positions, flown.trials.positions, rtol=0, atol=1e-9)

    def error() -> dict[str, Any]:
        assert invoke(arguments) == 1
        told: dict[str, Any] = msgspec.json.decode(capsys.readouterr().out)["error"]
        return told

    video = images / "right.avi"
    data = bytearray(video.read_bytes())
    data[len(data) // 2] ^= 0x55
    video.write_bytes(data)
    damaged = error()
    assert damaged["code"] == "crc"
    assert "right.avi" in damaged["message"]
    (tmp_path / "flight.mcap").rename(tmp_path / "other.mcap")
    assert "flight.mcap" in error()["message"]
