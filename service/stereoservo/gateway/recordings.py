"""Flight recordings: step records of the servo process into files."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from stereoservo.gateway.publisher import EventLog
from stereoservo.runtime.interprocess import FromServoSteps, RecordedCheckpoint, RecordingStart, RunPlan
from stereoservo.runtime.recorder import FlightRecorder


class Recordings:
    """The recording that runs, if one does. ``path``: its file, or that of the last one."""

    def __init__(self, plan: RunPlan, log: EventLog) -> None:
        self._plan = plan
        self._log = log
        self._recorder: FlightRecorder | None = None
        self.path = ""
        self.steps = 0

    @property
    def running(self) -> bool:
        """Whether a file is being written."""
        return self._recorder is not None

    def take(self, item: FromServoSteps) -> None:
        """Take what the servo process sent; its first message begins a file."""
        if isinstance(item, RecordingStart):
            self.stop()
            self._recorder = FlightRecorder(self._new_path(), item.settings, item.fingerprint)
            self.path = str(self._recorder.path)
            self._log.add("recording", message=self.path, origin="gateway")
        elif self._recorder is None:
            return
        elif isinstance(item, RecordedCheckpoint):
            if item.lost:
                self._recorder.gap(item.lost, item.t_ns)
            self._recorder.checkpoint(item.step, item.state, item.t_ns)
        else:
            self._recorder.step(item.data, item.t_ns)

    def _new_path(self) -> Path:
        """The file that was asked for; another where it exists (a gateway that was restarted goes on in a new one)."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        wanted = Path(self._plan.record) if self._plan.record not in ("", "auto") else None
        if wanted is not None:
            return wanted.with_stem(f"{wanted.stem}-{stamp}") if wanted.exists() else wanted
        return self._plan.directories.recordings / f"{self._plan.cell.cell.name}-{stamp}.mcap"

    def stop(self) -> int:
        """Finish the file; gives the number of its steps. Idempotent."""
        if self._recorder is None:
            return 0
        recorder, self._recorder = self._recorder, None
        recorder.close()
        return recorder.steps
