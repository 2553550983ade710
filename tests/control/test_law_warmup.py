"""After the warm-up an incidence goal compiles nothing."""

from __future__ import annotations

import numpy as np

from stereoservo.control import incidence_kernel, mobility_kernel
from stereoservo.control.incidence import (
    image_task,
    incidence_freedoms,
    incidence_step,
    incidence_task,
    joint_task,
)
from stereoservo.control.law import Options, Scene
from stereoservo.daemon.kernel_compilation import warm_up_incidences
from stereoservo.kinematics import kernels
from stereoservo.numerics import linear


def compiled():
    return {
        f"{module.__name__}.{name}": len(kernel.signatures)
        for module in (incidence_kernel, incidence_kernel, mobility_kernel, kernels, linear)
        for name, kernel in vars(module).items()
        if hasattr(kernel, "signatures")
    }


def test_nothing_is_left_to_compile(virtual):
    warm_up_incidences()
    before = compiled()
    assert before["stereoservo.control.incidence_kernel.incidence_kernel"] > 0
    rng = np.random.default_rng(0)
    T0, T1 = virtual.random_task(rng, 40, 0.1)
    world = virtual.rx90(rng, T0=T0)
    markers = world.markers()
    scene = Scene(
        np.ascontiguousarray(world.operators()[:4]), 0, np.ascontiguousarray(world.matrices),
        world.camera_centres, np.ascontiguousarray(world.hidden(markers)), world.pixels(markers), np.ones((2, 4)),
    )  # fmt: skip
    goal = world.hidden(virtual.PLATE @ T1.T)
    task = incidence_task(
        ["plane-on-plane", "line-on-line"], [[0, 1, 2], [0, 1]], [goal[:3], goal[:2]], world.infinity, 0.1
    )
    set_points = world.pixels(virtual.PLATE @ T1.T)
    seconds = (
        joint_task(world.q[:4], world.q[:4], np.ones(4), np.ones(4), 1.0),
        image_task(scene.operators, scene.matrices, scene.points, set_points, np.ones((2, 4)), 1.0),
        None,
    )
    for second in seconds:
        incidence_step(scene, task, Options(2.0, 0.004), second)
    incidence_freedoms(scene, task, world.infinity)
    assert compiled() == before
