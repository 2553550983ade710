"""The laws' kernels: what the core sends is, bit for bit, what it sends by the laws' steps, which have oracles."""

import dataclasses
import uuid

import numpy as np
import pytest

from stereoservo.control.law_registry import LAWS
from stereoservo.core.cycle import encode
from stereoservo.core.state import ServoGoal
from stereoservo.messages.goals import Goal, Request, RunGoal
from stereoservo_sim.benchmarks.cycle import CoreLoop, rx90

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


@pytest.mark.parametrize("compiled", [True, False])
def test_laws_in_the_images_work_in_cameras_that_lose_sight_of_the_face(compiled):
    """Fixed depths need the centre of every camera, also of one that the face turns away from."""
    sent = []
    for kept in ((1.0, 1.0), (0.0, 1.0)):
        loop = CoreLoop(rx90(), 3)
        if not compiled:
            plain = {name: dataclasses.replace(given, kernel=None) for name, given in LAWS.items()}
            loop.core._derived.laws = plain
        loop.take_model()
        goal = Goal(str(uuid.UUID(int=1)), loop.target_at(0.3), law="stereo", jacobian="fixed-depth", gain=0.2)
        loop.step(requests=(Request(2, "test", RunGoal(goal)),))
        for _ in range(400):
            if isinstance(loop.core.state.source, ServoGoal) and loop.core.state.source.choice.cameras:
                break
            loop.step()
        source = loop.core.state.source
        assert isinstance(source, ServoGoal)
        loop.pending = ()
        source.choice = source.choice._replace(kept=np.array(kept))
        sent.append(loop.step().status.command_raw)
    assert sent[0].any()
    np.testing.assert_array_equal(*sent)
