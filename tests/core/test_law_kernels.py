"""The laws' kernels: what the core sends is, bit for bit, what it sends by the laws' steps, which have oracles."""

import dataclasses

import pytest

from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import encode
from stereoservo_sim.benchmarks.core_loop import CoreLoop, rx90

COMPILED = [name for name, law in LAWS.items() if law.kernel is not None]


def test_the_laws_that_follow_no_plan_are_compiled():
    assert {"stereo", "image", "points", "cartesian3", "cartesian2"} <= set(COMPILED)


@pytest.mark.parametrize("law", COMPILED)
def test_a_kernel_gives_the_bits_of_its_laws_step(law):
    loops = [CoreLoop(rx90(), 3) for _ in range(2)]
    plain = {name: dataclasses.replace(given, kernel=None) for name, given in LAWS.items()}
    loops[1].core._derived.laws = plain
    moved = []
    for loop in loops:
        loop.start_goal(law)
    for step in range(45):
        for loop in loops:
            if step % 15 == 14:  # another camera is hidden for a while: other markers count, and another face
                loop.pending = loop.pending[step // 30 :]
            if step == 30:  # a goal that moves is followed by the law's step, and stands again later
                loop.move_goal(1)
        first, second = (loop.step() for loop in loops)
        assert encode(first) == encode(second), step
        moved.append(bool(first.status.command_raw.any()))
        assert first.status.law == law
    assert all(moved)
