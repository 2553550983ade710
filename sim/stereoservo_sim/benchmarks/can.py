"""``bench can``: CAN transports under a bare cycle of six drives (SYNC and six commands out, twelve replies in), and
the driver ``canopen`` with six emulated CiA 402 drives in another process, over serial-line CAN on TCP; each beside a
baseline.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.messages.cell_file import load_cell_file
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.can.channel import Channel, ChannelSettings
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.load import cycle_load, frame_bits
from stereoservo_drivers.canopen.codec import NOT_CYCLIC, Codec, Subscriptions
from stereoservo_drivers.canopen.driver import CanJointDriver, make_bringup, make_codec
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_sim.benchmarks.can_peer import ANSWERS, AXES, COMMANDS, LOOP_PRIORITY, SYNC, peer, real_time
from stereoservo_sim.benchmarks.timing import summary
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.emulators.bus.factory import drives_of_cell
from stereoservo_sim.progress import ProgressCall

CYCLE = [SYNC, *COMMANDS]
PACED_HZ = 200.0
CYCLE_ANSWER_S = 1.0
"""Time after which a cycle without all replies is lost."""
STOCK_OPTIONS: dict[str, str | int | float | bool] = {"sleep_after_open": 0}
TRANSPORTS = ("virtual", "slcan_pty", "slcan_tcp", "stock_slcan_pty", "stock_slcan_tcp")
"""Transports. ``stock``: python-can's own ``slcan``, the baseline."""


class _InlinePeer:
    """The six nodes on python-can's virtual bus, in this process and thread."""

    def __init__(self, settings: ChannelSettings) -> None:
        self._channel = Channel(settings)

    def answer(self) -> None:
        for _, frame in self._channel.receive(0.0):
            if frame == SYNC:
                self._channel.send(ANSWERS)

    def close(self) -> None:
        self._channel.close()


class _Transport:
    """A channel and, if they run in this process, its nodes."""

    def __init__(self, settings: ChannelSettings, inline: bool) -> None:
        self.channel = Channel(settings)
        self._inline = _InlinePeer(settings) if inline else None

    def cycle(self) -> bool:
        """Run one cycle; False if a reply is missing."""
        self.channel.send(CYCLE)
        if self._inline is not None:
            self._inline.answer()
        heard: list[CanFrame] = []
        deadline = time.monotonic() + CYCLE_ANSWER_S
        while len(heard) < len(ANSWERS):
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            heard += [frame for _, frame in self.channel.receive(left)]
        if heard != ANSWERS:
            raise DriverError("bench", f"{self.channel.name}: other answers than were sent: {heard}")
        return True

    def close(self) -> None:
        self.channel.close()
        if self._inline is not None:
            self._inline.close()


@contextmanager
def _line(transport: str) -> Iterator[_Transport]:
    if transport == "virtual":
        line = _Transport(ChannelSettings("virtual", "bench_can"), inline=True)
        try:
            yield line
        finally:
            line.close()
        return
    stock = transport.startswith("stock_")
    with peer("echo", transport.rpartition("_")[2]) as (_, channel):
        settings = ChannelSettings(
            "slcan" if stock else "stereoservo_slcan", channel, interface_options=STOCK_OPTIONS if stock else {}
        )
        line = _Transport(settings, inline=False)
        try:
            yield line
        finally:
            line.close()


def time_transport(transport: str, seconds: float, paced_cycles: int) -> dict[str, Any]:
    """Time cycles at full speed for ``seconds``, then at given rates. ``latency_ms``: SYNC sent to the last reply."""
    with real_time(LOOP_PRIORITY), _line(transport) as line:
        for _ in range(5):
            line.cycle()
        cycles = lost = 0
        begun, work = time.monotonic(), time.process_time()
        while (spent := time.monotonic() - begun) < seconds:
            lost += not line.cycle()
            cycles += 1
        work = time.process_time() - work
        latencies = _paced(line, paced_cycles)
    figures: dict[str, Any] = {
        "cycles_per_s": round(cycles / spent, 1),
        "cpu_ms_per_cycle": round(work / cycles * 1e3, 4),
        "lost_cycles": lost,
    }
    if latencies:
        figures[f"latency_ms_at_{PACED_HZ:g}_hz"] = summary(latencies, 1e3)
    return figures


def _paced(line: _Transport, cycles: int) -> list[float]:
    """Durations [s] of each complete cycle, at the given rate or as fast as the transport can."""
    latencies = []
    due = time.monotonic()
    for _ in range(cycles):
        due = max(due + 1.0 / PACED_HZ, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))
        begun = time.monotonic()
        if line.cycle():
            latencies.append(time.monotonic() - begun)
    return latencies


# -- the driver with six drives --------------------------------------------------------------------------------

