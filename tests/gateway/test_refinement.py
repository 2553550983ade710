"""On-line refinement in the gateway: what counts as a rest pose, what ends the collection, when a model is taken in,
what becomes of taught goals, and the way back.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest

from stereoservo.calibration.trial_data import LEAST_POSES
from stereoservo.core.cycle import Event, Sample, Status
from stereoservo.core.settings import CoreSettings
from stereoservo.daemon.jobs.rest_poses import LEAST_DISTANCE, MOST_POSES, RestPoses
from stereoservo.daemon.kernel_compilation import example_model, example_settings
from stereoservo.daemon.taught_goals import taught_goal
from stereoservo.gateway import model_updates, persistence
from stereoservo.gateway.goal_transfer import resolve
from stereoservo.gateway.model_updates import RefinementJobs
from stereoservo.gateway.persistence import ModelStore, TaughtStore
from stereoservo.kinematics.model import CellModel, load_model, save_model
from stereoservo.messages import files as files_module
from stereoservo.messages.check_report import RefinementReport
from stereoservo.messages.goals import TaughtTarget
from stereoservo.messages.status import Health, RefinementState
from stereoservo.messages.wire import MessageError, RunningGoals
from stereoservo.ports.devices import CameraObservation

STATE_NS, FRAME_NS = 50_000_000, 30_000_000
REPORT = RefinementReport(1, 16, 0.2, 0.1, 5.0, 3.1, 40.0, 90.0, 0.2, 0.1)


def settings_at_rest() -> CoreSettings:
    """Of a cell whose cameras stand."""
    settings = example_settings()
    cameras = tuple(msgspec.structs.replace(camera, mobile=False) for camera in settings.cameras)
    return msgspec.structs.replace(settings, cameras=cameras)


class Bench:
    """An arm in virtual time that shows states and frames to ``into``."""

    def __init__(self, into: Any, settings: CoreSettings, epoch: int = 1) -> None:
        self.into, self.settings, self.epoch = into, settings, epoch
        self.t_ns, self.seq = 0, 0
        self.q = np.zeros(len(settings.joint_names))
        self.source, self.health = "hold", Health("ok")

    def status(self, moves: bool) -> Status:
        n = len(self.q)
        names = [camera.name for camera in self.settings.cameras]
        return Status(
            t_ns=self.t_ns, step=0, lifecycle="active", model="valid", model_epoch=self.epoch, source=self.source,
            goal="", law="", level="ok", reasons=(), positions=self.q.copy(), velocities=np.zeros(n),
            command_raw=np.zeros(n), command=np.full(n, 0.1 if moves else 0.0), error_px=None,
            task_error=np.zeros(0), innovation_px=dict.fromkeys(names, 0.1), visible=dict.fromkeys(names, 4),
            health=self.health,
        )  # fmt: skip

    def run(self, seconds: float, *, moves: bool = False) -> None:
        """States at 20 Hz, frames at 33 Hz."""
        add_state = getattr(self.into, "on_state", getattr(self.into, "add_state", None))
        add_frame = self.into.add_frame
        end = self.t_ns + round(1e9 * seconds)
        while self.t_ns < end:
            self.t_ns += 10_000_000
            if self.t_ns % FRAME_NS == 0:
                self.seq += 1
                for camera in self.settings.cameras:
                    ids = np.array(camera.marker_ids[:4])
                    pixels = 100.0 + 10.0 * ids[:, None] + 50.0 * self.q[:2]
                    add_frame(
                        CameraObservation(
                            camera.name, self.seq, self.t_ns, self.t_ns + 1, ids, pixels,
                            np.tile(0.01 * np.eye(2), (len(ids), 1, 1)),
                        )
                    )  # fmt: skip
            if self.t_ns % STATE_NS == 0:
                add_state(self.status(moves))

    def visit(self, q: np.ndarray) -> None:
        """Go there, and stand for a second."""
        self.run(0.2, moves=True)
        self.q = q
        self.run(0.2, moves=True)
        self.run(1.0)


def test_a_rest_pose_counts_once_and_only_at_rest() -> None:
    settings = settings_at_rest()
    poses = RestPoses(settings)
    bench, n = Bench(poses, settings), len(settings.joint_names)
    bench.run(2.0, moves=True)
    bench.run(0.2)
    assert not poses.poses  # not settled, too few frames
    bench.visit(np.full(n, 0.1))
    bench.run(30.0)
    assert len(poses.poses) == 1
    assert sum(len(value) for value in vars(poses).values() if isinstance(value, list)) < 100  # no rest is long
    kept = poses.poses[0]
    assert kept.joints is not None
    assert kept.joints == pytest.approx(0.1)
    assert {sample.camera for sample in kept.samples} == {camera.name for camera in settings.cameras}
    for sample in kept.samples:  # no frame of the way there is in it
        assert sample.pixels == pytest.approx(100.0 + 10.0 * np.stack([sample.ids] * 2, 1) + 5.0)
    bench.visit(np.full(n, 0.1 + 0.1 * LEAST_DISTANCE / n))
    assert len(poses.poses) == 1
    bench.visit(np.full(n, -0.1))
    assert len(poses.poses) == 2
    assert poses.trials().positions.shape == (2, n)


def test_poses_are_bounded_and_far_apart() -> None:
    settings, rng = settings_at_rest(), np.random.default_rng(3)
    poses = RestPoses(settings)
    bench, n = Bench(poses, settings), len(settings.joint_names)
    for k in range(MOST_POSES + 40):  # the later ones crowd about one place
        bench.visit(rng.uniform(-1.0, 1.0, n) if k < MOST_POSES else 0.5 + rng.uniform(-0.03, 0.03, n))
    assert len(poses.poses) == MOST_POSES
    places = np.array([pose.joints for pose in poses.poses if pose.joints is not None])
    assert (np.abs(places - 0.5).max(axis=1) < 0.05).sum() <= 3


class Job:
    """A child process that has refined a model."""

    made: ClassVar[list[tuple[str, ...]]] = []

    def __init__(self, module: str, *arguments: str) -> None:
        self.made.append(arguments)
        base = load_model(Path(arguments[1]))
        better = msgspec.structs.replace(
            base, epoch=0, refined_from=base.epoch, cameras=tuple(
                msgspec.structs.replace(one, matrix=one.matrix + 1e-3 * (np.arange(12).reshape(3, 4) == 7))
                for one in base.cameras
            ),
        )  # fmt: skip
        save_model(better, Path(arguments[3]))

    def finished(self) -> bool:
        return True

    def require(self, key: str) -> Any:
        return msgspec.to_builtins(REPORT)

    def close(self) -> None:
        pass


class Gateway:
    """What of a gateway `RefinementJobs` talks to."""

    def __init__(self, folder: Path) -> None:
        self.settings = settings_at_rest()
        self.models = ModelStore(folder)
        self.base = msgspec.structs.replace(example_model(), epoch=1)
        save_model(self.base, self.models.path(1))
        self.sent: list[CellModel] = []
        self.told: list[Any] = []
        self.running: tuple[Any, ...] = ()
        self.calibration = SimpleNamespace(model=self.base, busy=False)
        self.taught = TaughtStore(folder / "taught.json")
        self.taught.add("park", taught_goal(self.shown(), self.base, "2026"))
        log = SimpleNamespace(add=lambda kind, **fields: self.told.append(SimpleNamespace(kind=kind, **fields)))
        self.connected = True
        link = SimpleNamespace(send_model=lambda model: self.sent.append(model) or self.connected)
        self.jobs = RefinementJobs(
            self.settings, True, self.models, link, log, self.calibration, SimpleNamespace(busy=False),  # type: ignore[arg-type]
            self.taught, lambda: RunningGoals(self.running),
        )  # fmt: skip
        self.bench = Bench(self.jobs, self.settings)

    def shown(self) -> Event:
        ids = np.array(self.base.marker_ids)
        sample = Sample(
            self.base.cameras[0].name, ids, np.arange(2.0 * len(ids)).reshape(-1, 2),
            np.tile(0.01 * np.eye(2), (len(ids), 1, 1)), 5, np.full(len(ids), 5.0), np.zeros(len(ids)),
        )  # fmt: skip
        return Event(1, 1, "taught", name="park", joints=np.zeros(len(self.base.joint_names)), samples=(sample,))

    def visit(self, count: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(count):
            self.bench.visit(rng.uniform(-1.0, 1.0, len(self.bench.q)))
            self.jobs.poll()


@pytest.fixture
def gateway(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Gateway:
    monkeypatch.setattr(model_updates, "ChildJob", Job)
    Job.made.clear()
    return Gateway(tmp_path)


def test_a_refined_model_is_taken_in_between_goals_and_undone(gateway: Gateway) -> None:
    before = gateway.taught.goals["park"]
    gateway.bench.source = "law"  # streams that never end: they rest, but the goal goes on
    gateway.visit(LEAST_POSES - 1)
    assert gateway.jobs.state() == RefinementState(LEAST_POSES - 1, LEAST_POSES)
    gateway.visit(4, seed=1)
    assert gateway.jobs.state() == RefinementState(LEAST_POSES + 3, 2 * LEAST_POSES, "waiting")
    assert len(Job.made) == 1
    assert not gateway.sent
    gateway.bench.source, gateway.running = "hold", ("queued",)
    gateway.bench.run(0.2)
    gateway.jobs.poll()
    assert not gateway.sent
    gateway.running = ()
    gateway.jobs.poll()
    assert [model.epoch for model in gateway.sent] == [2]
    assert not gateway.told  # until the core works with it
    gateway.bench.epoch = 2
    gateway.bench.run(0.2)
    assert [(e.kind, e.accepted) for e in gateway.told] == [("refined", True)]
    assert "0.1 px rms off instead of 0.2" in gateway.told[0].message
    refined = load_model(gateway.models.path(2))
    assert refined.refined_from == 1
    goal = gateway.taught.goals["park"]
    assert goal.target.set_points == before.target.set_points
    found = resolve(TaughtTarget("park"), goal, refined, {})
    assert (found.target, found.note) == (goal.target, "")  # no camera is taken for a moved one
    assert goal.target.model_epoch == 2
    state = gateway.jobs.state()
    assert state is not None
    assert (state.doing, state.refined_from) == ("collecting", 1)
    gateway.jobs.restore()
    assert gateway.jobs.state() == RefinementState(0, None)
    assert [model.epoch for model in gateway.sent] == [2, 3]
    assert np.array_equal(gateway.sent[-1].cameras[0].matrix, gateway.base.cameras[0].matrix)
    back = gateway.taught.goals["park"]
    assert msgspec.structs.replace(back.target, model_epoch=1) == before.target
    assert back.model is not None
    assert before.model is not None
    assert back.model.cameras == before.model.cameras
    gateway.bench.epoch = 3
    gateway.visit(2 * LEAST_POSES, seed=2)
    assert len(Job.made) == 1  # no more until the next calibration or start
    with pytest.raises(MessageError, match="nothing to undo"):
        gateway.jobs.restore()


def test_a_verdict_of_the_watch_ends_the_collection(gateway: Gateway) -> None:
    gateway.visit(LEAST_POSES - 1)
    gateway.bench.health = Health("camera_moved", ("left",), text="camera left has moved by 3 px")
    gateway.bench.run(0.2)
    assert [(e.kind, e.accepted, e.name) for e in gateway.told] == [("refined", False, "watch")]
    assert "camera left has moved by 3 px" in gateway.told[0].message
    gateway.visit(LEAST_POSES, seed=1)
    gateway.bench.health = Health("ok")
    gateway.visit(LEAST_POSES - 1, seed=2)
    assert not Job.made
    gateway.visit(1, seed=3)
    assert len(Job.made) == 1
    gateway.bench.health = Health("joint_zero", ("j1",), text="joint j1")
    gateway.bench.run(0.2)
    gateway.bench.health = Health("ok")
    gateway.bench.run(0.2)
    gateway.jobs.poll()
    assert not gateway.sent  # what was found with it is dropped, too


def test_a_model_that_the_servo_process_does_not_take_leaves_all_as_it_was(gateway: Gateway) -> None:
    before, gateway.connected = gateway.taught.goals, False
    gateway.visit(LEAST_POSES)
    for _ in range(2):
        gateway.jobs.poll()
    assert [model.epoch for model in gateway.sent] == [2]
    assert gateway.calibration.model is gateway.base
    assert gateway.models.epochs() == [1]
    assert gateway.taught.goals == before
    assert [(e.kind, e.accepted) for e in gateway.told] == [("refined", False)]
    gateway.connected = True
    gateway.visit(LEAST_POSES, seed=1)
    for _ in range(2):
        gateway.jobs.poll()
    assert [model.epoch for model in gateway.sent] == [2, 2]
    with pytest.raises(MessageError, match="just being taken in"):
        gateway.jobs.restore()  # the core still works with epoch 1
    gateway.bench.epoch = 2
    gateway.bench.run(0.2)
    gateway.connected = False
    with pytest.raises(MessageError, match="epoch 2 stays in use"):
        gateway.jobs.restore()
    assert gateway.models.epochs() == [1, 2]
    assert {goal.target.model_epoch for goal in gateway.taught.goals.values()} == {2}


class Crash(BaseException):
    """The process is killed."""


@pytest.mark.parametrize("way", ["refine", "refused", "undo", "refused undo"])
def test_a_crash_between_any_two_writes_leaves_model_and_goals_that_belong_together(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """Every change of a file is preceded by a crash once; at the next start no camera is taken for a moved one."""
    left = -1

    def dying(change: Any) -> Any:
        def changed(*given: Any, **named: Any) -> Any:
            nonlocal left
            if left == 0:
                raise Crash
            left -= 1
            return change(*given, **named)

        return changed

    gateway.visit(LEAST_POSES - 1)
    gateway.bench.visit(np.full(len(gateway.bench.q), 0.3))
    gateway.jobs.poll()  # the job has started
    if "undo" in way:
        for _ in range(2):
            gateway.jobs.poll()
        gateway.bench.epoch = 2
        gateway.bench.run(0.2)
    gateway.connected = "refused" not in way
    folder = gateway.models.path(1).parent
    files = {path: path.read_bytes() for path in folder.iterdir()}
    stands = vars(gateway.jobs).copy(), gateway.calibration.model, gateway.taught.goals

    def hand_over() -> bool:
        """Whether it was carried to its end."""
        try:
            if "undo" in way:
                gateway.jobs.restore()
            else:
                for _ in range(2):
                    gateway.jobs.poll()
        except Crash:
            return False
        except MessageError:
            return True
        return True

    found = set()
    ended, crashes = False, 0
    while not ended:
        left = crashes
        with monkeypatch.context() as patch:
            patch.setattr(files_module.os, "replace", dying(os.replace))
            patch.setattr(Path, "unlink", dying(Path.unlink))
            ended = hand_over()
        started = NextStart(gateway, folder)
        model = started.calibration.model
        found.add(model.epoch)
        goal = started.taught.goals["park"]
        assert goal.target.model_epoch == model.epoch, f"crash before write {crashes}"
        assert resolve(TaughtTarget("park"), goal, model, {}).note == ""
        assert TaughtStore(folder / "taught.json").goals == started.taught.goals
        crashes += 1
        if not ended:  # as before, once more
            for path in folder.iterdir():
                path.unlink()
            for path, data in files.items():
                path.write_bytes(data)
            vars(gateway.jobs).update(stands[0])
            gateway.calibration.model, gateway.taught.goals = stands[1:]
    assert crashes >= (5 if "refused" in way else 3)
    assert len(found) == 2


def test_goals_that_cannot_be_stored_at_the_next_start_are_good_in_memory(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = gateway.models.path(1).parent
    before = gateway.taught.goals
    gateway.visit(LEAST_POSES)
    for _ in range(2):
        gateway.jobs.poll()
    assert gateway.models.epochs() == [1, 2]
    gateway.taught.restore_goals(before)  # as if the crash had been before this file
    with monkeypatch.context() as patch:
        patch.setattr(persistence, "save_taught", _disk_is_full)
        started = NextStart(gateway, folder)
    assert started.taught.goals["park"].target.model_epoch == 2
    assert "No space left" in started.told[0].message
    assert NextStart(gateway, folder).told == []
    assert TaughtStore(folder / "taught.json").goals["park"].target.model_epoch == 2
    gateway.taught.restore_goals(before)
    gateway.models.path(1).unlink()
    started = NextStart(gateway, folder)
    assert started.taught.goals == before
    assert "model epoch 1" in started.told[0].message
    assert "teach" in started.told[0].message


def test_what_cannot_be_taken_back_is_whole_at_the_next_start(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, folder = gateway.taught.goals, gateway.models.path(1).parent
    save, writes = persistence.save_taught, 0

    def full_at_the_second(path: Path, goals: Any) -> None:
        nonlocal writes
        writes += 1
        save(path, goals) if writes == 1 else _disk_is_full()

    monkeypatch.setattr(persistence, "save_taught", full_at_the_second)
    gateway.connected = False
    gateway.visit(LEAST_POSES)
    for _ in range(2):
        gateway.jobs.poll()
    assert writes == 2
    assert gateway.taught.goals == before  # of the model that the core goes on with
    assert "No space left" in gateway.told[-1].message
    started = NextStart(gateway, folder)
    assert started.calibration.model.epoch == started.taught.goals["park"].target.model_epoch == 2


def _disk_is_full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class NextStart:
    """The gateway after a restart, with what the files say."""

    def __init__(self, before: Gateway, folder: Path) -> None:
        models, self.told = ModelStore(folder), list[Any]()
        model, passed = models.newest_fitting(before.settings)
        assert model is not None, passed
        self.calibration: Any = SimpleNamespace(model=model, busy=False)
        self.taught = TaughtStore(folder / "taught.json")
        log: Any = SimpleNamespace(add=lambda kind, **fields: self.told.append(SimpleNamespace(kind=kind, **fields)))
        link: Any = SimpleNamespace(send_model=lambda model: True)
        jobs = RefinementJobs(
            before.settings, False, models, link, log, self.calibration, link, self.taught, RunningGoals
        )
        jobs.complete_replacement()


def test_poses_after_a_verdict_are_judged_as_the_first_ones_were(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Job, "require", lambda *_: msgspec.to_builtins(REPORT) | {"score": None})
    gateway.visit(2 * LEAST_POSES)
    assert len(Job.made) == 2
    assert gateway.told  # a report without a score is told, and ends nothing
    assert not gateway.told[0].accepted
    gateway.bench.health = Health("camera_moved", ("left",), text="camera left has moved by 3 px")
    gateway.bench.run(0.2)
    gateway.bench.health = Health("ok")
    gateway.visit(LEAST_POSES, seed=1)
    assert len(Job.made) == 3


def test_nothing_is_refined_where_it_is_not_wanted_or_things_move(tmp_path: Path) -> None:
    settings = msgspec.structs.replace(example_settings(), body_moves=True)
    told: list[str] = []
    log = SimpleNamespace(add=lambda kind, **fields: told.append(fields["message"]))
    nothing: Any = SimpleNamespace(model=None, busy=False)
    jobs = RefinementJobs(
        settings,
        True,
        ModelStore(tmp_path),
        nothing,
        log,
        nothing,
        nothing,
        TaughtStore(tmp_path / "t.json"),
        RunningGoals,
    )
    assert "marker body moves by itself" in told[0]
    Bench(jobs, settings).run(2.0)
    jobs.poll()
    with pytest.raises(MessageError, match="not refined"):
        jobs.restore()
