"""Incidences on bodies that move: points, lines and planes that go with a target are followed, its twist fed forward,
before cameras that stand and on the arm. The truth is Euclidean, conjugated into a random projective frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.linalg import expm

from core.conftest import BASE, flange_at, twist
from stereoservo.core.servo_core import ServoCore
from stereoservo.core.state_encoding import decode_state, encode_state
from stereoservo.core.target import track
from stereoservo.core.target.motion import compare
from stereoservo.core.target.track import pose_at
from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.messages.goals import Feature, Goal, IncidenceSpec, IncidenceTarget, RunGoal

NOISE_PX = 0.1
PART = tuple(range(8, 14))
"""Markers of the target before cameras that stand."""
FEW = PART[:3]
"""Of those, as few as tell how a part whose shape is known has turned."""
SETTLE_S, JUDGED_S = 2.0, 1.0

Way = Callable[[float], np.ndarray]


def sliding(seed: int, speed: float = 0.05) -> Way:
    direction = np.random.default_rng([seed, 23]).standard_normal(3)
    direction *= speed / np.linalg.norm(direction)

    def way(t: float) -> np.ndarray:
        D = np.eye(4)
        D[:3, 3] = t * direction
        return D

    return way


def turning(centre: np.ndarray, axis: np.ndarray, speed: float) -> Way:
    G = twist(axis / np.linalg.norm(axis), centre)
    return lambda t: np.asarray(expm(t * speed * G))


class Cell:
    """A bench with a part that goes along a ``way`` (4, 4) by the seconds from `set_out` on."""

    def __init__(self, bench: Any) -> None:
        self.bench, self.begin_ns, self.way = bench, 0, sliding(0, 0.0)
        rng = np.random.default_rng([5, 23])
        middle = bench.truth.points(BASE).mean(axis=0)
        spread = rng.uniform(-0.1, 0.1, (len(PART), 3)) + np.array([0.0, 0.06, 0.03])
        self.part = np.column_stack([middle + spread, np.ones(len(PART))])
        bench.truth.static = self.part

    @property
    def moved(self) -> np.ndarray:
        """(4, 4): of the part, by now."""
        return self.way((self.bench.now_ns - self.begin_ns) * 1e-9)

    def set_out(self, way: Way) -> None:
        self.way, self.begin_ns = way, self.bench.now_ns

    def step(self) -> None:
        self.bench.truth.static = self.part @ self.moved.T
        self.bench.step()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * self.bench.settings.rate_hz)):
            self.step()

    def send(
        self,
        kind: str,
        moving: tuple[int, ...],
        fixed: np.ndarray,
        follow: tuple[int, ...],
        shown: Any = None,
        damping: float = 0.0,
    ) -> Any:
        points = tuple(map(tuple, self.bench.projective(fixed).tolist()))
        spec = IncidenceSpec(kind, Feature(markers=moving), Feature(points=points))
        goal = Goal(
            "00000001", IncidenceTarget((spec,), model_epoch=7), gain=2.0, tolerance_px=0.4, time_limit_s=60.0,
            follow_markers=follow, follow_seen=shown or {}, damping=damping,
        )  # fmt: skip
        return self.bench.reply(RunGoal(goal))

    def images(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.bench.truth.images_of(np.column_stack([points, np.ones(len(points))])))


def off_feature(points: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """The nearest points (k, 3) to ``points`` (k, 3) of the span of 1 to 3 points (K, 3)."""
    if len(feature) == 1:
        return np.broadcast_to(feature[0], points.shape)
    Q = np.linalg.qr((feature[1:] - feature[0]).T)[0]
    return np.asarray(feature[0] + (points - feature[0]) @ Q @ Q.T)


def largest_px(cell: Cell, moving: tuple[int, ...], feature: Callable[[], np.ndarray]) -> float:
    """Largest distance over time between a marker's image and that of the feature's nearest point."""
    errors = []
    for _ in range(round(JUDGED_S * cell.bench.settings.rate_hz)):
        cell.step()
        points = cell.bench.truth.points(cell.bench.q)[list(moving)]
        apart = cell.images(points) - cell.images(off_feature(points, feature()))
        errors.append(np.linalg.norm(apart, axis=-1).max())
    return float(max(errors))


KINDS = {
    "point-on-point": ((4,), (4,)),
    "point-on-line": ((4,), (4, 5)),
    "line-on-line": ((0, 2), (0, 2)),
    "plane-on-plane": ((0, 1, 2), (0, 1, 2)),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("damping", [0.0, 0.4])
def test_features_that_go_with_a_target_are_followed(benches: Any, kind: str, turns: bool, damping: float) -> None:
    """Damping holds back no motion that the target's asks for."""
    cell = Cell(benches(1, noise_px=NOISE_PX).ready())
    moving, own = KINDS[kind]
    fixed = cell.bench.truth.points(BASE)[list(own)]
    assert cell.send(kind, moving, fixed, PART, damping=damping).accepted
    cell.run(0.3)
    middle = cell.part[:, :3].mean(axis=0)
    way = turning(middle, np.array([0.2, 0.1, 1.0]), 0.3) if turns else sliding(1)
    cell.set_out(way)
    cell.run(SETTLE_S)

    def feature() -> np.ndarray:
        return (np.column_stack([fixed, np.ones(len(fixed))]) @ cell.moved.T)[:, :3]

    largest = largest_px(cell, moving, feature)
    print(f"{kind}, turns {turns}: {largest:.2f} px")
    assert largest < 1.0
    assert [e.kind for e in cell.bench.events if e.kind.startswith("target_")] == [
        "target_seen",
        "target_met",
    ]
    assert {e.name for e in cell.bench.events if e.kind == "health"} <= {"ok"}


