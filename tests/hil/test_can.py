"""An arm on a CAN bus: daemon, drives behind slcan and cameras as MJPEG streams in other processes; calibrated and
servoed through the images alone, and every fault ends with the arm at rest, until a person has reset and enabled it.

``pytest tests/hil/test_can.py --hil CELL.toml`` runs it on real drives: see docs/can.md.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from stereoservo.client import Client, RefusedError

from .can_bench import CanBench, codes, lifecycle, moving, reset_is_refused
from .conftest import at_rest, eventually, processes, recover

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def hardware(request: pytest.FixtureRequest) -> Path | None:
    """The cell file of ``--hil``."""
    given = request.config.getoption("--hil")
    return None if given is None else Path(given).absolute()


@pytest.fixture(scope="module")
def bench(hardware: Path | None, roots: Path) -> Iterator[CanBench]:
    """Drives and a daemon for the whole module."""
    if hardware is None:
        bench = CanBench.emulated(roots / "can")
    else:
        (roots / "can").mkdir()
        bench = CanBench(hardware, roots / "can", None)
    try:
        bench.start_daemon()
        yield bench
    finally:
        bench.end()
    eventually("no process is left", lambda: not processes(bench.directories))


@pytest.fixture(scope="module")
def calibrated(bench: CanBench) -> CanBench:
    """The cell has calibrated itself and knows the goal ``park``."""
    with Client(bench.name) as client:
        recover(client)
        result = client.calibrate(timeout_s=300.0)
        assert result.covariance_ok
        client.teach("park", frames=5)
    return bench


@pytest.fixture
def client(calibrated: CanBench) -> Iterator[Client]:
    """A client, with the arm enabled."""
    with Client(calibrated.name) as client:
        recover(client)
        yield client


def away_and_back(bench: CanBench, client: Client, law: str) -> None:
    """Off by joints, back to the taught goal by what the cameras see."""
    joints = client.status().joints
    client.goal({name: joints[name] + 0.08 for name in list(joints)[:4]}).reached(60.0)
    result = client.goal("park", law=law, tolerance_px=0.5, hold_frames=3).reached(60.0)  # type: ignore[arg-type]
    assert result.error_px is not None
    assert result.error_px <= 0.5


# -- the main line ----------------------------------------------------------------------------------------------


def test_a_calibrated_arm_is_servoed_to_a_taught_goal_by_either_law(bench: CanBench, client: Client) -> None:
    for law in ("stereo", "cartesian3"):
        away_and_back(bench, client, law)
    status = client.status()
    if bench.emulator is not None:
        assert set(status.efforts) == set(status.joints)


def test_disable_takes_the_power_off_and_the_arm_stays(bench: CanBench, client: Client) -> None:
    moving(bench, client)
    client.disable()
    eventually("inactive", lifecycle(client, "inactive"))
    eventually("the arm rests", bench.stands)
    client.enable()
    assert at_rest(client)
    assert bench.stands()


def test_stop_brakes_and_the_drives_stay_enabled(bench: CanBench, client: Client) -> None:
    moving(bench, client)
    client.stop()
    eventually("the arm rests", bench.stands)
    assert client.status().lifecycle == "active"
    client.resume()


def test_a_gripper_on_a_drive_of_its_own_closes_while_the_arm_is_servoed(bench: CanBench, client: Client) -> None:
    bench.needs_emulated_drives("the gripper is one of them")
    client.auxiliary({"claw": 0.02})
    away_and_back(bench, client, "stereo")
    eventually("closed", lambda: abs(client.status().auxiliary["claw"] - 0.02) < 1e-3)
    with pytest.raises(RefusedError, match=r"claw: 0\.5"):
        client.auxiliary({"claw": 0.5})
    client.auxiliary({"claw": 0.08})
    eventually("open", lambda: abs(client.status().auxiliary["claw"] - 0.08) < 1e-3)


# -- faults that are ordered of the emulated drives -------------------------------------------------------------


def falls_into_fault(bench: CanBench, client: Client, order: str, told: str) -> None:
    """In motion, ``order``: FAULT that says ``told``, arm at rest, and nobody enables it again."""
    bench.needs_emulated_drives("it orders faults of them")
    moving(bench, client)
    bench.order(order)
    eventually(f"fault after {order!r}", lifecycle(client, "fault"))
    eventually("the arm rests", bench.stands)
    assert told in codes(client), codes(client)
    with pytest.raises(RefusedError, match="in fault"):
        client.enable()
    time.sleep(0.5)
    assert client.status().lifecycle == "fault"
    assert bench.stands()


@pytest.mark.parametrize(
    ("order", "told"),
    [
        ("fault node 3 0x3210", "0x3210 DC link over-voltage"),
        ("emcy 2 0x4310", "0x4310 drive over-temperature"),
        ("reboot 5", "node 5: booted while in use"),
        ("nmt preop 4", "node 4: left operational"),
        ("duplicate 6 boots", "node 6"),
        ("fault node 9 0x2310", "gripper 'claw' (node 9): 0x2310 over-current"),
    ],
)
def test_a_fault_of_a_drive_stops_all_axes_until_reset_and_enable(
    bench: CanBench, client: Client, order: str, told: str
) -> None:
    falls_into_fault(bench, client, order, told)
    if order.startswith("duplicate"):
        bench.order("duplicate 6 off")
    client.reset()
    eventually("reset", lifecycle(client, "inactive"))
    time.sleep(0.3)
    assert client.status().lifecycle == "inactive"  # a reset enables nothing
    client.enable()
    assert bench.stands()
    client.goal({"j1": 0.0}).reached(60.0)


@pytest.mark.parametrize(
    ("order", "cure", "told"),
    [
        ("sticky 2 0x2310", "sticky 2 off", "0x2310 over-current at the motor"),
        ("silence 4", "speak 4", "node 4"),
        ("cable out", "cable in", "no drive answered"),
        ("adapter out", "adapter in", "connection_lost"),
    ],
)
def test_a_reset_is_refused_while_the_cause_lasts(
    bench: CanBench, client: Client, order: str, cure: str, told: str
) -> None:
    falls_into_fault(bench, client, order, told)
    reset_is_refused(client)
    assert bench.stands()
    bench.order(cure)
    recover(client)
    away_and_back(bench, client, "cartesian3")


def test_drives_that_are_killed_and_started_anew(bench: CanBench, client: Client) -> None:
    bench.needs_emulated_drives("it kills them")
    assert bench.emulator is not None
    moving(bench, client)
    bench.emulator.process.kill()
    eventually("fault", lifecycle(client, "fault"))
    assert "connection_lost" in codes(client)
    bench.emulator.stop()
    reset_is_refused(client)
    bench.restart_drives()
    recover(client)
    client.goal({"j1": 0.0, "j4": 0.3}).reached(60.0)


# -- the end of the daemon ----------------------------------------------------------------------------------------


def test_the_drives_stop_by_themselves_when_the_servo_process_is_killed_and_a_fault_at_start_is_told(
    bench: CanBench, client: Client
) -> None:
    """SIGKILL leaves nobody who could stop the arm but the drives, by their watch on the master's heartbeat."""
    bench.needs_emulated_drives("it kills their master")
    moving(bench, client)
    killed_ns = time.monotonic_ns()
    servo = processes(bench.directories)["servo"]
    assert bench.daemon is not None
    bench.daemon.process.kill()
    os.kill(servo, signal.SIGKILL)
    eventually("the emulator says that all rests", lambda: bench.told("all_rest", killed_ns))
    assert bench.stands()
    bench.daemon.stop()
    eventually("no process of it is left", lambda: not processes(bench.directories))
    bench.order("sticky 2 0x2310")
    bench.start_daemon()
    with Client(bench.name) as again:
        eventually("fault", lifecycle(again, "fault"))
        assert "drive_fault" in codes(again), codes(again)  # by the drives' own stop, and by what was ordered
        with pytest.raises(RefusedError, match="in fault"):
            again.enable()
        reset_is_refused(again)
        assert "0x2310 over-current at the motor" in codes(again), codes(again)
        bench.order("sticky 2 off")
        recover(again)
        again.goal("park", tolerance_px=0.5, hold_frames=3).reached(60.0)
