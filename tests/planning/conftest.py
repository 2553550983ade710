"""The virtual cells of the control tests serve here too; and requests for plans in them."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.planning.plan import PlanLimits, PlanRequest

_spec = importlib.util.spec_from_file_location(
    "stereoservo_virtual_cells", Path(__file__).parents[1] / "control" / "conftest.py"
)
_cells = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_cells)
virtual = _cells.virtual

SIZES = np.array([[640.0, 480.0], [640.0, 480.0]])
PINHOLES = np.array([[0.0, 320.0, 240.0, 320.0], [0.0, 320.0, 240.0, 320.0]])
SEVEN = ((0, -90, 0.34), (0, 90, 0), (0, 90, 0.4), (0, -90, 0), (0, -90, 0.4), (0, 90, 0), (0, 0, 0.126))
SEVEN_MIDDLE = np.radians([10.0, 40.0, -20.0, -80.0, 30.0, 60.0, 20.0])
FIVE = ((0, -90, 0.42), (0.4, 0, 0), (0.3, 0, 0), (0, 90, 0), (0, 0, 0.2))
FIVE_MIDDLE = np.radians([10.0, -50.0, 120.0, 60.0, 20.0])
START = _cells.pose(Rotation.from_euler("xyz", [20, -15, 40], degrees=True), [0.05, -0.03, 1.1])


def plan_request(world, T_star, limits=None, centre=(0.0, 0.0, 0.0, 1.0), **options):
    """From where the plate of ``world`` is to the pose ``T_star``; ``limits`` overrides single fields."""
    n = len(world.q)
    bounds = PlanLimits(
        position_min=np.full(n, -2 * np.pi),
        position_max=np.full(n, 2 * np.pi),
        velocity_max=np.full(n, 1.0),
        acceleration_max=np.full(n, 4.0),
        keep_outs=np.zeros((0, n, 2)),
        sizes=SIZES,
        lenses=PINHOLES,
        view_margin_px=5.0,
    )
    given = {
        "operators": world.operators(),
        "composition": 0,
        "joints": world.q.copy(),
        "matrices": world.matrices,
        "camera_centres": world.camera_centres,
        "points": world.hidden(world.markers()),
        "targets": world.hidden(_cells.PLATE @ T_star.T),
        "must_stay_visible": np.ones(4),
        "centre": world.hidden(world.plate_pose() @ np.array(centre)),
        "centre_target": world.hidden(T_star @ np.array(centre)),
        "faces": np.array([[0, 1, 2]]),
        "limits": msgspec.structs.replace(bounds, **(limits or {})),
    }
    return PlanRequest(**(given | options))


def scara(rng):
    """Two parallel revolute joints, a prismatic and a revolute one, the plate askew to all."""
    axis = np.array([0.1, 0.9, 0.2]) / np.linalg.norm([0.1, 0.9, 0.2])
    aside = np.cross(axis, [1.0, 0, 0]) / np.linalg.norm(np.cross(axis, [1.0, 0, 0]))
    p = START[:3, 3]
    generators = [
        _cells.screw(axis, p + 0.5 * aside),
        _cells.screw(axis, p + 0.25 * aside + 0.2 * np.cross(aside, axis)),
        _cells.screw(axis),
        _cells.screw(axis, p),
    ]
    return _cells.World(np.array(generators), START, _cells.random_frame(rng), np.zeros(4))


def gantry(rng):
    """Three prismatic joints."""
    generators = np.array([_cells.screw(axis) for axis in np.eye(3)])
    return _cells.World(generators, START, _cells.random_frame(rng), np.zeros(3))


def door(rng):
    """One revolute joint beside the plate."""
    generators = np.array([_cells.screw([0, 1.0, 0], [0.1, 0, 1.2])])
    return _cells.World(generators, START, _cells.random_frame(rng), np.zeros(1))


def clearances_of(world, T):
    """Distance from the borders [px] and cosine of elevation, the least of both cameras, for a plate at ``T``."""
    uv = world.pixels(_cells.PLATE @ T.T)
    inside = min(uv.min(), (640 - uv[..., 0]).min(), (480 - uv[..., 1]).min())
    return inside, world.front_facing(T).min()


def goal_nearby(rng, world, step, clearance=10.0, elevation=0.2):
    """Joints within ``step`` of the present ones, and the plate's pose there, well in view."""
    while True:
        q = world.q + rng.uniform(-step, step, len(world.q))
        T = world.plate_pose(q)
        inside, front = clearances_of(world, T)
        if inside > clearance and front > elevation:
            return q, T


def border_task(rng):
    """Start and goal near the images' borders, 120° to 180° and up to 0.6 m apart: the straight way often leaves."""
    probe = _cells.World(np.zeros((0, 4, 4)), np.eye(4), np.eye(4), np.zeros(0))

    def fits(T):
        inside, front = clearances_of(probe, T)
        return 1.5 < inside < 25.0 and front > np.cos(np.radians(82))

    def direction():
        v = rng.normal(size=3)
        return v / np.linalg.norm(v)

    while True:
        R = Rotation.random(random_state=int(rng.integers(2**31)))
        T_star = _cells.pose(R, [rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3), rng.uniform(0.45, 1.3)])
        if not fits(T_star):
            continue
        for _ in range(30):
            turn = Rotation.from_rotvec(np.radians(rng.uniform(120, 180)) * direction())
            T0 = _cells.pose(turn * R, T_star[:3, 3] + rng.uniform(0.1, 0.6) * direction())
            if fits(T0):
                return T0, T_star


@pytest.fixture(scope="session")
def cells():
    """Arms and requests, by name."""
    return SimpleNamespace(
        request=plan_request,
        seven=lambda rng: _cells.rx90(rng, q=SEVEN_MIDDLE, rows=SEVEN),
        five=lambda rng: _cells.rx90(rng, q=FIVE_MIDDLE, rows=FIVE),
        rx90=_cells.rx90,
        scara=scara,
        gantry=gantry,
        door=door,
        goal_nearby=goal_nearby,
        border_task=border_task,
        clearances_of=clearances_of,
        SIZES=SIZES,
        PINHOLES=PINHOLES,
        START=START,
    )
