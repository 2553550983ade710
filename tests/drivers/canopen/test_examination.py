"""What `stereoservo doctor` finds on a CAN bus: over emulated drives, with the driver's thread in virtual time."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, ExaminationFinding
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen import bus_thread, examination, nodes
from stereoservo_drivers.canopen import driver as driver_module
from stereoservo_drivers.canopen.cia402_configuration import SHIPPED_EDS
from stereoservo_drivers.canopen.driver import CanJointDriver
from stereoservo_drivers.canopen.examination import (
    SHOWN_LINES,
    cycles_finding,
    heartbeat_findings,
    latency_finding,
    traffic_finding,
)
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_drivers.options import decode_options
from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator

from .virtual_threads import VirtualChannel, VirtualThreads

OPTIONS: dict[str, Any] = {
    "interface": "stereoservo_slcan",
    "rate_hz": 125.0,
    "max_missed_cycles": 40,
    "heartbeat_timeout_ms": 1000,
    "rpdo_deadline_ms": 1000,
    "loop_timeout_ms": 2000,
    "command_timeout_s": 1.0,
    "joint": [
        {
            "name": f"j{k}", "node_id": k, "counts_per_rev": 65536, "gear_ratio": 100.0, "max_velocity": 1.0,
            "max_acceleration": 10.0, "quick_stop_deceleration": 20.0, "position_min": -2.0, "position_max": 2.5,
        }
        for k in (1, 2)
    ],
}  # fmt: skip
Examine = Callable[..., dict[str, ExaminationFinding]]


def changed(**of_joint_1: Any) -> dict[str, Any]:
    options = copy.deepcopy(OPTIONS)
    options["joint"][0] |= of_joint_1
    return options


@pytest.fixture
def virtual_time(monkeypatch: pytest.MonkeyPatch) -> VirtualThreads:
    """The time of the driver, its bus thread and the examination: the verdicts are on the drives alone."""
    time = VirtualThreads()
    for module in (bus_thread, driver_module, examination, nodes):
        monkeypatch.setattr(module, "time", time)
    monkeypatch.setattr(bus_thread, "threading", time)
    return time


@pytest.fixture
def examine(tmp_path: Path, virtual_time: VirtualThreads, monkeypatch: pytest.MonkeyPatch) -> Examine:
    """Examine with ``options`` an emulated bus that was built for ``drives`` (default: the same) after
    ``orders``; findings by their names.
    """

    def run(
        options: dict[str, Any] = OPTIONS,
        *orders: str,
        drives: dict[str, Any] | None = None,
        allow: bool = False,
    ) -> dict[str, ExaminationFinding]:
        options = {**options, "channel": "emulated"}
        built = {**(drives or options), "channel": "emulated"}
        emulator = make_bus_emulator(
            decode_options(CanOptions, built, "canopen"), DrivesSettings(plant="ideal", brake_ms=10.0),
            t_ns=virtual_time.monotonic_ns(),
        )  # fmt: skip
        for order in orders:
            emulator.order(order, virtual_time.monotonic_ns())
        for module in (driver_module, examination):
            monkeypatch.setattr(module, "Channel", lambda _: VirtualChannel(emulator, virtual_time))
        driver = CanJointDriver(options, DriverContext(MonotonicClock(), "x", tmp_path, tmp_path))
        found = list(driver.examine(lambda _: allow))
        emulator.close()
        assert len({finding.name for finding in found}) == len(found)
        return {finding.name: finding for finding in found}

    return run


def test_a_good_bus_has_nothing_to_cure(examine: Examine) -> None:
    found = examine(allow=True)
    assert [f.name for f in found.values() if f.ok is not True] == []
    assert "0 without all answers, 0 skipped" in found["cycle"].message
    assert "vendor_id 0x53455256" in found["node 1 (j1)"].message
    assert "switch on disabled; " in found["node 2 (j2) state"].message
    assert "9 cyclic velocity" in found["node 1 (j1) modes"].message
    assert "% in the worst case" in found["bus load"].message
    for joint in ("j1", "j2"):
        assert found[f"{joint} position"].ok is True
        assert found[f"{joint} at rest"].ok is True
        assert "by its own encoder" in found[f"{joint} jog"].message


def test_what_is_odd_in_an_eds_is_told_by_line(examine: Examine, tmp_path: Path) -> None:
    own = tmp_path / "own.eds"
    text = SHIPPED_EDS.read_text().replace("VendorName=stereoservo", "VendorName=Müller\na remark")
    own.write_bytes(text.encode("cp1252"))
    found = examine(OPTIONS | {"eds": str(own)})
    assert found["own.eds:19"].ok is None
    assert "code page 1252" in found["own.eds:19"].message
    assert "'a remark': neither a header nor KEY=VALUE: skipped" in found["own.eds:20"].message
    assert [f.name for f in found.values() if f.ok is False] == []
    own.write_text(text.replace("AccessType=", "Access="))
    found = examine(OPTIONS | {"eds": str(own)}, drives=OPTIONS)
    assert sum(name.startswith("own.eds:") for name in found) == SHOWN_LINES
    assert "more lines" in found["own.eds"].message
    own.write_text("no section")
    found = examine(OPTIONS | {"eds": str(own)}, drives=OPTIONS)
    assert found["drives"].ok is False
    assert "line 1: 'no section'" in found["drives"].message


def test_nothing_moves_without_leave(examine: Examine) -> None:
    found = examine()
    assert found["j1 jog"].ok is None
    assert "not allowed" in found["j1 jog"].message


def test_drives_that_are_missing_doubled_or_others(examine: Examine) -> None:
    found = examine(OPTIONS, "silence 2")
    assert found["node 2 (j2)"].message == "no answer"
    assert "powered" in found["node 2 (j2)"].remedy
    assert found["drives"].ok is False  # it cannot be configured
    found = examine(OPTIONS, "duplicate 1 running")
    assert found["node 1 (j1)"].message == "2 drives answer as node 1"
    moved = changed(node_id=9)
    found = examine(moved, drives=OPTIONS)
    assert "Nodes 1 answer" in found["node 9 (j1)"].remedy
    found = examine(changed(vendor_id=0xFB), drives=OPTIONS)
    assert found["node 1 (j1)"].ok is False
    assert "vendor_id = 0x53455256" in found["node 1 (j1)"].remedy


def test_a_drive_in_fault_is_told_in_words_and_nothing_is_jogged(examine: Examine) -> None:
    found = examine(OPTIONS, "fault 2 0x3210", allow=True)
    assert found["node 2 (j2) state"].ok is False
    assert "0x3210 DC link over-voltage" in found["node 2 (j2) state"].message
    assert found["node 2 (j2) state"].remedy
    assert found["fault"].ok is False
    assert "j1 jog" not in found


def test_a_drive_that_speaks_rpm_is_found_by_the_jog(examine: Examine) -> None:
    found = examine(drives=changed(velocity_units_per_rev_s=60.0), allow=True)
    assert found["j1 jog"].ok is False
    assert "60 (rpm)" in found["j1 jog"].remedy, found["j1 jog"]


def test_a_bus_that_is_not_there(tmp_path: Path) -> None:
    options = {**OPTIONS, "channel": "socket://127.0.0.1:1"}
    driver = CanJointDriver(options, DriverContext(MonotonicClock(), "x", tmp_path, tmp_path))
    found = list(driver.examine(lambda _: True))
    assert [(f.name, f.ok) for f in found] == [("bus load", True), ("bus", False)]
    assert "Nobody listens there" in found[1].message


def test_verdicts_on_traffic_cycles_latency_and_heartbeats() -> None:
    options = decode_options(CanOptions, {**OPTIONS, "channel": "x"}, "canopen")
    assert traffic_finding(options, [CanFrame(0x701, b"\x05")]).ok is True
    other = traffic_finding(options, [CanFrame(0x80), CanFrame(0x202, bytes(6))])
    assert other.ok is False
    assert "0x80, 0x202" in other.message
    assert cycles_finding(250, 0, 0).ok is True
    assert cycles_finding(250, 1, 0).ok is None
    assert cycles_finding(250, 20, 0).ok is False
    assert cycles_finding(250, 0, 20).ok is None
    assert latency_finding(np.full(10, 1e-3), 4e-3).ok is True
    assert latency_finding(np.full(10, 3e-3), 4e-3).ok is None
    beats = [CanFrame(0x701, b"\x05")] * 50
    (rare,) = heartbeat_findings(options, beats)
    assert (rare.name, rare.ok) == ("node 2 (j2) heartbeat", False)
    (well,) = heartbeat_findings(options, beats + [CanFrame(0x702, b"\x05")] * 48)
    assert well.ok is True