def test_what_an_incidence_leaves_free_stays_though_the_target_moves(benches: Any) -> None:
    """Onto a plane that slides along itself nothing has to move."""
    cell = Cell(benches(2).ready())
    fixed = cell.bench.truth.points(BASE)[:3]
    assert cell.send("point-on-plane", (0,), fixed, PART).accepted
    cell.run(0.3)
    before = cell.bench.q.copy()
    along = (fixed[1] - fixed[0]) / np.linalg.norm(fixed[1] - fixed[0])

    def way(t: float) -> np.ndarray:
        D = np.eye(4)
        D[:3, 3] = 0.03 * t * along
        return D

    cell.set_out(way)
    cell.run(2.0)
    assert np.abs(cell.bench.q - before).max() < 2e-3


def test_without_its_name_the_feature_stands(benches: Any) -> None:
    cell = Cell(benches(1, noise_px=NOISE_PX).ready())
    fixed = cell.bench.truth.points(BASE)[[4]]
    assert cell.send("point-on-point", (4,), fixed, ()).accepted
    cell.run(0.3)
    cell.set_out(sliding(1))
    cell.run(SETTLE_S)
    way = largest_px(cell, (4,), lambda: (np.column_stack([fixed, [1.0]]) @ cell.moved.T)[:, :3])
    assert way > 20.0


def off_target_px(cell: Cell, seconds: float) -> float:
    """Largest distance over time between the images of the target as it is followed and as it is."""
    matrices, off_px = np.array([camera.matrix for camera in cell.bench.truth.model.cameras]), list[float]()
    for _ in range(round(seconds * cell.bench.settings.rate_hz)):
        cell.step()
        body = cell.bench.core.state.target
        followed = transform_points(pose_at(body, cell.bench.now_ns)[0], body.points)
        found, _ = project_points(matrices, followed)
        apart = found - cell.bench.truth.images_of(cell.bench.truth.static)
        off_px.append(float(np.linalg.norm(apart, axis=-1).max()))
    return max(off_px)


