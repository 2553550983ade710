"""A Euclidean arm and stereo pair, conjugated into a random projective frame: the core's independent truth.

The pair stands before the arm that carries the markers, or rides on it before markers that stand; its lenses may bend.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from stereoservo.control.marker_groups import with_groups
from stereoservo.core.cycle import Event, ModelUpdate, StepInputs, StepOutputs
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.settings import CameraSettings, CoreSettings, LimitSettings, TrialSettings
from stereoservo.geometry.distortion import distort
from stereoservo.kinematics.model import MODEL_SCHEMA, CameraModel, CellModel, FitStatistics
from stereoservo.messages.cell_file import Mount
from stereoservo.messages.goals import (
    Command,
    DisplacementTarget,
    Goal,
    PointTarget,
    Request,
    RunGoal,
    Target,
)
from stereoservo.ports.devices import CameraObservation, JointState

CAMERA_NAMES = ("left", "right", "high", "wide")
TERMINAL = {"goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted"}
NAMES = ("j1", "j2", "j3", "j4", "j5", "j6")
ROWS = ((0, -90, 0.42), (0.40, 0, 0), (0, 90, 0), (0, -90, 0.80), (0, 90, 0), (0, 0, 0.085))
BASE = np.array([0.1, -1.0, 1.9, 0.3, 0.8, 0.2])


def twist(axis: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Euclidean generator (4, 4) of a rotation about a line."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[skew, (-skew @ point)[:, None]], [np.zeros((1, 4))]])


def link(a: float, alpha_deg: float, d: float, theta: float) -> np.ndarray:
    """Classic Denavit-Hartenberg transform."""
    ca, sa, ct, st = (
        np.cos(np.radians(alpha_deg)),
        np.sin(np.radians(alpha_deg)),
        np.cos(theta),
        np.sin(theta),
    )
    return np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1.0]])


def look_at(eye: np.ndarray, target: np.ndarray, up: tuple[float, float, float] = (0, 0, 1.0)) -> np.ndarray:
    """Camera pose (4, 4), z towards the target, y downwards."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :4] = np.column_stack([x, np.cross(z, x), z, eye])
    return pose


@dataclass
class Truth:
    """Arm, cameras and markers in metres, and the same in the projective frame.

    ``markers`` (m, 4) as they are at ``BASE``, in the frame of the cameras (2, 3, 4).
    """

    model: CellModel
    cameras: np.ndarray
    generators: np.ndarray
    markers: np.ndarray
    lens: np.ndarray
    mount: Mount = "eye_to_hand"
    static: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    """Scene points (s, 4) that stand for good, in the frame of the cameras."""

    def points(self, q: np.ndarray) -> np.ndarray:
        """Markers (m, 3) [m] at ``q``."""
        if self.mount == "eye_in_hand":
            standing = flange_at(BASE) @ self.markers.T
            return (np.linalg.inv(flange_at(q)) @ standing).T[:, :3]
        from scipy.linalg import expm

        H = np.eye(4)
        for j in range(6):
            H = H @ expm((q[j] - BASE[j]) * self.generators[j])
        return (H @ self.markers.T).T[:, :3]

    def pixels(self, q: np.ndarray) -> np.ndarray:
        """(2, m, 2) exact raw pixels at ``q``."""
        return self.images_of(np.column_stack([self.points(q), np.ones(len(self.markers))]))

    def images_of(self, points: np.ndarray) -> np.ndarray:
        """(2, m, 2) exact raw pixels of points (m, 4)."""
        image = np.einsum("cij,mj->cmi", self.cameras, points)
        return distort(self.lens, image[..., :2] / image[..., 2:])


