"""The block of what kernels remember: its views, its reading, and what may not stay in a step's room."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stereoservo.core.block import ARRAYS, MOST, OBSERVATIONS, Block, restored
from stereoservo.core.goals.marker_body import place_now

CELL = {"joints": 3, "cameras": 2, "markers": 5, "rows": 7, "window": 4, "past": 65}


def filled(counts: dict[str, int]) -> Block:
    block = Block(counts)
    for k, name in enumerate(ARRAYS):
        array = getattr(block, name)
        array[...] = (np.arange(array.size) + 1000 * k).reshape(array.shape)
    block.numbers.leave_s, block.numbers.last_step_ns = 0.5, 1 << 60
    return block


@pytest.mark.parametrize("counts", [CELL, MOST])
def test_arrays_lie_packed_in_fields_of_their_own(counts: dict[str, int]) -> None:
    block = filled(counts)
    for k, name in enumerate(ARRAYS):
        array, field = getattr(block, name), block.record[name][0]
        np.testing.assert_array_equal(field[: array.size], np.arange(array.size) + 1000 * k)
        assert not field[array.size :].any()
        assert array.flags.c_contiguous
    assert (block.record["leave_s"][0], block.record["last_step_ns"][0]) == (0.5, 1 << 60)
    with pytest.raises(AttributeError, match="write into it"):
        block.command = np.zeros(3)


def test_a_block_is_read_as_it_was_written_and_anything_else_refused() -> None:
    block = filled(CELL)
    again = restored(block.kept())
    for name in OBSERVATIONS:  # which are written out with the cameras
        getattr(again, name)[...] = getattr(block, name)
    assert again.record.tobytes() == block.record.tobytes()
    for name, wrong in (
        ("joints", 13), ("joints", -1), ("joints", "3"), ("past", None), ("command", np.zeros(4)), ("command", 0.0),
        ("history_ns", np.zeros(128)), ("last_step_ns", "now"), ("run", {"held": "now"}), ("run", 3),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError)):
            restored(block.kept() | {name: wrong})


def test_what_a_goal_keeps_of_a_step_does_not_change_with_the_next(bench: Any) -> None:
    bench.ready()
    place = place_now(bench.core._context)
    workspace = bench.core._derived.workspace.prediction
    np.testing.assert_array_equal(place.operators, workspace.operators)
    for kept in (place.operators, place.points):
        assert not any(np.shares_memory(kept, array) for array in (workspace.operators, workspace.points))
