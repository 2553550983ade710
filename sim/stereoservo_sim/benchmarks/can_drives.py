"""The driver ``canopen`` against six emulated CiA 402 drives in another process, over serial-line CAN on TCP."""

from __future__ import annotations

import json
import math
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.runtime.cellfile import load_cell_file
from stereoservo.runtime.clock import MonotonicClock
from stereoservo.runtime.ports import DriverContext, DriverError
from stereoservo_drivers.can.load import cycle_load
from stereoservo_drivers.canopen.driver import CanJointDriver
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_sim.benchmarks.can_peer import AXES, LOOP_PRIORITY, peer, real_time
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.drives.building import drives_of_cell

SPEED = 0.05
"""[rad/s], amplitude of the commands."""
SWING_S = 2.0
LENGTHS = [0] + [6, 6, 4] * AXES
"""Data bytes of a cycle: SYNC; per drive the command, status word with position, velocity."""
REACHED = 0.99
"""Share of a rate's cycles that must be complete for the rate to count as reached."""
TOLERANT = {
    "max_missed_cycles": 50,
    "rpdo_deadline_ms": 1000,
    "heartbeat_timeout_ms": 1000,
    "loop_timeout_ms": 1000,
    "command_timeout_s": 1.0,
    "max_bus_load": 0.95,
}
"""Stalls of a shared machine are to be counted here; with a cell's own limits they would stop the arm."""


def bench_options(rate_hz: float) -> CanOptions:
    """Six CiA 402 drives of the shipped cell, with velocity as only feedback beside status and position."""
    options, _ = drives_of_cell(load_cell_file(shipped_cell_path("hil-can")))
    return msgspec.structs.replace(options, rate_hz=rate_hz, feedback=("velocity",), **TOLERANT)


def run_drives(rate_hz: float, seconds: float, *, bit_time: bool) -> dict[str, Any]:
    """Enabled and moving for ``seconds``; an empty loop of the same rate beside it, in a process of its own.

    A fault ends the run and is a figure: ``fault``, None where there was none.
    """
    options = bench_options(rate_hz)
    wanted = {"options": msgspec.to_builtins(options), "bit_time": bit_time}
    with peer("drives", json.dumps(wanted)) as (_, channel), real_time(LOOP_PRIORITY) as scheduling:
        settings = msgspec.to_builtins(msgspec.structs.replace(options, channel=channel))
        here = Path()
        driver = CanJointDriver(settings, DriverContext(MonotonicClock(), "bench", here, here))
        try:
            driver.configure()
            driver.activate()
            with peer("empty", str(rate_hz), str(seconds)) as (empty, _):
                figures = {"scheduling": scheduling, **_move(driver, rate_hz, seconds)}
                figures["empty_loop"] = _empty_figures(empty)
            driver.deactivate()
        except DriverError as error:
            return {"rate_hz": rate_hz, "seconds": 0.0, "fault": _told(error)}
        finally:
            driver.close()
    return figures


def _told(error: DriverError) -> dict[str, str]:
    return {"code": error.code, "message": str(error)}


def _move(driver: CanJointDriver, rate_hz: float, seconds: float) -> dict[str, Any]:
    """The caller's loop until its time or the first fault is over; counts of the bus thread in it."""
    assert driver.bus is not None
    cycles, thread = driver.master.statistics, driver.bus.statistics
    before = cycles.cycles, cycles.incomplete, thread.skipped
    thread.late_max_ns = 0
    period = 1.0 / rate_hz
    answered: list[float] = []
    work, own = time.process_time(), time.thread_time()
    begun = due = time.monotonic()
    fault: dict[str, Any] | None = None
    while (t := time.monotonic() - begun) < seconds:
        try:
            driver.read_state()
            driver.write_velocity(np.full(AXES, SPEED * math.sin(2.0 * math.pi * t / SWING_S)))
        except DriverError as error:
            fault = _told(error)
            break
        answered.append(cycles.answered_ns * 1e-6)
        due = max(due + period, time.monotonic() - period)
        time.sleep(max(due - time.monotonic(), 0.0))
    spent, work, own = time.monotonic() - begun, time.process_time() - work, time.thread_time() - own
    count = max(cycles.cycles - before[0], 1)
    return {
        "rate_hz": rate_hz,
        "seconds": round(spent, 1),
        "fault": fault,
        "cycles": count,
        "skipped_cycles": thread.skipped - before[2],
        "incomplete_cycles": cycles.incomplete - before[1],
        "late_max_ms": round(thread.late_max_ns * 1e-6, 3),
        "answered_ms": summary(answered) if answered else None,
        "cpu_ms_per_cycle": {
            "process": round(work / count * 1e3, 4),
            "bus_thread": round((work - own) / count * 1e3, 4),
        },
    }


def _empty_figures(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    figures: dict[str, Any] = json.loads(process.stdout.readline())
    figures["lateness_us"] = summary(figures["lateness_us"])
    return figures


def fastest_paced(rates_hz: list[float], seconds: float) -> dict[str, Any]:
    """With frames that take their time on the wire: the highest of ``rates_hz`` (ascending) that is held."""
    limit = cycle_load(LENGTHS, 1.0, 1_000_000).max_rate_hz
    trials = []
    reached = 0.0
    for rate_hz in rates_hz:
        trial = run_drives(rate_hz, seconds, bit_time=True)
        trials.append(trial)
        if trial["fault"] is not None:
            continue
        complete = trial["cycles"] - trial["incomplete_cycles"]
        trial["complete_per_s"] = round(complete / trial["seconds"], 1)
        if complete >= REACHED * rate_hz * trial["seconds"]:
            reached = rate_hz
    return {
        "bus_limit_hz": round(limit, 1),
        "reached_hz": reached,
        "share_of_limit": round(reached / limit, 3),
        "trials": trials,
    }
