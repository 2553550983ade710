"""Cost of recording: microseconds a cycle in the servo loop and a step in the gateway, and bytes a day of the
demonstration's cell at rest and in motion, with a replay of the recording.
"""

from __future__ import annotations

import socket
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.core.cycle import StepInputs, StepOutputs, encode
from stereoservo.core.state_encoding import encode_state
from stereoservo.daemon.ipc_messages import pack_step_message, unpack_step_message
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.daemon.record_ring import RingReader, RingWriter
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.goals import Enable, Jog
from stereoservo.recording.compression import StepBlocks
from stereoservo.recording.flight_recorder import CHUNK_S
from stereoservo.recording.replay import replay
from stereoservo.recording.step_layout import StepRecord, encode_step
from stereoservo.recording.step_messages import RecordedStep
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.cells import demo_cell_path
from stereoservo_sim.progress import ProgressCall

PART_S, DAY_S = 15.0, 86_400.0
JOG_S, JOG_SPEED = 0.2, 0.1
ROUNDS, EVERY = 4, 15
"""Rounds per repetition, and interval of the steps of a recording used in each."""
Steps = list[tuple[StepInputs, StepOutputs]]


def run_recording(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Cost and size of recording the steps of the demonstration's cell, including rendered cameras."""
    with tempfile.TemporaryDirectory(prefix="ssrecord") as name:
        folder = Path(name)
        sizes: dict[str, Any] = {}
        logs: dict[str, Steps] = {}
        for number, (part, moves) in enumerate((("at_rest", False), ("in_motion", True))):
            logs[part], sizes[part] = _flown(folder / f"{part}.mcap", folder, seed, moves=moves)
            progress("flown", number + 1, 2)
        costs = {part: _costs(log, folder, max(1, repetitions)) for part, log in logs.items()}
    return {"gb_per_day": sizes, "cost_us": costs, "rate_hz": 250.0, "cameras_hz": 30.0, "markers": 14}


def _flown(path: Path, folder: Path, seed: int, *, moves: bool) -> tuple[Steps, dict[str, Any]]:
    """The steps of some seconds of the cell, the size of their recording, and the result of its replay."""
    log: Steps = []
    cell = load_cell_file(demo_cell_path())
    with LockstepCell(
        cell,
        cell_dir=demo_cell_path().parent,
        runtime_dir=folder,
        seed=seed,
        recording=path,
        on_step=lambda inputs, outputs: log.append((inputs, outputs)),
    ) as flown:
        flown.run_for(0.5)
        if moves:
            flown.submit(Enable())
        names = flown.settings.joint_names
        for k in range(round(PART_S / JOG_S)):
            if moves:
                speed = JOG_SPEED if k // 10 % 2 == 0 else -JOG_SPEED
                flown.request(Jog(dict.fromkeys(names, speed), lease_s=2.0 * JOG_S))
            flown.run_for(JOG_S)
        state = len(encode_state(flown.core.state))
    result = replay(path)
    per_day = DAY_S / (len(log) / cell.servo.rate_hz) / 1e9
    former = sum(len(_former(inputs, outputs)) for inputs, outputs in log)
    return log, {
        "file": path.stat().st_size * per_day,
        "as_msgpack": former * per_day,
        "checkpoint_bytes": state,
        "replay_identical": result.identical,
        "steps": result.steps,
    }


def _former(inputs: StepInputs, outputs: StepOutputs) -> bytes:
    """A step's record in its former format without a layout: the baseline."""
    record = StepRecord(
        outputs.status.step, inputs, outputs.command, outputs.status.command_raw, zlib.crc32(encode(outputs))
    )
    return encode(record)


def _costs(log: Steps, folder: Path, repetitions: int) -> dict[str, Any]:
    """Microseconds of CPU per step: in the loop by ring and, as before, by msgpack and a socket; in the gateway."""
    ring = RingWriter(folder / "steps.ring")
    reader = RingReader(folder / "steps.ring")
    reader.attach()
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 << 20)
    rows: dict[str, list[float]] = {"ring": [], "msgpack_and_socket": [], "gateway_take": []}

    def by_ring(inputs: StepInputs, outputs: StepOutputs) -> None:
        ring.write(pack_step_message(RecordedStep(inputs.now_ns, encode_step(inputs, outputs))))

    def by_socket(inputs: StepInputs, outputs: StepOutputs) -> None:
        ours.send(encode(RecordedStep(inputs.now_ns, _former(inputs, outputs))))

    ways = [("ring", by_ring), ("msgpack_and_socket", by_socket)]
    for _ in range(ROUNDS * repetitions):
        for inputs, outputs in log[::EVERY]:
            ways.reverse()  # the first method finds the step's data cold
            for name, way in ways:
                at = time.perf_counter()
                way(inputs, outputs)
                rows[name].append(time.perf_counter() - at)
            theirs.recv(1 << 20)
            at = time.perf_counter()
            for data in reader.read(8):
                unpack_step_message(data)
            rows["gateway_take"].append(time.perf_counter() - at)
    reader.close()
    ring.close()
    ours.close()
    theirs.close()
    found: dict[str, Any] = {name: summary(times, 1e6) for name, times in rows.items()}
    found["former_over_ring"] = float(np.median(rows["msgpack_and_socket"]) / np.median(rows["ring"]))
    found["gateway_compress"] = _compression(log)
    return found


def _compression(log: Steps) -> float:
    """Microseconds of CPU per step to compress it, in blocks as a recorder makes them."""
    records = [encode_step(inputs, outputs) for inputs, outputs in log]
    block = round(CHUNK_S * 1e9 / log[0][0].period_ns)
    blocks = StepBlocks()
    at = time.process_time()
    for k in range(0, len(records), block):
        blocks.compress(records[k : k + block])
    return (time.process_time() - at) / len(records) * 1e6