@pytest.mark.parametrize("size", [0.05, 0.1])
def test_a_flat_part_that_leans_otherwise_is_not_taken_for_its_mirror_image(benches: Any, size: float) -> None:
    """It was, by the one camera that showed it first, and the other camera's pictures were put down to that camera."""
    cell = Cell(benches(0, noise_px=NOISE_PX).ready())
    middle = cell.bench.truth.points(BASE).mean(axis=0) + np.array([0.0, 0.06, 0.03])
    left = cell.bench.truth.cameras[0]
    normal = -np.linalg.solve(left[:, :3], left[:, 3]) - middle
    normal /= np.linalg.norm(normal)
    across = np.cross(normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    edges = np.column_stack([across, np.cross(normal, across)])
    flat = middle + np.random.default_rng([0, 77]).uniform(-size, size, (len(PART), 2)) @ edges.T
    cell.part = np.column_stack([flat, np.ones(len(PART))]) @ turning(middle, across, 1.0)(np.radians(25.0)).T
    assert cell.send("point-on-point", (4,), cell.bench.truth.points(BASE)[[4]], PART).accepted
    cell.run(1.0)
    part, cell.part = cell.part, cell.part + np.array([0.0, 0.0, 50.0, 0.0])
    cell.run(0.8)
    cell.part = part @ turning(middle, across, 1.0)(np.radians(-40.0)).T + np.array([0.0, 0.03, 0.02, 0.0])
    cell.run(0.4)
    assert off_target_px(cell, 0.5) < 1.0


@pytest.mark.parametrize("late", [0, 1, 2, 3])
def test_a_target_that_moves_is_found_by_cameras_that_no_trigger_joins(benches: Any, late: int) -> None:
    """Its shape is taken of one moment: of two 30 ms apart, it was off by 32 px."""
    bench = benches(0, noise_px=NOISE_PX).ready()
    cell, slide = Cell(bench), sliding(0, 0.1)
    bench.shutters_late[1] = late
    cell.set_out(lambda t: slide(t - 0.6))
    cell.run(0.3)
    assert cell.send("point-on-point", (4,), bench.truth.points(BASE)[[4]], PART).accepted
    cell.run(0.6)
    off_px = off_target_px(cell, 0.6)
    print(f"shutters {10 * late} ms apart: {off_px:.2f} px")
    assert off_px < 1.0


@pytest.mark.parametrize(
    ("shown_as", "stated", "ids"),
    [({8: 9, 9: 8}, False, None), ({9: 90}, False, (8, 10, 11, 12, 13)), ({9: 90}, True, PART)],
)
def test_sights_whose_rays_do_not_meet_are_no_part_of_the_target(
    benches: Any, shown_as: dict[int, int], stated: bool, ids: tuple[int, ...] | None
) -> None:
    """Markers swapped by a camera's detector, and a reflection of one: a shape of them was followed, and the arm
    moved.
    """
    cell = Cell(benches(7, noise_px=NOISE_PX).ready())
    bench, begin = cell.bench, cell.bench.q.copy()
    taken = bench.core.step

    def seen_wrongly(inputs: Any) -> Any:
        frames = tuple(wrongly(frame) if frame.camera == "left" else frame for frame in inputs.observations)
        return taken(msgspec.structs.replace(inputs, observations=frames))

    def wrongly(frame: Any) -> Any:
        seen, pixels = frame.ids.copy(), frame.pixels.copy()
        for one, other in shown_as.items():
            if other in frame.ids:
                seen[frame.ids == one] = other
            else:
                pixels[frame.ids == one] = (50.0, 60.0)
        return msgspec.structs.replace(frame, ids=seen, pixels=pixels)

    images = zip(bench.names, cell.images(cell.part[:, :3]), strict=True)
    where = {name: dict(zip(PART, map(tuple, image.tolist()), strict=True)) for name, image in images}
    bench.core.step = seen_wrongly
    fixed = bench.truth.points(BASE)[[4]]
    assert cell.send("point-on-point", (4,), fixed, PART, where if stated else None).accepted
    cell.run(1.0)
    assert np.abs(bench.q - begin).max() < 1e-2
    assert ("target_met" in [event.kind for event in bench.events]) == (ids is not None)
    if ids is None:  # until they are seen rightly
        bench.core.step = taken
        cell.run(0.3)
        assert off_target_px(cell, 0.3) < 1.0
    else:
        assert tuple(bench.core.state.target.ids) == ids


@pytest.mark.parametrize("absent", [(90, 91), tuple(range(20, 256))])
def test_markers_that_two_cameras_do_not_show_at_first_are_no_part_of_the_target(
    benches: Any, monkeypatch: pytest.MonkeyPatch, absent: tuple[int, ...]
) -> None:
    """The frame that finds it is compared with the markers that are left: kernels look at no bounds."""

    def checked(*given: Any) -> Any:
        assert len({len(given[1]), len(given[3][2]), len(given[3][3])}) == 1  # points, sights, which are seen
        return compare(*given)

    monkeypatch.setattr(track, "compare", checked)
    cell = Cell(benches(7, noise_px=NOISE_PX).ready())
    assert cell.send("point-on-point", (4,), cell.bench.truth.points(BASE)[[4]], (*PART, *absent)).accepted
    cell.run(1.0)
    assert tuple(cell.bench.core.state.target.ids) == PART
    assert "target_met" in [event.kind for event in cell.bench.events]


@pytest.mark.parametrize("seen", [True, False])
def test_a_target_is_met_by_what_is_seen_of_it_and_not_by_what_is_expected(benches: Any, seen: bool) -> None:
    """It turns back while it is hidden, and the arm comes to where it would have been."""
    cell = Cell(benches(4, noise_px=NOISE_PX).ready())
    assert cell.send("point-on-point", (4,), cell.bench.truth.points(BASE)[[4]], PART).accepted
    slide, bench = sliding(4, 0.03), cell.bench
    cell.set_out(slide)
    while not 0.5 < bench.core.state.block.numbers.run.newest_px < 0.6:
        cell.step()
    assert "target_met" not in [event.kind for event in bench.events]
    if not seen:
        turned_s, part = (bench.now_ns - cell.begin_ns) * 1e-9, cell.part
        cell.way, cell.part = lambda t: slide(2.0 * turned_s - t), part + np.array([0.0, 0.0, 50.0, 0.0])
    cell.run(0.45)
    assert ("target_met" in [event.kind for event in bench.events]) == seen


@pytest.mark.parametrize("kind", KINDS)
def test_a_body_that_moves_before_cameras_on_the_arm_is_kept_on_features_of_the_cameras(
    benches: Any, kind: str
) -> None:
    bench = benches(3, noise_px=NOISE_PX, mount="eye_in_hand").ready()
    cell = Cell(bench)
    bench.truth.static = np.zeros((0, 4))
    cell.part = bench.truth.static
    moving, own = KINDS[kind]
    fixed = bench.truth.points(BASE)[list(own)]
    markers = bench.truth.markers
    bench.truth.points = lambda q: (np.linalg.inv(flange_at(q)) @ cell.moved @ flange_at(BASE) @ markers.T).T[:, :3]
    assert cell.send(kind, moving, fixed, tuple(range(8))).accepted
    cell.run(0.3)
    cell.set_out(sliding(3, 0.03))
    cell.run(SETTLE_S)
    largest = largest_px(cell, moving, lambda: fixed)
    print(f"{kind}: {largest:.2f} px")
    assert largest < 1.0
    assert {e.name for e in bench.events if e.kind == "health"} <= {"ok"}


def test_the_goal_ends_where_the_target_stands_and_waits_where_it_is_not_seen(benches: Any) -> None:
    cell = Cell(benches(4, noise_px=NOISE_PX).ready())
    fixed = cell.bench.truth.points(BASE)[[4]]
    assert cell.send("point-on-point", (4,), fixed, PART).accepted
    cell.run(0.3)
    slide = sliding(4, 0.02)
    cell.set_out(lambda t: slide(min(t, 2.0)))
    cell.run(1.0)
    part, cell.part = cell.part, cell.part + np.array([0.0, 0.0, 50.0, 0.0])
    cell.run(0.8)
    assert any(e.kind == "target_unseen" for e in cell.bench.events)
    before = cell.bench.q.copy()
    cell.run(0.3)
    assert np.abs(cell.bench.q - before).max() < 1e-3
    cell.part = part
    cell.run(4.0)
    kinds = [e.kind for e in cell.bench.events if e.kind.startswith("target_") or e.kind == "goal_reached"]
    assert kinds[-2:] == ["target_seen", "goal_reached"]


def shown(cell: Cell, displacement: np.ndarray) -> dict[str, dict[int, tuple[float, float]]]:
    """What the cameras see of the part that is displaced by (4, 4)."""
    there = (cell.part @ displacement.T)[:, :3]
    return {
        name: {i: (float(u), float(v)) for i, (u, v) in zip(PART, image, strict=True) if i in FEW}
        for name, image in zip(cell.bench.names, cell.images(there), strict=True)
    }


@pytest.mark.parametrize(
    ("turned", "then"), [(0.0, 0.2), (2.6, -1.8), (3.1, 1.5)], ids=["slid", "turned", "turned about"]
)
def test_where_the_target_was_when_its_features_were_shown_is_taken_as_said(
    benches: Any, turned: float, then: float
) -> None:
    """However it has turned since, of a goal by which it is found, and of one to a target that is followed already."""
    cell = Cell(benches(5).ready())
    fixed = cell.bench.truth.points(BASE)[[4]]
    middle = cell.part[:, :3].mean(axis=0)
    D = sliding(5, 0.05)(1.0) @ turning(fixed[0], np.array([0.1, 0.3, 1.0]), turned)(1.0)
    cell.set_out(lambda t: D)
    cell.run(0.5)
    assert cell.send("point-on-point", (4,), fixed, FEW, shown(cell, np.eye(4))).accepted
    cell.run(5.0)
    V = turning(middle, np.array([1.0, -0.3, 0.2]), then)(1.0)
    wanted = (D @ np.append(fixed[0], 1.0))[:3]
    np.testing.assert_allclose(cell.bench.truth.points(cell.bench.q)[4], wanted, atol=2e-3)
    assert cell.bench.events[-1].kind == "goal_reached"
    nearby = wanted + np.array([0.01, -0.01, 0.02])
    then_fixed = (V @ np.linalg.inv(D) @ np.append(nearby, 1.0))[None, :3]
    assert cell.send("point-on-point", (4,), then_fixed, FEW, shown(cell, V)).accepted
    cell.run(5.0)
    np.testing.assert_allclose(cell.bench.truth.points(cell.bench.q)[4], nearby, atol=2e-3)


def test_another_part_than_was_taught_is_told_and_not_gone_to(benches: Any) -> None:
    cell = Cell(benches(5).ready())
    fixed, taught = cell.bench.truth.points(BASE)[[4]], shown(cell, np.eye(4))
    middle = cell.part.mean(axis=0)
    cell.part = middle + 1.5 * (cell.part - middle)
    before = cell.bench.q.copy()
    assert cell.send("point-on-point", (4,), fixed, FEW, taught).accepted
    cell.run(1.0)
    (reason,) = [r for r in cell.bench.log[-1][1].status.reasons if r.code.startswith("TARGET")]
    assert (reason.code, reason.unit) == ("TARGET_DIFFERS", "px")
    assert reason.value > reason.threshold
    np.testing.assert_allclose(cell.bench.q, before, atol=1e-3)
    cell.part = cell.part + np.array([0.0, 0.0, 50.0, 0.0])  # out of sight
    cell.run(1.0)
    assert "TARGET_UNSEEN" in {r.code for r in cell.bench.log[-1][1].status.reasons}


def test_its_state_survives_serialisation_bit_for_bit(benches: Any) -> None:
    cell = Cell(benches(6, noise_px=NOISE_PX).ready())
    assert cell.send("point-on-line", (4,), cell.bench.truth.points(BASE)[[4, 5]], PART).accepted
    cell.run(0.3)
    cell.set_out(sliding(6))
    cell.run(0.8)
    twin = ServoCore(cell.bench.settings, decode_state(encode_state(cell.bench.core.state)))
    start = len(cell.bench.log)
    cell.run(0.3)
    for inputs, outputs in cell.bench.log[start:]:
        assert twin.step(inputs).command.tobytes() == outputs.command.tobytes()
    assert encode_state(twin.state) == encode_state(cell.bench.core.state)
