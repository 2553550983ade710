"""After the warm-up no request, however its arrays lie in memory, makes a kernel compile."""

import importlib
import pkgutil

import msgspec
import numpy as np

import stereoservo.kinematics
import stereoservo.planning
from stereoservo.daemon.kernel_compilation import warm_up_planner
from stereoservo.planning.planner import plan
from stereoservo.planning.tracking import advance, sample_plan


def signatures():
    """Every compiled signature of every kernel of the two packages."""
    found = set()
    for package in (stereoservo.planning, stereoservo.kinematics):
        for module in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            for name, value in vars(importlib.import_module(module.name)).items():
                for signature in getattr(value, "signatures", ()):
                    found.add((name, signature))
    return found


def awkward(array):
    """The same numbers in Fortran order, read-only."""
    array = np.asfortranarray(array)
    array.flags.writeable = False
    return array


def test_nothing_is_left_to_compile(virtual, cells):
    warm_up_planner()
    before = signatures()
    assert any(name == "_evaluate_samples" for name, _ in before)
    rng = np.random.default_rng(40)
    requests = []
    for make in (cells.rx90, cells.seven, cells.scara):
        world = make(rng)
        _, T_star = cells.goal_nearby(rng, world, 0.4)
        requests += [cells.request(world, T_star), cells.request(world, T_star, profile="exponential")]
        tight = {"position_max": world.q + 0.02}
        requests += [cells.request(world, T_star, limits=tight)]
    T0, T_star = cells.border_task(rng)
    requests.append(cells.request(virtual.free_arm(rng, T0), T_star, faces=np.zeros((0, 3), dtype=np.int64)))
    for request in requests:
        fields = {
            name: awkward(getattr(request, name))
            for name in request.__struct_fields__
            if isinstance(getattr(request, name), np.ndarray)
        }
        found = plan(msgspec.structs.replace(request, **fields)).plan
        if found is not None:
            sample_plan(found, advance(found, 0.2, 0.01, 0.7))
    assert signatures() - before == set()