def flange_at(q: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of the flange in the arm's base."""
    pose = np.eye(4)
    for (a, alpha, d), theta in zip(ROWS, q, strict=True):
        pose = pose @ link(a, alpha, d, theta)
    return pose


def make_truth(
    seed: int, k1: float = 0.0, mount: Mount = "eye_to_hand", count: int = 2, static: int = 0
) -> Truth:  # fmt: skip
    rng = np.random.default_rng(seed)
    frames = [np.eye(4)]
    for (a, alpha, d), theta in zip(ROWS, BASE, strict=True):
        frames.append(frames[-1] @ link(a, alpha, d, theta))
    generators = np.array([twist(frame[:3, 2], frame[:3, 3]) for frame in frames[:6]])
    flange = frames[6]
    body = np.array([[x, y, z] for x, y, z in
                     [(-.06, -.06, .05), (.06, -.06, .05), (.06, .06, .05), (-.06, .06, .05), (.02, -.01, .08),
                      (-.03, .02, .08), (.01, .04, .07), (0, -.05, .08)]])  # fmt: skip
    markers = (flange @ np.column_stack([body, np.ones(len(body))]).T).T
    middle = markers[:, :3].mean(axis=0)
    outward = flange[:3, 2]
    side = np.cross(outward, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    K = np.array([[800, 0, 320], [0, 800, 240], [0, 0, 1.0]])
    cameras = np.array(
        [
            (K @ np.linalg.inv(look_at(middle + 1.2 * outward + s * 0.15 * side + [0, 0, 0.1], middle))[:3])
            for s in (-1, 1)
        ]
        + [  # further ones, from above and from the side
            (K @ np.linalg.inv(look_at(middle + 1.2 * outward + s * side + [0, 0, z], middle))[:3])
            for s, z in ((0.1, 0.45), (0.5, 0.15))
        ][: count - 2]
    )
    if mount == "eye_in_hand":  # everything in the flange's frame; the pair looks along its axis, bodies stand there
        generators = np.array([-np.linalg.inv(flange) @ G @ flange for G in generators])
        middle = np.array([0.02, 0.01, 1.0])
        markers = np.column_stack([middle + body * (1, -1, -1) + (0, 0, 0.06), np.ones(len(body))])
        K[0, 0] = K[1, 1] = 500
        cameras = np.array(
            [K @ np.linalg.inv(look_at(np.array([0.03, s * 0.1, 0.05]), middle, (1.0, 0, 0)))[:3] for s in (-1, 1)]
        )
    lens = np.array([k1 * 320**2 / K[0, 0] ** 2, 320.0, 240.0, 320.0])
    H = np.eye(4) + 0.3 * rng.standard_normal((4, 4))  # projective -> Euclidean
    inverse = np.linalg.inv(H)
    plane = np.array([0, 0, 0, 1.0]) @ H
    points = (inverse @ markers.T).T
    points /= (points @ plane)[:, None]
    spread = np.random.default_rng(seed + 1000).uniform(-0.2, 0.2, (static, 3))
    standing = np.column_stack([middle + spread, np.ones(static)])
    scene = standing @ inverse.T
    scene /= (scene @ plane)[:, None]
    statistics = FitStatistics(0.02, 1.0, 1, True, 1, 0, 0, (), 1)
    model = CellModel(
        schema=MODEL_SCHEMA, epoch=7, joint_names=NAMES, joint_kinds=("revolute",) * 6, zero=BASE.copy(),
        generators=np.array([inverse @ G @ H for G in generators]),
        cameras=tuple(
            CameraModel(n, P @ H, 640, 480, lens) for n, P in zip(CAMERA_NAMES[:count], cameras, strict=True)
        ),
        marker_ids=tuple(range(len(body))), marker_points=points, plane_at_infinity=plane, stratum="metric",
        projective_to_euclidean=H, statistics=statistics, mount=mount,
        scene_ids=tuple(range(len(body), len(body) + static)), scene_points=scene,
        scene_covariances=np.zeros((static, 4, 4)),
    )  # fmt: skip
    return Truth(model, cameras, generators, markers, lens, mount, standing)


def make_settings(
    mount: Mount = "eye_to_hand", count: int = 2, mobile: tuple[str, ...] = (), static: int = 0
) -> CoreSettings:  # fmt: skip
    return CoreSettings(
        cell="test", joint_names=NAMES, joint_kinds=("revolute",) * 6,
        cameras=tuple(
            CameraSettings(n, 640, 480, 25.0, mount, tuple(range(8 + static)), mobile=n in mobile)
            for n in CAMERA_NAMES[:count]
        ),
        limits=LimitSettings(
            np.full(6, -3.0), np.full(6, 3.0), np.full(6, 1.0), np.full(6, 4.0), 0.01, np.zeros((0, 6, 2)), (),
            0.5, 0.1, 1.0,
        ),
        trials=TrialSettings(BASE.copy(), np.full(6, 0.1), 5, 2, 0.05, 1.0, 4, 0.05, 1.0), home=BASE.copy(),
        rate_hz=100.0, law="cartesian3", points="predicted", gain=1.5, tolerance_px=0.1, hold_frames=5,
        time_limit_s=30.0, filter_s=0.2, gate_sigma=6.0, scene_ids=tuple(range(8, 8 + static)),
    )  # fmt: skip


@dataclass
class Bench:
    """Drives a core in virtual time against the truth: perfect joints, cameras at 25 Hz with 20 ms latency."""

    truth: Truth
    settings: CoreSettings
    core: ServoCore
    rng: np.random.Generator
    q: np.ndarray
    noise_px: float = 0.0
    active: bool = False
    now_ns: int = 1_000_000_000
    seq: int = 0
    cameras_on: list[bool] = field(default_factory=lambda: [True] * len(CAMERA_NAMES))
    joints_on: bool = True
    frozen_joint: int = -1
    shutters_late: list[int] = field(default_factory=lambda: [0] * len(CAMERA_NAMES))
    """Steps by which the shutter of each camera is later than that of one that keeps to every fourth step."""
    marker_mask: np.ndarray = field(default_factory=lambda: np.ones(8, bool))
    bias_px: float | np.ndarray = 0.0
    """Added to all pixels, or (8, 2) to each marker's."""
    events: list[Event] = field(default_factory=list)
    commands: list[np.ndarray] = field(default_factory=list)
    log: list[tuple[StepInputs, StepOutputs]] = field(default_factory=list)
    pending: list[CameraObservation] = field(default_factory=list)
    encoder: np.ndarray | None = None
    zero_offset: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """What the encoders tell more than the joints stand at."""
    play: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """By how much [rad], to either side, a motor with its encoder may stand off its joint before it takes it along."""
    dead_speed: float = 0.0
    """Of every motor [rad/s]: friction makes it slower by so much, and holds it below."""
    delay_s: float = 0.0
    """By which every drive answers late."""
    resolution: float = 0.0
    """Step of every encoder [rad]."""
    stamped_late_ns: int = 0
    """By which the stamps of pictures are later than their shutters."""
    joints_stamped_late_ns: int = 0
    """By which the stamps of joint samples are later than they were taken."""
    loads: Callable[[Bench], tuple[np.ndarray, np.ndarray]] | None = None
    """Efforts and following errors (6,), (6,) that the drives tell; None: they do not."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.settings.cameras)

    def step(self, *commands: Command, **inputs: object) -> StepOutputs:
        period_ns = round(1e9 / self.settings.rate_hz)
        self.now_ns += period_ns
        self.seq += 1
        q_encoder = self.q + self.zero_offset
        if self.frozen_joint >= 0:
            self.encoder = self.q.copy() if self.encoder is None else self.encoder
            q_encoder[self.frozen_joint] = self.encoder[self.frozen_joint]
        if self.resolution:
            q_encoder = np.round(q_encoder / self.resolution) * self.resolution
        told = () if self.loads is None else self.loads(self)
        stamp_ns = self.now_ns + self.joints_stamped_late_ns
        joints = JointState(self.seq, stamp_ns, q_encoder, np.zeros(6), *told) if self.joints_on else None
        due = [o for o in self.pending if o.t_received_ns <= self.now_ns]
        self.pending = [o for o in self.pending if o.t_received_ns > self.now_ns]
        requests = tuple(Request(self.seq * 10 + k, "tester", c) for k, c in enumerate(commands))
        step = StepInputs(
            self.now_ns,
            inputs.pop("period_ns", period_ns),  # type: ignore[arg-type]
            joints,
            tuple(due),
            requests,
            driver_active=self.active,
            **inputs,
        )
        outputs = self.core.step(step)
        self.log.append((step, outputs))
        self.events.extend(outputs.events)
        if outputs.driver_request:
            self.active = outputs.driver_request == "activate"
        if any((self.seq - late) % 4 == 0 for late in self.shutters_late):
            self._shutter()
        if outputs.command is not None:
            self.commands.append(outputs.command)
            late = round(self.delay_s * self.settings.rate_hz)
            arrives = self.commands[-1 - late] if late < len(self.commands) else np.zeros(6)
            held = np.clip(arrives, -self.dead_speed, self.dead_speed)
            self._drive((arrives - held) * period_ns * 1e-9)
        return outputs

    def _drive(self, way: np.ndarray) -> None:
        """The motors go ``way`` (6,); a joint with play follows once its play is used up."""
        slack = self.zero_offset + way
        free = (self.play > 0.0) & (np.abs(slack) <= self.play)
        taken = np.where(self.play > 0.0, slack - np.clip(slack, -self.play, self.play), way)
        self.q = self.q + np.where(free, 0.0, taken)
        self.zero_offset = self.zero_offset + np.where(self.play > 0.0, way - taken, 0.0)

    def _shutter(self) -> None:
        exact = np.concatenate([self.truth.pixels(self.q), self.truth.images_of(self.truth.static)], axis=1)
        bias = np.zeros((exact.shape[1], 2))
        bias[:8] = self.bias_px
        for c, name in enumerate(self.names):
            if not self.cameras_on[c] or (self.seq - self.shutters_late[c]) % 4:
                continue
            inside = np.all((exact[c] >= 0) & (exact[c] < (640, 480)), axis=1)
            inside[:8] &= self.marker_mask
            noise = self.noise_px * self.rng.standard_normal((inside.sum(), 2))
            pixels = exact[c, inside] + noise + bias[inside]
            covariance = np.tile(np.eye(2) * max(self.noise_px, 0.01) ** 2, (inside.sum(), 1, 1))
            self.pending.append(
                CameraObservation(
                    name,
                    self.seq,
                    self.now_ns + self.stamped_late_ns,
                    self.now_ns + 20_000_000,
                    np.flatnonzero(inside),
                    pixels,
                    covariance,
                )
            )

    def run(self, seconds: float) -> StepOutputs:
        for _ in range(max(1, round(seconds * self.settings.rate_hz))):
            outputs = self.step()
        return outputs

    def until(self, wanted: Callable[[Event], bool], seconds: float) -> Event:
        start = len(self.events)
        for _ in range(round(seconds * self.settings.rate_hz)):
            self.step()
            for event in self.events[start:]:
                if wanted(event):
                    return event
        raise AssertionError(f"not seen in {seconds} s; events: {[(e.kind, e.message) for e in self.events[start:]]}")

    def reply(self, command: Command, seconds: float = 20.0) -> Event:
        """Send a command and step until its own reply."""
        request = (self.seq + 1) * 10
        outputs = self.step(command)
        for _ in range(round(seconds * self.settings.rate_hz)):
            for event in outputs.events:
                if event.kind == "reply" and event.request == request:
                    return event
            outputs = self.step()
        raise AssertionError(f"no reply in {seconds} s")

    def ready(self) -> Bench:
        """Model in, arm enabled, first frames seen."""
        from stereoservo.messages.goals import Enable

        self.run(0.1)
        self.step(model_update=ModelUpdate(with_groups(self.truth.model)))
        self.step(Enable())
        self.run(0.3)
        return self

    def features(self, q: np.ndarray) -> dict[str, dict[int, tuple[float, float]]]:
        exact = self.truth.pixels(q)
        return {
            name: {i: (float(u), float(v)) for i, (u, v) in enumerate(exact[c])} for c, name in enumerate(self.names)
        }

    def goal(self, target: Target, **options: Any) -> RunGoal:
        """A goal with an id of its own."""
        return RunGoal(Goal(f"{self.seq + 1:08x}", target, **options))

    def ended(self, seconds: float = 20.0) -> Event:
        """Step until a goal ends."""
        return self.until(lambda e: e.kind in TERMINAL, seconds)

    def projective(self, points: np.ndarray) -> np.ndarray:
        """Euclidean points (m, 3) in the model's frame, height 1."""
        model = self.truth.model
        homogeneous = np.column_stack([points, np.ones(len(points))])
        found = homogeneous @ np.linalg.inv(model.projective_to_euclidean).T
        return found / (found @ model.plane_at_infinity)[:, None]

    def points_target(self, q: np.ndarray) -> PointTarget:
        """The body's points at ``q``, each with a scale of its own."""
        points = self.projective(self.truth.points(q))
        return PointTarget({i: tuple((M * (1.0 + 0.5 * i)).tolist()) for i, M in enumerate(points)}, 7)

    def displacement_to(self, q: np.ndarray) -> np.ndarray:
        """Euclidean (4, 4) that takes the body from where it is to where it is at ``q``, by its points alone."""
        A, B = self.truth.points(self.q), self.truth.points(q)
        a, b = A.mean(axis=0), B.mean(axis=0)
        U, _, Vt = np.linalg.svd((A - a).T @ (B - b))
        R = Vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
        H = np.eye(4)
        H[:3, :3], H[:3, 3] = R, b - R @ a
        return H

    def displacement_target(self, H: np.ndarray, scale: float = -3.0) -> DisplacementTarget:
        """A Euclidean displacement in the model's frame, scaled by any number."""
        E = self.truth.model.projective_to_euclidean
        matrix = scale * np.linalg.inv(E) @ H @ E
        return DisplacementTarget(tuple(matrix.ravel().tolist()), model_epoch=7)

    def basis_target(self, H: np.ndarray, ids: tuple[int, int, int, int, int]) -> DisplacementTarget:
        """The same without a model: in the basis of five markers as they are now."""
        points = np.column_stack([self.truth.points(self.q), np.ones(8)])[list(ids)].T
        E = points[:, :4] * np.linalg.solve(points[:, :4], points[:, 4])
        return DisplacementTarget(tuple((0.2 * np.linalg.inv(E) @ H @ E).ravel().tolist()), basis=ids)

    def turned(self, axis: str, degrees: float) -> np.ndarray:
        """Euclidean (4, 4): the body turned about its middle, about an axis of the flange."""
        points = self.truth.points(self.q)
        x, y = points[1] - points[0], points[3] - points[0]
        frame = np.column_stack([x, y, np.cross(x, y)])
        u = frame[:, "xyz".index(axis)] / np.linalg.norm(frame[:, "xyz".index(axis)])
        c = points.mean(axis=0)
        K = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
        R = np.eye(3) + np.sin(np.radians(degrees)) * K + (1 - np.cos(np.radians(degrees))) * K @ K
        H = np.eye(4)
        H[:3, :3], H[:3, 3] = R, c - R @ c
        return H

    def error_px(self, q: np.ndarray) -> float:
        return float(np.abs(self.truth.pixels(self.q) - self.truth.pixels(q)).max())


@pytest.fixture
def bench() -> Bench:
    return make_bench(0)


@pytest.fixture
def benches() -> Callable[..., Bench]:
    return make_bench


def make_bench(
    seed: int, noise_px: float = 0.0, k1: float = 0.0, mount: Mount = "eye_to_hand", count: int = 2,
    mobile: tuple[str, ...] = (), static: int = 0,
) -> Bench:  # fmt: skip
    settings = make_settings(mount, count, mobile, static)
    truth = make_truth(seed, k1, mount, count, static)
    return Bench(truth, settings, ServoCore(settings), np.random.default_rng(seed), BASE.copy(), noise_px)
