"""The driver's process in ``bench faults``, which moves the arm and can be killed, stopped, or made to hang.

Run as a module with the driver's options (JSON) and a speed [rad/s]. Prints JSON lines: ``moving``, ``fault``,
``hangs`` with ``t_ns`` of CLOCK_MONOTONIC. A line on stdin makes its loop hang; the end of stdin ends it.
"""

from __future__ import annotations

import json
import select
import sys
import time
from pathlib import Path

import numpy as np

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.canopen.driver import CanJointDriver
from stereoservo_sim.benchmarks.can_peer import LOOP_PRIORITY, real_time

WARM_S = 0.6
"""Time of motion before the fault, in which the monitors learn normal values."""


def report(event: str, **data: object) -> None:
    """Write one line to the parent."""
    print(json.dumps({"event": event, **data}), flush=True)


def move(driver: CanJointDriver, speed: float) -> None:
    """The caller's loop: reads and writes continuously, reports the first fault."""
    period = 1.0 / driver.options.rate_hz
    velocities = np.full(len(driver.options.joint), speed)
    begun = due = time.monotonic()
    told = {"moving": False, "fault": False}
    hangs = False
    while True:
        if not hangs:
            try:
                driver.read_state()
                driver.write_velocity(velocities)
            except DriverError:
                pass  # reported below; the loop continues to request motion, which must not occur
        fault = driver.master.fault
        if fault is not None and not told["fault"]:
            told["fault"] = True
            report("fault", code=fault.code, message=fault.text(), t_ns=fault.t_ns)
        if not told["moving"] and fault is None and time.monotonic() - begun > WARM_S:
            told["moving"] = True
            report("moving", t_ns=time.monotonic_ns())
        due = max(due + period, time.monotonic() - period)
        if select.select([sys.stdin], [], [], max(due - time.monotonic(), 0.0))[0]:
            if not sys.stdin.readline():
                return
            hangs = True
            report("hangs", t_ns=time.monotonic_ns())


def main(options: str, speed: float) -> None:
    """Configure, reset faults of an earlier trial, enable, move."""
    context = DriverContext(MonotonicClock(), "bench", Path(), Path())
    driver = CanJointDriver(json.loads(options), context)
    with real_time(LOOP_PRIORITY):
        try:
            driver.configure()
            if driver.master.fault is not None:
                driver.configure()
            driver.activate()
            move(driver, speed)
        except DriverError as error:
            report("failed", code=error.code, message=str(error))
        finally:
            driver.close()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