SPEED = 0.05
"""Amplitude of the commands [rad/s]."""
SWING_S = 2.0
LENGTHS = [0] + [6, 6, 4] * AXES
"""Data bytes of a cycle: SYNC; per drive the command, status word with position, velocity."""
RATE_HZ = 250.0
SEGMENT_CYCLES = 100
ANSWER_S = 0.1
HELD = 0.99
"""Share of a rate's cycles that must be complete for the rate to count as held."""
TOLERANT = {
    "max_missed_cycles": 50,
    "rpdo_deadline_ms": 1000,
    "heartbeat_ms": 100,
    "heartbeat_timeout_ms": 1000,
    "loop_timeout_ms": 1000,
    "command_timeout_s": 1.0,
    "max_bus_load": 0.95,
}
"""Time limits that let stalls of a shared machine be counted; with a cell's own limits they would stop the arm.
Heartbeats use almost nothing of the bus, whose limit is that of the cycle alone.
"""


def bench_options(rate_hz: float) -> CanOptions:
    """Options of the shipped cell's six CiA 402 drives, with only velocity as feedback besides status and position."""
    options, _ = drives_of_cell(load_cell_file(shipped_cell_path("hil-can")))
    return msgspec.structs.replace(options, rate_hz=rate_hz, feedback=("velocity",), **TOLERANT)


def run_drives(rate_hz: float, seconds: float, *, bit_time: bool) -> dict[str, Any]:
    """Timing of an enabled, moving arm for ``seconds``, with an empty loop of the same rate in its own process as
    baseline.

    A fault ends the run and is part of the result: ``fault``, None if there was none.
    """
    options = bench_options(rate_hz)
    wanted = {"options": msgspec.to_builtins(options), "bit_time": bit_time}
    with (
        peer("drives", json.dumps(wanted)) as (_, channel),
        peer("empty", str(rate_hz), str(seconds)) as (empty, _),
        real_time(LOOP_PRIORITY) as scheduling,
    ):
        settings = msgspec.to_builtins(msgspec.structs.replace(options, channel=channel))
        here = Path()
        driver = CanJointDriver(settings, DriverContext(MonotonicClock(), "bench", here, here))
        try:
            driver.configure()
            driver.activate()
            assert empty.stdin is not None
            print("begin", file=empty.stdin, flush=True)
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
    """Run the caller's loop until its end time or the first fault; returns counts of the bus thread."""
    assert driver.bus is not None
    cycles, thread = driver.master.statistics, driver.bus.statistics
    before = cycles.cycles, cycles.incomplete, thread.skipped
    thread.late_max_ns = 0
    period = 1.0 / rate_hz
    answered: list[float] = []
    meter = _CpuMeter(driver)
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
        meter.look()
        due = max(due + period, time.monotonic() - period)
        time.sleep(max(due - time.monotonic(), 0.0))
    spent = time.monotonic() - begun
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
        "cpu_ms_per_cycle": meter.figures(),
    }


class _CpuMeter:
    """Measures CPU time per cycle: of the bus thread, and of the process with the caller's loop; medians of
    segments, and the whole.

    Other users of the machine slow some segments down; the median of segments measures the code better than the whole.
    """

    def __init__(self, driver: CanJointDriver) -> None:
        self._statistics = driver.master.statistics
        self._first = self._last = self._read()
        self._segments: list[tuple[float, float]] = []

    def _read(self) -> tuple[int, float, float]:
        """Cycles, CPU of the process, CPU of all its threads but this one [s]."""
        process = time.process_time()
        return self._statistics.cycles, process, process - time.thread_time()

    def look(self) -> None:
        """Called every cycle: ends a segment when it is long enough."""
        if self._statistics.cycles - self._last[0] >= SEGMENT_CYCLES:
            now = self._read()
            self._segments.append(_per_cycle_ms(self._last, now))
            self._last = now

    def figures(self) -> dict[str, Any]:
        whole = _per_cycle_ms(self._first, self._read())
        process, bus_thread = (statistics.median(values) for values in zip(*self._segments or [whole], strict=True))
        return {
            "bus_thread": round(bus_thread, 4),
            "process": round(process, 4),
            "segments": len(self._segments),
            "bus_thread_whole": round(whole[1], 4),
            "process_whole": round(whole[0], 4),
        }


def _per_cycle_ms(before: tuple[int, float, float], after: tuple[int, float, float]) -> tuple[float, float]:
    cycles = max(after[0] - before[0], 1)
    return (after[1] - before[1]) / cycles * 1e3, (after[2] - before[2]) / cycles * 1e3


