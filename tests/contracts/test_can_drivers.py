"""The CAN driver keeps the joint drivers' contract: both protocols, on every transport that needs no hardware.

Emulated drives are served by a thread of this process. Time limits are wide, since machines that run tests stall.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, ClassVar
from uuid import uuid4

import pytest

from stereoservo.ports.devices import DriverContext, JointDriver
from stereoservo_drivers.canopen.driver import CanJointDriver
from stereoservo_drivers.canopen.options import CanOptions
from stereoservo_drivers.contracts import JointDriverContract
from stereoservo_drivers.options import decode_options
from stereoservo_sim.emulators.bus.bus_server import BusServer, open_endpoint
from stereoservo_sim.emulators.bus.factory import DrivesSettings, make_bus_emulator


def can_joint(k: int, **changes: Any) -> dict[str, Any]:
    return {
        "name": f"j{k}", "node_id": k, "counts_per_rev": 65536, "gear_ratio": 100.0, "max_velocity": 1.0,
        "max_acceleration": 10.0, "quick_stop_deceleration": 20.0, "position_min": -2.0, "position_max": 2.5,
    } | changes  # fmt: skip


PATIENT: dict[str, Any] = {
    "rate_hz": 125.0,
    "max_missed_cycles": 50,
    "heartbeat_timeout_ms": 1000,
    "rpdo_deadline_ms": 1000,
    "loop_timeout_ms": 2000,
}
CIA_402: dict[str, Any] = PATIENT | {
    "feedback": ["velocity", "effort", "following_error"],
    "output": [{"name": "light", "node_id": 2, "bit": 16}],
    "joint": [
        can_joint(1),
        can_joint(2, direction=-1, velocity_units_per_rev_s=60_000.0, offset_rad=0.3),
        can_joint(3, kind="prismatic", gear_ratio=200.0, max_velocity=0.3, position_min=-0.5, position_max=0.5),
    ],
}
ODRIVE: dict[str, Any] = PATIENT | {
    "protocol": "odrive",
    "joint": [can_joint(k, counts_per_rev=1, gear_ratio=8.0, direction=sign) for k, sign in ((1, 1), (2, -1))],
}


@pytest.fixture(scope="class")
def emulator(request: pytest.FixtureRequest) -> Iterator[None]:
    """One emulated bus for all tests of a suite: every driver finds the drives as the one before left them."""
    suite = request.cls
    name = uuid4().hex[:8]
    endpoint = open_endpoint(suite.bus.format(name=name), 1_000_000)
    channel = name if suite.interface == "virtual" else endpoint.channel
    suite.given = {"interface": suite.interface, "channel": channel} | suite.options
    options = decode_options(CanOptions, suite.given, "canopen")
    drives = make_bus_emulator(options, DrivesSettings(plant="ideal", brake_ms=10.0), t_ns=time.monotonic_ns())
    with BusServer(drives, endpoint) as suite.server:
        yield


@pytest.mark.usefixtures("emulator")
class CanContract(JointDriverContract):
    """``bus``: what the drives are served on; ``given``: the driver's options, set by the emulated bus."""

    real_time = True
    brake_s = 0.3
    fault_s = 3.0
    server: ClassVar[BusServer]
    options: ClassVar[dict[str, Any]] = CIA_402
    interface: ClassVar[str] = "stereoservo_slcan"
    bus: ClassVar[str]
    given: ClassVar[dict[str, Any]]

    def make_driver(self, context: DriverContext) -> JointDriver:
        return CanJointDriver(self.given, context)

    def configure(self, driver: JointDriver) -> None:
        """Configured, without the faults that a stall of the machine in an earlier test has left latched."""
        driver.configure()
        driver.configure()

    def unplug(self, driver: JointDriver) -> bool:
        self.server.order("cable out")
        return True

    def plug_in(self, driver: JointDriver) -> None:
        self.server.order("cable in")


class TestCia402OnVirtual(CanContract):
    interface = "virtual"
    bus = "virtual:{name}"


@pytest.mark.slow
class TestCia402OnSlcanTcp(CanContract):
    """Protocol and transport each in another of these suites."""

    bus = "socket://127.0.0.1:0"


class TestCia402OnPty(CanContract):
    bus = "pty"


class TestOdriveOnSlcanTcp(CanContract):
    options = ODRIVE
    bus = "socket://127.0.0.1:0"
