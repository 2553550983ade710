"""A live cell in the Rerun viewer, or in a file that it opens."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import rerun

from stereoservo.messages.wire import EventMessage, FeaturesMessage, StateMessage


class RerunViewer:
    """Shows messages of a ``cell`` in a viewer that is started, or writes them into ``file`` (*.rrd)."""

    def __init__(self, cell: str, file: Path | None) -> None:
        self._stream = rerun.RecordingStream(f"stereoservo_{cell}")
        if file is None:
            self._stream.spawn()
        else:
            self._stream.save(file)
        self._codes: tuple[str, ...] | None = None
        self._series: dict[str, list[str]] = {}

    def show(self, message: StateMessage | EventMessage | FeaturesMessage) -> None:
        """Log a message of the cell."""
        stream = self._stream
        stream.set_time("wall", timestamp=message.t_wall)
        if isinstance(message, EventMessage):
            stream.log("log", rerun.TextLog(f"{message.kind}: {message.message}"))
        elif isinstance(message, FeaturesMessage):
            labels = [str(marker) for marker in message.ids]
            stream.log(
                f"camera/{message.camera}/markers", rerun.Points2D(list(message.pixels), labels=labels)
            )
        else:
            self._show_state(message)

    def _show_state(self, state: StateMessage) -> None:
        for entity, values in (
            ("joints", state.joints),
            ("velocities", state.velocities),
            ("command", state.command),
            ("innovation_px", state.innovation_px),
        ):
            if values:
                self._show_series(entity, values)
        if state.error_px is not None:
            self._stream.log("error_px", rerun.Scalars(state.error_px))
        codes = tuple(reason.code for reason in state.reasons)
        if codes != self._codes:
            self._codes = codes
            text = "; ".join(f"{reason.code}: {reason.hint}" for reason in state.reasons)
            self._stream.log("reasons", rerun.TextLog(text or "none"))

    def _show_series(self, entity: str, values: dict[str, float]) -> None:
        """Log values in one call: a call for each takes three times the processor time of `watch`."""
        names = list(values)
        if self._series.get(entity) != names:
            self._series[entity] = names
            self._stream.log(entity, rerun.SeriesLines(names=names), static=True)
        self._stream.log(entity, rerun.Scalars(list(values.values())))

    def close(self) -> None:
        """Hand over what is not shown yet."""
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
