"""The last state of a cell whose daemon is silent: as the gateway would have told it, and without numpy."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.core.cycle import Status, encode
from stereoservo.daemon.heartbeat import HEARTBEAT_BYTES, HEARTBEAT_LAYOUT
from stereoservo.daemon.ipc_messages import STATE_CAPACITY, RunPlan, ServoState, save_plan
from stereoservo.daemon.seqlock import SlotWriter
from stereoservo.messages.cell_file import check_cell
from stereoservo.messages.reasons import Reason
from stereoservo.messages.servo_state import STATE_LAYOUT, LoopStatistics, state_message
from stereoservo.messages.wire import StateMessage
from stereoservo.ports.devices import CameraDescription, JointDriverDescription, JointSpec

HEARTBEAT = struct.Struct("=qd")
HEAVY = ("numpy", "numba", "scipy", "cv2", "matplotlib", "pybullet")
PROGRAM = """
import sys
from pathlib import Path
import msgspec
from stereoservo.cli.status import newest_state
from stereoservo.messages.directories import CellDirectories

state = newest_state(CellDirectories("bench", Path(sys.argv[1]), Path(sys.argv[1])))
print([name for name in sys.argv[2:] if name in sys.modules])
print(msgspec.json.encode(state).decode())
"""


def test_the_last_state_of_a_silent_daemon_needs_no_numerical_library(tmp_path: Path) -> None:
    cell = check_cell(
        {
            "schema": 1,
            "cell": {"name": "bench"},
            "joints": {"driver": "stub"},
            "camera": [{"name": "left", "driver": "stub"}],
            "safety": {"limit": []},
        }
    )
    specs = tuple(JointSpec(f"j{k}", "revolute", -2.0, 2.0, 1.0, 4.0) for k in (1, 2))
    joints = JointDriverDescription("stub", specs, 250.0, "clock", 0.1, 100.0)
    left = CameraDescription("stub", "left", 64, 48, 30.0, "observations", 1.0)
    plan = RunPlan(cell, "cell.toml", str(tmp_path), str(tmp_path), "boot", joints, (left,), dry_run=True)
    status = Status(
        t_ns=5, step=7, lifecycle="active", model="valid", model_epoch=3, source="law", goal="g", law="stereo",
        level="slow", reasons=(Reason("LOW_GAIN", "info", "j1", 0.5, 1.0, "s", "slow"),),
        positions=np.array([0.25, -1.5]), velocities=np.array([0.1, np.nan]), command_raw=np.zeros(2),
        command=np.array([0.125, 0.0]), error_px=np.inf, task_error=np.array([1.0, np.nan, 2.0]),
        innovation_px={"left": 0.5}, visible={"left": 4}, progress=0.5, efforts=np.array([3.0, 4.0]),
    )  # fmt: skip
    loop = LoopStatistics(250.0, 9, 1, 2, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
    state = ServoState(
        status, loop, True, True, True, 11, ("clipped",), ("a note",), joints_ns=4, frames_ns={"left": 3}
    )
    save_plan(plan)
    with SlotWriter(plan.directories.state_slot, STATE_CAPACITY, STATE_LAYOUT) as writer:
        writer.write(encode(state))
    beat = HEARTBEAT.pack(1, 2.0)  # long ago: the servo process is silent
    with SlotWriter(plan.directories.heartbeat_slot("servo"), HEARTBEAT_BYTES, HEARTBEAT_LAYOUT) as writer:
        writer.write(beat)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path), *HEAVY], capture_output=True, text=True, check=True
    )
    heavy, told = done.stdout.splitlines()
    assert heavy == "[]"
    message = msgspec.json.decode(told, type=StateMessage)
    expected = state_message(plan, "boot", state, now_ns=5, servo_alive=False, last_event=0)
    assert msgspec.structs.replace(message, t_wall=0.0) == msgspec.structs.replace(expected, t_wall=0.0)
    assert message.joints == {"j1": 0.25, "j2": -1.5}
    assert message.velocities == {"j1": 0.1}
    assert (message.joints_age_s, message.camera_age_s) == (0.0, {"left": 0.0}), "as it was then"
    assert message.visible == {"left": 4}
    assert message.task_error == (1.0, 2.0)
