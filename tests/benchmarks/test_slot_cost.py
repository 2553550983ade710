"""What the servo loop runs for its slots, counted in lines of Python, which no load disturbs."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from stereoservo.daemon.seqlock import SlotReader, SlotWriter


def _lines(call: Callable[[], object]) -> int:
    count = 0

    def trace(frame: FrameType, what: str, argument: Any) -> Any:
        nonlocal count
        count += what == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count


def test_a_record_passes_in_few_lines(tmp_path: Path) -> None:
    with (
        SlotWriter(tmp_path / "slot", 400, "record") as writer,
        SlotReader(tmp_path / "slot", "record") as reader,
    ):
        assert _lines(lambda: writer.write(bytes(300))) <= 7  # were 12
        assert _lines(reader.poll) <= 10  # were 15
        assert _lines(reader.poll) <= 6  # were 7
        assert reader.newest() == bytes(300)
