"""Units sanity: a drive that takes the cell file's numbers for other units is found out, and the setting named."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from stereoservo.ports.devices import ExaminationFinding
from stereoservo_drivers.canopen.examination import (
    JOG,
    JogTrace,
    jog_finding,
    jog_velocity,
    noise_finding,
    position_finding,
    resolution_finding,
)
from stereoservo_drivers.canopen.options import CanJoint

JOINT = CanJoint(
    name="elbow", node_id=3, counts_per_rev=65536, gear_ratio=120.0, max_velocity=1.0, max_acceleration=4.0,
    quick_stop_deceleration=10.0, position_min=-2.0, position_max=2.0,
)  # fmt: skip
H = 0.004


def jogged(
    joint: CanJoint,
    speed: float,
    *,
    encoder: float = 1.0,
    reported: float = 1.0,
    lag_s: float = 0.01,
    stall: tuple[float, float, float] = (math.inf, 0.0, 0.0),
) -> tuple[ExaminationFinding, float]:
    """Jog a drive that runs at ``speed`` times the velocity meant, behind a lag of first order; the finding, and the
    farthest that the joint got [rad]. ``stall``: at this time of the jog the computer stands still for so long [s], and
    the drive goes on for so much of it.
    """
    trace = JogTrace(joint, start=0.3, cycle_s=H)
    q, v, t, farthest = 0.3, 0.0, 0.0, 0.0
    over = False
    for _ in range(2000):
        stalled = stall[0] <= t < stall[0] + H
        asked = None if over else jog_velocity(joint, t, 1.0)
        over = over or asked is None
        asked = asked or 0.0
        v += (speed * asked - v) * H / (lag_s + H)
        q += v * (H + stalled * stall[2])
        t += H + stalled * stall[1]
        v *= not stalled or stall[2] == stall[1]
        farthest = max(farthest, abs(q - 0.3))
        trace.add(asked, 0.3 + encoder * (q - 0.3), reported * encoder * v, H + stalled * stall[1])
        if trace.runs_away():
            over = True
        if over and abs(v) < 1e-9:
            break
    return jog_finding(trace), farthest


def test_a_jog_turns_a_joint_by_one_degree_and_slowly() -> None:
    travel = sum((jog_velocity(JOINT, k * 1e-4, -1.0) or 0.0) * 1e-4 for k in range(20_000))
    assert math.degrees(travel) == pytest.approx(-1.0, abs=0.01)
    assert max(abs(jog_velocity(JOINT, k * 1e-3, 1.0) or 0.0) for k in range(2000)) <= 0.04 * (1 + 1e-9)
    slow = msgspec.structs.replace(JOINT, max_velocity=0.01)
    assert max(abs(jog_velocity(slow, k * 1e-3, 1.0) or 0.0) for k in range(20_000)) <= 0.002 * (1 + 1e-9)
    prismatic = msgspec.structs.replace(JOINT, kind="prismatic")
    travel = sum((jog_velocity(prismatic, k * 1e-4, 1.0) or 0.0) * 1e-4 for k in range(20_000))
    assert travel == pytest.approx(JOG["prismatic"], rel=0.02)


def test_right_units_pass() -> None:
    finding, farthest = jogged(JOINT, 1.0)
    assert finding.ok is True
    assert "asked for +1.0" in finding.message
    assert math.degrees(farthest) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("configured", "true", "said"),
    [
        (None, 60.0, "= 60 (rpm)?"),  # a thousand times too fast
        (60.0, 65536.0, "= 65536 (counts/s)?"),
        (60.0, 60_000.0, "= 60000 (rpm/1000)?"),
        (60_000.0, 60.0, "= 60 (rpm)?"),
        (60.0, 1.0, "= 1 (rev/s)?"),
        (None, 32768.0, "about 327"),  # encoder lines before quadrature, say
    ],
)
def test_other_units_are_named_and_stopped_early(configured: float | None, true: float, said: str) -> None:
    joint = msgspec.structs.replace(JOINT, velocity_units_per_rev_s=configured)
    finding, farthest = jogged(joint, (configured or joint.counts_per_rev) / true)
    assert finding.ok is False
    assert said in finding.remedy, finding
    assert math.degrees(farthest) < 3.0


@pytest.mark.parametrize("at_s", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("stall_s", [0.05, 0.2, 0.5])
def test_a_computer_that_stands_still_is_not_told_as_wrong_units(at_s: float, stall_s: float) -> None:
    for goes_on_s in (min(0.05, stall_s), stall_s):  # until the drive's own deadline; for ever
        finding, _ = jogged(JOINT, 1.0, stall=(at_s, stall_s, goes_on_s))
        assert finding.ok is not False, finding
        assert (finding.ok is True) or "instead of 4" in finding.message
    for speed in (1.0 / 60.0, -1.0):
        finding, _ = jogged(JOINT, speed, stall=(0.6, 0.1, 0.05))
        assert finding.ok is False


def test_an_encoder_against_the_motor_and_a_joint_that_stands() -> None:
    finding, _ = jogged(JOINT, 1.0, encoder=-1.0)
    assert finding.ok is False
    assert "wrong way" in finding.message
    finding, _ = jogged(JOINT, 0.0)
    assert finding.ok is False
    assert "stands" in finding.message
    assert "brake" in finding.remedy


def test_a_reported_velocity_in_other_units_and_a_slow_loop() -> None:
    finding, _ = jogged(JOINT, 1.0, reported=60.0 / 65536.0)
    assert finding.ok is False
    assert "0x606C" in finding.message
    finding, _ = jogged(JOINT, 1.0, lag_s=0.3)
    assert finding.ok is None
    assert "velocity loop" in finding.remedy


def test_positions_outside_the_limits_name_the_offset_that_would_call_them_zero() -> None:
    assert position_finding(JOINT, 1.9).ok is True
    joint = msgspec.structs.replace(JOINT, offset_rad=0.5)
    finding = position_finding(joint, 2.25)
    assert finding.ok is False
    assert "0.25 rad outside" in finding.message
    assert "offset_rad = 2.75" in finding.remedy
    assert "counts_per_rev" in position_finding(JOINT, 40.0).remedy


def test_encoders_at_rest() -> None:
    rng = np.random.default_rng(5)
    count = 2 * math.pi / (65536 * 120)
    assert noise_finding(JOINT, 0.1 + rng.integers(-2, 3, 250) * count).ok is True
    noisy = noise_finding(JOINT, 0.1 + rng.uniform(-1e-3, 1e-3, 250))
    assert noisy.ok is False
    assert "encoder cable" in noisy.remedy
    sinking = noise_finding(JOINT, 0.1 - np.linspace(0.0, 0.01, 250))
    assert sinking.ok is False
    assert "brake" in sinking.remedy


def test_a_coarse_velocity_unit_is_told() -> None:
    assert resolution_finding(JOINT).ok is True
    coarse = resolution_finding(msgspec.structs.replace(JOINT, velocity_units_per_rev_s=60.0))
    assert coarse.ok is None
    assert "0x60A9" in coarse.remedy
