"""``bench can``: CAN transports under a bare cycle, and the driver with six emulated drives, each beside a
baseline.
"""

from __future__ import annotations

from typing import Any

from stereoservo_sim.benchmarks.can_drives import RATE_HZ, fastest_paced, run_drives, saturate
from stereoservo_sim.benchmarks.can_transports import TRANSPORTS, time_transport
from stereoservo_sim.progress import ProgressCall

BACK_TO_BACK_S = 0.2
"""For each repetition, of every transport."""
PACED_CYCLES = 20
DRIVES_S = 10.0 / 7.0
"""For each repetition, at 250 Hz: 10 s unless asked otherwise, 60 s with 42 repetitions."""
PACED_S = 3.0 / 7.0
PACED_RATES_HZ = [400.0, 425.0, 450.0]
"""On a fixed grid, of the 499 Hz that the bus can carry at worst."""
TARGETS = {
    "six_drives_over_tcp.skipped_cycles": "no more than empty_loop.missed",
    "six_drives_over_tcp.cpu_ms_per_cycle.bus_thread": "at most 0.3",
    "with_bit_times.back_to_back.share_of_limit": "at least 0.9",
    "with_bit_times.on_a_grid.held_hz": "449 or more: 0.9 of the bus's limit, with 99 % of its cycles complete",
}
"""What the figures are compared with; the bench itself does not judge."""


def run_can(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Figures of all parts; ``repetitions`` scales their length, ``seed`` has no effect."""
    total = len(TRANSPORTS) + 3
    transports = {}
    for k, name in enumerate(TRANSPORTS):
        progress("can", k, total)
        transports[name] = time_transport(name, BACK_TO_BACK_S * repetitions, PACED_CYCLES * repetitions)
    progress("can", len(TRANSPORTS), total)
    drives = run_drives(RATE_HZ, DRIVES_S * repetitions, bit_time=False)
    progress("can", len(TRANSPORTS) + 1, total)
    paced = {"back_to_back": saturate(PACED_S * repetitions)}
    progress("can", len(TRANSPORTS) + 2, total)
    paced["on_a_grid"] = fastest_paced(PACED_RATES_HZ, PACED_S * repetitions)
    progress("can", total, total)
    return {
        "transports": transports,
        "six_drives_over_tcp": drives,
        "with_bit_times": paced,
        "targets": TARGETS,
    }