def _empty_figures(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    figures: dict[str, Any] = json.loads(process.stdout.readline())
    figures["lateness_us"] = summary(figures["lateness_us"])
    return figures


class _Pump(Subscriptions):
    """A link for bring-up and the subsequent cycle, in one thread."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel
        self.bits = 0

    def send(self, frames: list[CanFrame]) -> None:
        self.bits += sum(map(frame_bits, frames))
        self._channel.send(frames)

    def receive(self, timeout_s: float) -> list[CanFrame]:
        frames = [frame for _, frame in self._channel.receive(timeout_s)]
        for frame in frames:
            self.bits += frame_bits(frame)
            self.tell(frame)
        return frames

    def wait(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.receive(left)

    def now_ns(self) -> int:
        return time.monotonic_ns()


def saturate(seconds: float) -> dict[str, Any]:
    """Highest cycle rate with bit times on the wire: each cycle starts as soon as all replies have arrived.

    ``bus_busy``: share of the time that the bits of all frames took, by their exact lengths.
    """
    options = bench_options(RATE_HZ)
    wanted = {"options": msgspec.to_builtins(options), "bit_time": True}
    codec = make_codec(options)
    bringup = make_bringup(options, codec, Path())
    with peer("drives", json.dumps(wanted)) as (_, channel), real_time(LOOP_PRIORITY) as scheduling:
        bus = Channel(msgspec.structs.replace(options, channel=channel))
        pump = _Pump(bus)
        try:
            bringup.connect(pump)
            pump.bits = complete = lost = 0
            begun, work = time.monotonic(), time.process_time()
            heartbeat = begun
            while (now := time.monotonic()) - begun < seconds:
                frames = codec.poll() + codec.idle()
                if now >= heartbeat:
                    frames += codec.heartbeat()
                    heartbeat = now + options.heartbeat_ms * 1e-3
                pump.send(frames)
                if _answered(codec, pump):
                    complete += 1
                else:
                    lost += 1
            spent, work = time.monotonic() - begun, time.process_time() - work
        finally:
            bus.close()
    limit = cycle_load(LENGTHS, 1.0, options.bitrate).max_rate_hz
    return {
        "scheduling": scheduling,
        "cycles_per_s": round(complete / spent, 1),
        "lost_cycles": lost,
        "worst_case_limit_per_s": round(limit, 1),
        "share_of_limit": round(complete / spent / limit, 3),
        "bus_busy": round(pump.bits / options.bitrate / spent, 3),
        "cpu_ms_per_cycle": round(work / max(complete + lost, 1) * 1e3, 4),
    }


def _answered(codec: Codec, pump: _Pump) -> bool:
    """Whether all replies to a poll arrive in time."""
    missing, until = codec.expected, time.monotonic() + ANSWER_S
    while missing and (left := until - time.monotonic()) > 0:
        for frame in pump.receive(left):
            bit = codec.receive(frame)
            if bit != NOT_CYCLIC:
                missing &= ~(1 << bit)
    return not missing


def fastest_paced(rates_hz: list[float], seconds: float) -> dict[str, Any]:
    """Highest of ``rates_hz`` (ascending) that the driver holds with bit times on the wire."""
    limit = cycle_load(LENGTHS, 1.0, 1_000_000).max_rate_hz
    trials = []
    held = 0.0
    for rate_hz in rates_hz:
        trial = run_drives(rate_hz, seconds, bit_time=True)
        trials.append(trial)
        if trial["fault"] is not None:
            continue
        complete = trial["cycles"] - trial["incomplete_cycles"]
        trial["complete_per_s"] = round(complete / trial["seconds"], 1)
        if complete >= HELD * rate_hz * trial["seconds"]:
            held = rate_hz
    return {"held_hz": held, "held_share_of_limit": round(held / limit, 3), "trials": trials}


# -- the bench -------------------------------------------------------------------------------------------------

BACK_TO_BACK_S = 0.2
"""Duration per repetition, for each transport."""
PACED_CYCLES = 20
DRIVES_S = 10.0 / 7.0
"""Duration per repetition, at 250 Hz: 10 s by default, 60 s with 42 repetitions."""
PACED_S = 3.0 / 7.0
PACED_RATES_HZ = [400.0, 425.0, 450.0]
"""Rates on a fixed grid; the bus can carry 499 Hz in the worst case."""
TARGETS = {
    "six_drives_over_tcp.skipped_cycles": "no more than empty_loop.missed",
    "six_drives_over_tcp.cpu_ms_per_cycle.bus_thread": "at most 0.3",
    "with_bit_times.back_to_back.share_of_limit": "at least 0.9",
    "with_bit_times.on_a_grid.held_hz": "449 or more: 0.9 of the bus's limit, with 99 % of its cycles complete",
}
"""Values to compare the results with; the bench itself does not judge."""


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
    return {"transports": transports, "six_drives_over_tcp": drives, "with_bit_times": paced, "targets": TARGETS}
