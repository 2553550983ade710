"""A live cell in the Rerun viewer, or in a file that it opens."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import rerun

from stereoservo.messages.wire import EventMessage, FeaturesMessage, StateMessage

SEND_S = 0.4
"""Interval of passing messages on, in columns [s]: one by one, each would wake the threads of the library."""
SERIES = ("joints", "velocities", "command", "innovation_px")


class RerunViewer:
    """Shows messages of a ``cell`` in a viewer that is started, or writes them to ``file`` (*.rrd)."""

    def __init__(self, cell: str, file: Path | None) -> None:
        self._stream = rerun.RecordingStream(f"stereoservo_{cell}")
        if file is None:
            self._stream.spawn()
        else:
            self._stream.save(file)
        self._codes: tuple[str, ...] | None = None
        self._names: dict[str, list[str]] = {}
        self._series: dict[str, list[tuple[float, list[float]]]] = {}
        self._frames: dict[str, list[FeaturesMessage]] = {}
        self._sent_s = 0.0

    def show(self, message: StateMessage | EventMessage | FeaturesMessage) -> None:
        """Log a message of the cell, at most ``SEND_S`` after it."""
        if isinstance(message, EventMessage):
            self._log_text("log", message.t_wall, f"{message.kind}: {message.message}")
        elif isinstance(message, FeaturesMessage):
            self._frames.setdefault(message.camera, []).append(message)
        else:
            self._take_state(message)
        if not 0.0 <= message.t_wall - self._sent_s < SEND_S:
            self._sent_s = message.t_wall
            self._send()

    def _take_state(self, state: StateMessage) -> None:
        for entity in SERIES:
            self._add_series(entity, state.t_wall, getattr(state, entity))
        if state.error_px is not None:
            self._add_series("error_px", state.t_wall, {"error": state.error_px})
        codes = tuple(reason.code for reason in state.reasons)
        if codes != self._codes:
            self._codes = codes
            text = "; ".join(f"{reason.code}: {reason.hint}" for reason in state.reasons)
            self._log_text("reasons", state.t_wall, text or "none")

    def _add_series(self, entity: str, t_wall: float, values: dict[str, float]) -> None:
        names = list(values)
        if not names:
            return
        if self._names.get(entity) != names:
            self._send()  # the buffered rows have the old names
            self._names[entity] = names
            self._stream.log(entity, rerun.SeriesLines(names=names), static=True)
        self._series.setdefault(entity, []).append((t_wall, list(values.values())))

    def _log_text(self, entity: str, t_wall: float, text: str) -> None:
        self._stream.set_time("wall", timestamp=t_wall)
        self._stream.log(entity, rerun.TextLog(text))

    def _send(self) -> None:
        """Pass on buffered series and markers."""
        series, self._series = self._series, {}
        for entity, rows in series.items():
            scalars = rerun.Scalars.columns(scalars=[value for _, values in rows for value in values])
            self._stream.send_columns(
                entity, [_times([t_wall for t_wall, _ in rows])], scalars.partition([len(values) for _, values in rows])
            )
        frames, self._frames = self._frames, {}
        for camera, seen in frames.items():
            points = rerun.Points2D.columns(
                positions=[pixel for frame in seen for pixel in frame.pixels],
                labels=[str(marker) for frame in seen for marker in frame.ids],
            )
            self._stream.send_columns(
                f"camera/{camera}/markers",
                [_times([frame.t_wall for frame in seen])],
                points.partition([len(frame.ids) for frame in seen]),
            )

    def close(self) -> None:
        """Pass on everything that is not shown yet."""
        self._send()
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _times(t_wall: list[float]) -> rerun.TimeColumn:
    """Times [s since 1970] of rows; as an array, because the library converts a list's one by one."""
    return rerun.TimeColumn("wall", timestamp=np.rint(np.array(t_wall) * 1e9).astype("datetime64[ns]"))
