"""Compilation of the numba kernels of a servo process (core, laws, planner, monitors): those that are compiled first,
those compiled by a separate process, and how a servo process loads the latter while its loop runs.

Kernels are compiled by running an example cell: an arm with two cameras runs some steps of each law; kernels are
specialised for types, not for sizes. The cameras have lens distortion, so that the lens kernels run, too. A file in
numba's cache records that all are compiled, from which sources, and with which signatures; the distribution
``stereoservo-kernels`` (``deploy/kernels``) contains another one.
``python -m stereoservo.daemon.kernel_compilation PARENT_PID [beside RUNTIME_DIRECTORY]`` compiles the missing kernels;
with ``beside`` while other processes work: niced, and reporting its progress.
"""

from __future__ import annotations

import fcntl
import gc
import importlib.util
import os
import pickle
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import llvmlite
import llvmlite.binding
import msgspec
import numba
import numpy as np

from stereoservo.control.faces import spaced_in_images
from stereoservo.control.incidence import (
    image_task,
    incidence_freedoms,
    incidence_step,
    incidence_task,
    limits_task,
)
from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.cartesian3 import cartesian_step
from stereoservo.control.marker_groups import with_groups
from stereoservo.control.mobility import mobility
from stereoservo.control.mobility_kernel import self_motion_from_limits
from stereoservo.core.cycle import ModelUpdate, StepInputs
from stereoservo.core.monitors.moving_camera import rehearse as rehearse_mobile
from stereoservo.core.prediction import camera_chi2, joint_step, joints_at, rows_of
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings
from stereoservo.core.sources.law import adaptive_gain
from stereoservo.core.state import Holding, IncidenceGoal
from stereoservo.daemon.process_control import die_with_parent
from stereoservo.geometry.distortion import distort
from stereoservo.geometry.screws import twist_matrix
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.kinematics.kernels import distort_pixel, project_points
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel, ModelCovariance
from stereoservo.messages.cell_file import Mount
from stereoservo.messages.compilation_progress import CompilationProgress, progress_path
from stereoservo.messages.files import write_atomically
from stereoservo.messages.goals import (
    DEFAULT_LAW,
    Command,
    Feature,
    FeatureTarget,
    Goal,
    IncidenceSpec,
    IncidenceTarget,
    Jog,
    JointTarget,
    PointSource,
    PointTarget,
    Request,
    RunGoal,
    UpdateGoal,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import load, overloads, report_compiled
from stereoservo.numerics.kernel_cache import KERNELS, SHIPPED, Overload, file_hash, shipped_folder
from stereoservo.planning.plan import PlanLimits, PlanRequest
from stereoservo.planning.planner import plan
from stereoservo.planning.tracking import advance, sample_plan
from stereoservo.ports.devices import CameraObservation, JointState

WIDTH, HEIGHT, FOCAL = 640, 480, 600.0
JOINTS = tuple(f"j{k}" for k in range(1, 7))
CAMERAS = ("left", "right")
MARKERS = tuple(range(6))
STEPS = 40  # a third of them execute a short plan
PERIOD_NS = 4_000_000
MODULE, RECORD, BESIDE, ALONE = "stereoservo.daemon.kernel_compilation", "record", "beside", "alone"
"""This module, and its second arguments: for the second part of its work, and for low priority."""
NICE = 10
"""Niceness of the process that compiles while cameras and arm work."""
KERNELS_IN_ALL = 300
"""Approximate number of signatures of the whole warm-up: only for progress reports."""
WAIT_S = 0.2
"""Interval of the checks whether another process has compiled [s]."""
LENS = np.array([-0.02, 0.5 * WIDTH, 0.5 * HEIGHT, 0.5 * WIDTH])


def warm_up_first() -> None:
    """Compile, or load, the kernels of a core without a model, for jogging, joint moves and trial motions.

    Laws of other distributions run as well, so that their kernels are not compiled in the loop.
    """
    model = example_model()
    pixels = _example_pixels(model)
    core = ServoCore(example_settings())
    jog = Request(1, "warmup", Jog({JOINTS[0]: 0.1}))
    move = Request(1, "warmup", RunGoal(Goal("00000000-0000", JointTarget({JOINTS[0]: 0.1}))))
    for step, request in enumerate((jog, jog, jog, move, move), 1):
        inputs = _inputs(step, pixels, model)
        core.step(
            msgspec.structs.replace(inputs, model_update=None, requests=(request,), driver_active=True, compiling=True)
        )
    rows_of(*(np.zeros(0, np.int64),) * 3)  # used at the stops of trials
    joints_at(core.state.history, 0)
    warm_up_laws(own=False)


def warm_up() -> None:
    """Run each law, the planner and fault isolation on the example cell, which compiles or loads their kernels.

    Kernels for goals in the images come first, rarely used ones last.
    """
    warm_up_laws()
    warm_up_planner()
    _warm_up_goals()
    _warm_up_agreement()
    warm_up_incidences()
    rehearse_mobile()
    for mount in ("eye_in_hand", "eye_to_hand"):
        _warm_up_following(mount)
    model = example_model()
    _warm_up_fault_isolation(model, _example_pixels(model))


def _warm_up_goals() -> None:
    """Run a core that accepts, plans and executes a goal by each law."""
    model = example_model()
    pixels = _example_pixels(model)
    seven = np.ones(7)  # a redundant arm's self-motion
    few, seen = (
        np.arange(len(MARKERS)),
        np.ones(pixels.shape[:2]),
    )  # a body of many markers, of which some are taken
    spaced_in_images(few, pixels, seen)
    spaced_in_images(few, pixels, seen, 3)
    distort_pixel(LENS, 1.0, 1.0)  # for set-points that are recomputed for a moved camera
    self_motion_from_limits(np.ones((8, 7)), 0.5 * seven, -seven, seven, 1.0)
    adaptive_gain(1.0, 2.0, 1.0, 1.0)
    joint_step(np.ones((8, 7)), np.ones(8), np.ones(8), 1.0)  # for joints that may differ from their readings
    camera_chi2(np.zeros((1, 2)), np.eye(2)[None], np.ones(1), 1.0)  # for frames that may be late
    runs: list[tuple[str, PointSource]] = [(DEFAULT_LAW, "triangulated")]
    runs.extend((law, "predicted") for law in LAWS)
    for law, points in runs:
        core = ServoCore(example_settings())
        target = FeatureTarget(
            {
                name: {
                    marker: (float(u) + 3.0, float(v) - 2.0) for marker, (u, v) in zip(MARKERS, pixels[c], strict=True)
                }
                for c, name in enumerate(CAMERAS)
            }
        )
        goal_id = "00000000-0000"
        for step in range(1, STEPS):
            command: Command | None = None
            if step == 5:
                command = RunGoal(Goal(goal_id, target, law=law, points=points))
            elif step == STEPS - 5:
                command = UpdateGoal(goal_id, target)
            elif step == STEPS - 3:
                points_now = zip(MARKERS, model.marker_points.tolist(), strict=True)
                body = PointTarget({marker: tuple(point) for marker, point in points_now}, model.epoch)
                command = RunGoal(Goal(f"{goal_id}-0001", body, check=True))
            requests = () if command is None else (Request(1, "warmup", command),)
            inputs = _inputs(step, pixels, model)
            core.step(msgspec.structs.replace(inputs, requests=requests, driver_active=True))


def _warm_up_agreement() -> None:
    """Run a core that reaches a goal with a model of stated accuracy: only then is the cameras' agreement checked."""
    plain, settings = example_model(), example_settings()
    pixels = _example_pixels(plain)
    matrices, lenses = [c.matrix for c in plain.cameras], [np.ones_like(c.lens) for c in plain.cameras]
    parts = (plain.generators, np.array(matrices), np.array(lenses), plain.marker_points)
    generators, cameras_free, lenses_free, points = (tuple(part[:, None]) for part in parts)
    free = sum(map(len, parts))
    model = msgspec.structs.replace(
        plain,
        covariance=ModelCovariance(generators, cameras_free, lenses_free, points, 1e-12 * np.eye(free)),
        joint_accuracy=JointAccuracy(*np.full((4, 6), 1e-6)),
    )
    cameras = tuple(msgspec.structs.replace(camera, mobile=False) for camera in settings.cameras)
    core = ServoCore(msgspec.structs.replace(settings, cameras=cameras, hold_frames=1))
    target = {name: _by_marker(MARKERS, seen) for name, seen in zip(CAMERAS, pixels, strict=True)}
    for step in range(1, STEPS):
        goal = RunGoal(Goal("00000000-0000", FeatureTarget(target)))
        requests = (Request(1, "warmup", goal),) if step == 5 else ()
        inputs = _inputs(step, pixels, model)
        core.step(msgspec.structs.replace(inputs, requests=requests, driver_active=True))
    if not isinstance(core.state.source, Holding):
        raise AssertionError("the example cell's goal was to be reached, and is not")


OTHERS = tuple(range(20, 26))
"""Markers of a target that the arm does not carry."""


def _warm_up_following(mount: Mount) -> None:
    """Run a core that follows a target: the body for cameras on the arm, another body for static cameras. The target is
    found, moves, jumps, and is transferred from the pose at which a goal was taught; then incidences follow it.
    """
    model, settings = msgspec.structs.replace(example_model(), mount=mount), example_settings()
    cameras = tuple(msgspec.structs.replace(c, mount=mount, mobile=False) for c in settings.cameras)
    settings = msgspec.structs.replace(settings, cameras=cameras)
    others = model.marker_points + np.array([0.15, 0.1, 0.1, 0.0])
    ids = MARKERS if mount == "eye_in_hand" else OTHERS
    shown = {name: _by_marker(OTHERS, seen) for name, seen in zip(CAMERAS, _seen(model, others), strict=True)}
    required = {name: _by_marker(MARKERS, seen) for name, seen in zip(CAMERAS, _example_pixels(model), strict=True)}
    at = tuple(float(height) for height in model.marker_points[0])
    corner = IncidenceSpec(
        "point-on-point", Feature(markers=(MARKERS[0],)), Feature(points=((at[0], at[1], at[2], at[3]),))
    )
    for follow_seen in ({}, shown)[: 1 if ids is MARKERS else 2]:
        core = ServoCore(settings)
        for step in range(1, STEPS):
            offset = np.array([1e-4 * step + (0.05 if step > STEPS // 2 else 0.0), 0.0, 0.0, 0.0])
            body = model.marker_points + (offset if ids is MARKERS else 0.0 * offset)
            pixels = np.concatenate([_seen(model, body), _seen(model, others + offset)], axis=1)
            inputs = _inputs(step, pixels, model, MARKERS + OTHERS)
            goal = Goal(
                "00000000-0000",
                FeatureTarget(required),
                law=DEFAULT_LAW,
                follow_markers=ids,
                follow_seen=follow_seen,
            )
            if step == STEPS - 6:
                target = IncidenceTarget((corner,), model_epoch=model.epoch)
                goal = Goal("00000000-0001", target, follow_markers=ids, follow_seen=follow_seen)
            requests = (Request(1, "warmup", RunGoal(goal)),) if step in (5, STEPS - 6) else ()
            core.step(msgspec.structs.replace(inputs, requests=requests, driver_active=True))
        if core.state.target is None or not isinstance(core.state.source, IncidenceGoal):
            raise AssertionError("the example cell was to follow a target, and does not")


def _by_marker(ids: tuple[int, ...], pixels: FloatArray) -> dict[int, tuple[float, float]]:
    return {marker: (float(u), float(v)) for marker, (u, v) in zip(ids, pixels, strict=True)}


def _warm_up_fault_isolation(model: CellModel, pixels: FloatArray) -> None:
    """Run the core on frames of a moved camera: only then does fault isolation run."""
    settings = example_settings()
    static_cameras = tuple(msgspec.structs.replace(camera, mobile=False) for camera in settings.cameras)
    core = ServoCore(msgspec.structs.replace(settings, cameras=static_cameras))
    moved = pixels + np.array([30.0, 0.0]) * np.array([1.0, 0.0])[:, None, None]
    for step in range(1, 12):
        core.step(_inputs(step, moved if step > 6 else pixels, model))
    if core.state.reanchoring is None:
        raise AssertionError("the example cell's camera was moved, and the core did not detect it")


def _inputs(step: int, pixels: FloatArray, model: CellModel, ids: tuple[int, ...] = MARKERS) -> StepInputs:
    """Inputs of a step: the arm at rest, a frame (c, m, 2) of every camera, the model in the second step."""
    now_ns = 1_000_000_000 + step * PERIOD_NS
    frames = tuple(_observation(name, ids, seen, step, now_ns) for name, seen in zip(CAMERAS, pixels, strict=True))
    return StepInputs(
        now_ns=now_ns,
        period_ns=PERIOD_NS,
        joints=JointState(step, now_ns, np.zeros(6), np.zeros(6)),
        observations=frames,
        model_update=ModelUpdate(model) if step == 2 else None,
    )


def _observation(camera: str, ids: tuple[int, ...], pixels: FloatArray, step: int, now_ns: int) -> CameraObservation:
    covariances = np.tile(0.01 * np.eye(2), (len(ids), 1, 1))
    shutter_ns = now_ns - PERIOD_NS // 2
    return CameraObservation(camera, step, shutter_ns, now_ns, np.array(ids), pixels.copy(), covariances)


def _example_pixels(model: CellModel) -> FloatArray:
    """Raw pixels (c, m, 2) of the markers."""
    return _seen(model, model.marker_points)


def _seen(model: CellModel, points: FloatArray) -> FloatArray:
    """Raw pixels (c, m, 2) of ``points`` (m, 4)."""
    return np.stack([distort(LENS, _project(camera.matrix, points)) for camera in model.cameras])


def _project(matrix: FloatArray, points: FloatArray) -> FloatArray:
    m = points @ matrix.T
    pixels: FloatArray = m[:, :2] / m[:, 2:]
    return pixels


def example_model() -> CellModel:
    axes = np.array([(0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0)], dtype=float)
    feet = np.array([(-0.8, 0, 1.6), (-0.7, 0, 1.5), (-0.4, 0, 1.5), (-0.2, 0, 1.4), (-0.1, 0, 1.3), (0, 0.05, 1.25)])
    generators = np.zeros((6, 4, 4))
    for generator, (x, y, z), foot in zip(generators, axes, feet, strict=True):
        generator[:3, :3] = [(0, -z, y), (z, 0, -x), (-y, x, 0)]
        generator[:3, 3] = -generator[:3, :3] @ foot
    K = np.array([(FOCAL, 0, 0.5 * WIDTH), (0, FOCAL, 0.5 * HEIGHT), (0, 0, 1)])
    left = K @ np.eye(3, 4)
    right = left.copy()
    right[:, 3] = K @ (-0.2, 0.0, 0.0)
    markers = np.array(
        [
            (0, 0, 1.2, 1),
            (0.1, 0, 1.2, 1),
            (0.1, 0.1, 1.2, 1),
            (0, 0.1, 1.22, 1),
            (0.05, 0.03, 1.25, 1),
            (0.02, 0.08, 1.3, 1),
        ]
    )
    return CellModel(
        schema=MODEL_SCHEMA,
        epoch=1,
        joint_names=JOINTS,
        joint_kinds=("revolute",) * 6,
        zero=np.zeros(6),
        generators=generators,
        cameras=(
            CameraModel("left", left, WIDTH, HEIGHT, LENS),
            CameraModel("right", right, WIDTH, HEIGHT, LENS),
        ),
        marker_ids=MARKERS,
        marker_points=markers,
        plane_at_infinity=np.array([0.0, 0.0, 0.0, 1.0]),
        stratum="metric",
        projective_to_euclidean=np.eye(4),
        statistics=None,
    )


def example_settings() -> CoreSettings:
    ones = np.ones(6)
    return CoreSettings(
        cell="warmup",
        joint_names=JOINTS,
        joint_kinds=("revolute",) * 6,
        cameras=tuple(
            CameraSettings(name, WIDTH, HEIGHT, 30.0, "eye_to_hand", MARKERS, mobile=True) for name in CAMERAS
        ),
        limits=LimitSettings(-2 * ones, 2 * ones, ones, 4 * ones, 0.01, np.zeros((0, 6, 2)), (), 0.5, 0.1, 1.0),
        trials=None,
        home=None,
        rate_hz=250.0,
        law=DEFAULT_LAW,
        points="predicted",
        gain=1.0,
        tolerance_px=0.1,
        hold_frames=10,
        time_limit_s=10.0,
        filter_s=0.2,
        gate_sigma=6.0,
    )


# -- what is compiled -------------------------------------------------------------------------------------------


class _Compiled(NamedTuple):
    """Content of the file in the cache."""

    machine: tuple[str, ...]
    sources: dict[str, tuple[int, int]]
    caches: dict[str, int]
    overloads: tuple[Overload, ...]


class ShippedRecord(NamedTuple):
    """Content of ``compiled.pickle`` of the installed kernels: compiler versions, source hashes by module,
    signatures.
    """

    made_by: tuple[str, ...]
    sources: dict[str, str]
    overloads: tuple[Overload, ...]

    @staticmethod
    def maker() -> tuple[str, ...]:
        """The ``made_by`` of kernels that this process can load."""
        return sys.implementation.cache_tag or "", platform.machine(), numba.__version__, llvmlite.__version__

    def rejection_reason(self) -> str:
        """Reason why these kernels cannot be used, as text; '' if they can."""
        if self.made_by != self.maker():
            return f"made by {' '.join(self.made_by)}, here are {' '.join(self.maker())}"
        for module, known in self.sources.items():
            spec = importlib.util.find_spec(module)
            if spec is None or file_hash(str(spec.origin)) != known:
                return f"made of another {module}"
        return ""


def _shipped() -> ShippedRecord | None:
    """The record of the installed kernels; None if there are none, or if another version wrote it."""
    folder = shipped_folder()
    if folder is None:
        return None
    try:
        return ShippedRecord(*pickle.loads((folder / "compiled.pickle").read_bytes()))
    except Exception:  # unpickling may raise anything
        return None


def _has_cache() -> bool:
    return cartesian_step.stats.cache_path is not None  # type: ignore[attr-defined]


def _record_path() -> Path:
    return Path(cartesian_step.stats.cache_path) / f"compiled-{sys.implementation.cache_tag}.pickle"  # type: ignore[attr-defined]


def _machine() -> tuple[str, ...]:
    return platform.python_version(), numba.__version__, llvmlite.binding.get_host_cpu_name()


def _stamp(file: str | Path) -> tuple[int, int]:
    """Modification time [ns] and size, by which numba detects that a file has changed; zeros if it does not exist."""
    try:
        status = os.stat(file)
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_size


def _count(folder: str) -> int:
    """Number of compiled kernels in a folder of the cache."""
    return sum(1 for _ in Path(folder).glob("*.nbc"))


def _lock_path() -> Path:
    return _record_path().with_suffix(".lock")


def compiled() -> tuple[Overload, ...] | None:
    """The signatures of all kernels, if all are cached or installed for the current sources and this computer; else
    None.
    """
    found = _cached_overloads()
    if found is None:
        shipped = _shipped()
        found = None if shipped is None or shipped.rejection_reason() else shipped.overloads
    return found


def _cached_overloads() -> tuple[Overload, ...] | None:
    try:
        record = _Compiled(*pickle.loads(_record_path().read_bytes()))  # in numba's cache, which is unpickled, too
    except Exception:  # missing or damaged: unpickling may raise anything
        return None
    if record.machine != _machine():
        return None
    if any(_stamp(source) != stamp for source, stamp in record.sources.items()):
        return None
    if any(_count(folder) < count for folder, count in record.caches.items()):
        return None
    return record.overloads


def record_compiled() -> None:
    """Load all kernels from the cache, and record there which of them a servo process loads.

    Must be called in a process that has compiled none, because a compiling process also holds kernels that only other
    kernels call. Laws of other distributions are not recorded: every servo process runs them before its loop.
    """
    warm_up()
    found = tuple(overload for overload in overloads() if overload.module.startswith("stereoservo."))
    kernels = [KERNELS[overload.module, overload.name] for overload in found]
    sources = {kernel.py_func.__code__.co_filename for kernel in kernels}
    folders = {kernel.stats.cache_path for kernel in kernels}
    record = _Compiled(
        _machine(),
        {source: _stamp(source) for source in sources},
        {folder: _count(folder) for folder in folders},
        found,
    )
    write_atomically(_record_path(), pickle.dumps(tuple(record)))


class KernelLoader:
    """Loads kernels that another process compiles while the loop runs: one at a time, because `advance` is called only
    while nothing moves and a cycle may be late.
    """

    CHECK_NS = 500_000_000
    PAUSE_NS = 20_000_000
    """Pause between two kernels [ns], in which commands are sent to the drives."""

    def __init__(self) -> None:
        self.loaded = False
        self._due_ns = 0
        self._loading: Iterator[None] | None = None
        self._record = _record_path()
        self._known = _stamp(self._record)

    def advance(self, now_ns: int) -> None:
        """Load the next kernel, if all are compiled and the pause is over."""
        if self.loaded or now_ns < self._due_ns:
            return
        if self._loading is None:
            self._due_ns = now_ns + self.CHECK_NS
            stamp = _stamp(self._record)
            if stamp != self._known:
                self._known = stamp
                found = compiled()
                self._loading = None if found is None else load(found)
            return
        self._due_ns = now_ns + self.PAUSE_NS
        if next(self._loading, self) is self:
            self.loaded = True
            gc.freeze()  # numba's objects are not scanned again by the collector: that would delay the loop


def kernels_to_come() -> KernelLoader | None:
    """The loader of the missing kernels; None if all are compiled, or if no cache is writable: then each process
    compiles its own.
    """
    if not _has_cache():
        return None
    loader = KernelLoader()
    return loader if compiled() is None else None


def wait_until_compiled(given_up: Callable[[], bool]) -> None:
    """Wait for the process that compiles into this cache, if there is one, or until ``given_up``."""
    lock = os.open(_lock_path(), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        while not given_up():
            with suppress(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            time.sleep(WAIT_S)
    finally:
        os.close(lock)


def report_progress(runtime: Path, part: str, daemon: int, total: int = 0) -> None:
    """Make this process report in a cell's runtime directory how many kernels it has compiled, of about ``total``."""
    path = progress_path(runtime, part)

    def report(done: int) -> None:
        with suppress(OSError):  # a full disk or a missing directory must not end the compilation
            path.write_bytes(msgspec.json.encode(CompilationProgress(part, daemon, done, total)))

    report_compiled(report)


def collect_seldom() -> None:
    """Reduce the frequency of garbage collection: numba's objects persist, and scanning them takes a twentieth of the
    compile time.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def main() -> int:
    """Entry of the process; its first argument is the parent's id."""
    die_with_parent(int(sys.argv[1]), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.argv[2:] == [RECORD]:
        record_compiled()
    elif _has_cache():
        if sys.argv[2:3] in ([BESIDE], [ALONE]):
            os.nice(NICE if sys.argv[2] == BESIDE else 0)
            report_progress(Path(sys.argv[3]), "rest", int(sys.argv[1]), KERNELS_IN_ALL)
        _wait_for_others()
        if compiled() is None:
            shipped = _shipped()
            if shipped is not None:
                print(f"{SHIPPED}: {shipped.rejection_reason()}; compiling instead", file=sys.stderr)
            collect_seldom()
            warm_up()
            with_groups(example_model())  # in fits and the gateway: no servo process loads these
            os.execv(sys.executable, [sys.executable, "-m", MODULE, sys.argv[1], RECORD])
    return 0


def _wait_for_others() -> None:
    """Acquire the lock by which only one process at a time compiles into this cache; held until the process ends."""
    lock = os.open(_lock_path(), os.O_RDWR | os.O_CREAT, 0o600)
    os.set_inheritable(lock, True)  # the lock is kept across exec
    fcntl.flock(lock, fcntl.LOCK_EX)


# -- kernels of laws -----------------------------------------------------------------------------------------
# Compilation of the numba kernels of control laws, incidences, mobility and self-motion: each runs once on an example
# arm, so that the servo loop compiles none.


def warm_up_laws(*, own: bool = True) -> None:
    """Compile, or load from numba's cache, the kernels of all laws, including limited rates; without ``own`` only those
    of other distributions.
    """
    operators = np.concatenate([twist_matrix(np.zeros(3), np.eye(3)), twist_matrix(np.eye(3), np.zeros(3))])
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    matrices = np.stack([K @ np.hstack([np.eye(3), np.array([[x], [0], [1.0]])]) for x in (0.1, -0.1)])
    centres = np.array([[-0.1, 0, -1, 1], [0.1, 0, -1, 1.0]])
    points = np.array([[0, 0, 0, 1], [0.1, 0, 0, 1], [0, 0.1, 0, 1.0]])
    targets = points + np.array([0.01, 0.02, 0.03, 0.0])
    pixels, required = project_points(matrices, points)[0], project_points(matrices, targets)[0]
    ones = np.ones((2, 3))
    scene = Scene(operators, int(Composition.BASE_FIRST), matrices, centres, points, pixels, ones)
    task = Task(
        required, ones, np.zeros_like(required), targets, np.ones(3), points.mean(axis=0), targets.mean(axis=0),
        np.arange(3),
    )  # fmt: skip
    for name, law in list(LAWS.items()):
        if not own and law.step.__module__.startswith("stereoservo."):
            continue
        try:
            law.step(scene, task, Options(1.0, 0.004, rotation_rate=1e-3, translation_rate=1e-3))
        except Exception as error:  # a third party's law that fails: listed with its error, the others continue
            LAWS.disable(name, f"its step raised {type(error).__name__}: {error}")


def warm_up_incidences() -> None:
    """Compile, or load from numba's cache, the kernels of incidences, mobility and self-motion."""
    operators = np.concatenate([twist_matrix(np.zeros(3), np.eye(3)), twist_matrix(np.eye(3), np.zeros(3))])
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    matrices = np.stack([K @ np.hstack([np.eye(3), np.array([[x], [0], [1.0]])]) for x in (0.1, -0.1)])
    points = np.array([[0, 0, 0, 1], [0.1, 0, 0, 1], [0, 0.1, 0, 1.0]])
    infinity = np.array([0, 0, 0, 1.0])
    pixels = np.einsum("cij,mj->cmi", matrices, points)
    pixels = pixels[..., :2] / pixels[..., 2:]
    centres = np.array([[-0.1, 0, -1, 1], [0.1, 0, -1, 1.0]])
    scene = Scene(operators, int(Composition.BASE_FIRST), matrices, centres, points, pixels, np.ones((2, 3)))
    task = incidence_task(
        ["plane-on-plane"],
        [[0, 1, 2]],
        [points + [0.0, 0.0, 0.01, 0.0] * np.array([[1], [2], [3]])],
        infinity,
        0.1,
    )
    positions = np.zeros(6)
    for second in (
        limits_task(positions, positions - 1.0, positions + 2.0, 0.5),
        image_task(operators, matrices, points, pixels, np.ones((2, 3)), 1.0),
    ):
        incidence_step(scene, task, Options(1.0, 0.004), second)
    slides = scene._replace(operators=operators[:3].copy())
    incidence_freedoms(slides, task, infinity, anywhere=True)
    mobility(slides.operators, matrices, points, infinity)
    self_motion_from_limits(np.zeros((12, 6)), positions, positions - 1.0, positions + 2.0, 0.5)


# -- kernels of the planner ----------------------------------------------------------------------------------
# Compilation of the path planner's numba kernels by planning example paths (straight, around a keep-out, unreachable),
# so that the servo loop compiles none.


AWAY = 0.2
"""Distance of the example goal [m]."""


def warm_up_planner() -> None:
    """Plan a straight path, detours around a keep-out and an unreachable goal; sample the first."""
    request = _request()
    found = plan(request).plan
    if found is None:
        raise RuntimeError("the example cell's straight path must be feasible")
    sample_plan(found, advance(found, 0.1, 0.004, 0.0))
    box = np.full((1, 6, 2), [-np.inf, np.inf])
    box[0, 0] = 0.4 * AWAY, 0.6 * AWAY
    box[0, 1, 0] = -0.03
    plan(_limited(request, keep_outs=box))
    beyond = np.full(6, np.inf)
    beyond[0] = 0.7 * AWAY
    plan(_limited(request, position_max=beyond))
    gantry = request.operators.copy()
    gantry[3:] = 0.0  # it cannot rotate: the refusal names the missing degree of freedom
    plan(msgspec.structs.replace(request, operators=gantry))
    plan(msgspec.structs.replace(request, targets=request.points, centre_target=request.centre))


def _limited(request: PlanRequest, **limits: FloatArray) -> PlanRequest:
    return msgspec.structs.replace(request, limits=msgspec.structs.replace(request.limits, **limits))


def _request() -> PlanRequest:
    start = np.array([-0.5 * AWAY, 0.0, 1.0])
    operators = np.zeros((6, 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        operators[k, k, 3] = 1.0
        operators[3 + k, j, i], operators[3 + k, i, j] = 1.0, -1.0
        operators[3 + k, j, 3], operators[3 + k, i, 3] = -start[i], start[j]
    camera = np.array([[600.0, 0.0, 320.0, 0.0], [0.0, 600.0, 240.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    matrices = np.stack([camera, camera])
    matrices[:, 0, 3] = 60.0, -60.0
    centres = np.array([[-0.1, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 1.0]])
    corners = 0.05 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    turned = np.stack([-corners[:, 1], corners[:, 0], corners[:, 2]], axis=1)
    aside = np.array([AWAY, 0.0, 0.0])
    return PlanRequest(
        operators=operators,
        composition=0,
        joints=np.zeros(6),
        matrices=matrices,
        camera_centres=centres,
        points=_of_height_1(start + corners),
        targets=_of_height_1(start + aside + turned),
        must_stay_visible=np.ones(4),
        centre=np.append(start, 1.0),
        centre_target=np.append(start + aside, 1.0),
        faces=np.array([[0, 1, 2]]),
        limits=PlanLimits(
            position_min=np.full(6, -np.inf),
            position_max=np.full(6, np.inf),
            velocity_max=np.ones(6),
            acceleration_max=np.full(6, 4.0),
            keep_outs=np.zeros((0, 6, 2)),
            sizes=np.array([[640.0, 480.0], [640.0, 480.0]]),
            lenses=np.array([[0.01, 320.0, 240.0, 320.0], [0.01, 320.0, 240.0, 320.0]]),
            view_margin_px=4.0,
        ),
    )


def _of_height_1(points: FloatArray) -> FloatArray:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


if __name__ == "__main__":
    sys.exit(main())
