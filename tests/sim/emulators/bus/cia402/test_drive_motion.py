"""Motion of the emulated drive: units, ramps, brake, stops, limits, what it measures."""

import math

import pytest

K = 4096 * 100 / (2 * math.pi)
"""Counts, and velocity units, a radian."""


def test_units_direction_offset_and_gear(make_bench):
    bench = make_bench(joint={"direction": -1, "offset_rad": 0.25, "velocity_units_per_rev_s": 60.0}, position=0.5)
    assert bench.read(0x6064, signed=True) == round(-K * 0.75)
    bench.enable(x6083=1000, x6084=1000)
    bench.velocity(-30)  # rpm of the motor, against the joint's direction
    bench.run(200)
    assert bench.axis.target == pytest.approx(30 / 60 / 100 * 2 * math.pi)
    assert bench.axis.acceleration == pytest.approx(1000 / 60 / 100 * 2 * math.pi)
    assert bench.read(0x606C, signed=True) == -30
    bench.axis.effort = 0.25
    assert bench.read(0x6077, signed=True) == -250


def test_prismatic_joints_have_turns_a_metre(make_bench):
    bench = make_bench(joint={"kind": "prismatic", "gear_ratio": 200.0}, position=0.125)
    assert bench.read(0x6064) == 4096 * 200 // 8


def test_position_wraps_at_32_bits(make_bench):
    bench = make_bench(joint={"counts_per_rev": 2.0**19, "gear_ratio": 160.0}, position=0.0)
    k = 2**19 * 160 / (2 * math.pi)
    turns = 2**31 / (2**19 * 160)
    for q in (turns * 2 * math.pi - 0.001, turns * 2 * math.pi + 0.001, -turns * 2 * math.pi - 0.5):
        bench.axis.position = q
        value = bench.read(0x6064, signed=True)
        assert (value - round(k * q)) % 2**32 == 0
    assert value > 0


def test_an_encoder_that_counts_backwards(bench):
    bench.enable()
    before = bench.read(0x6064, signed=True)
    bench.axis.inverted_encoder = True
    assert bench.read(0x6064, signed=True) == before
    bench.velocity(10_000)
    bench.run(100)
    assert bench.axis.position > 0.1
    assert bench.read(0x6064, signed=True) == pytest.approx(before - K * (bench.axis.position - 0.1), abs=2)
    assert bench.read(0x606C, signed=True) == -10_000
    assert bench.read(0x60F4, signed=True) == pytest.approx(2 * K * (bench.axis.position - 0.1), abs=2)


@pytest.mark.parametrize("mode", [3, 9])
def test_velocity_is_ramped_by_the_profile_acceleration(bench, mode):
    bench.enable(mode, x6083=100_000, x6084=200_000)
    bench.velocity(20_000)
    start = bench.t
    bench.run(150)
    assert bench.axis.set_velocity == pytest.approx(0.15 * 100_000 / K, rel=0.02)
    bench.run(100)
    assert bench.axis.set_velocity == pytest.approx(20_000 / K)
    bench.velocity(0)
    deceleration = 200_000 if mode == 3 else 100_000  # cyclic: 0x6083 both ways
    assert bench.run_to_rest() == pytest.approx(20_000 / deceleration * 1000, abs=2)
    assert bench.t > start


def test_mode_none_does_not_move(bench):
    bench.enable(0)
    bench.velocity(20_000)
    bench.run(100)
    assert bench.axis.set_velocity == 0.0


@pytest.mark.parametrize(("index", "other"), [(0x607F, 0x6080), (0x6080, 0x607F)])
@pytest.mark.parametrize("mode", [3, 9])
def test_velocity_limits_clamp_and_say_so(bench, index, other, mode):
    bench.enable(mode, **{f"x{index:X}": 5000, f"x{other:X}": 90_000})
    bench.velocity(-20_000)
    bench.run(300)
    assert bench.axis.set_velocity == pytest.approx(-5000 / K)
    assert bench.read(0x6041) & 0x800
    bench.velocity(4000)
    bench.run(300)
    assert bench.axis.set_velocity == pytest.approx(4000 / K)
    assert not bench.read(0x6041) & 0x800


# -- brake -----------------------------------------------------------------------------------------------------------


def test_brake_opens_before_enabled_and_closes_before_power_goes(make_bench):
    bench = make_bench(brake_ms=80)
    bench.quiet_pdos()
    bench.write(0x6060, 0, 9, 1)
    bench.write(0x605B, 0, 1, 2)
    bench.velocity(20_000)
    bench.nmt(1)
    for word in (6, 7, 0x0F):
        bench.word(word)
    assert bench.axis.powered
    bench.run(79)
    assert bench.axis.brake_closed
    assert bench.power_state == "switched on"
    assert bench.axis.target == 0.0
    bench.run(2)
    assert not bench.axis.brake_closed
    assert bench.power_state == "operation enabled"
    bench.run(100)
    assert bench.axis.set_velocity > 0
    bench.word(0x06)
    bench.run_to_rest()
    bench.run(1)
    stood = bench.t
    assert bench.axis.powered
    assert not bench.axis.brake_closed
    while bench.axis.powered:
        assert bench.power_state == "operation enabled"
        bench.run(0.5)
    assert bench.axis.brake_closed
    assert (bench.t - stood) / 1e6 == pytest.approx(80, abs=2)
    assert bench.power_state == "ready to switch on"


def test_disable_voltage_takes_power_at_once_and_the_brake_follows(make_bench):
    bench = make_bench(brake_ms=80)
    bench.enable()
    bench.velocity(20_000)
    bench.run(200)
    bench.word(0x00)
    assert not bench.axis.powered
    assert not bench.axis.brake_closed
    bench.run(79)
    assert not bench.axis.brake_closed
    bench.run(2)
    assert bench.axis.brake_closed


def test_without_a_brake_time_enabling_is_immediate(make_bench):
    bench = make_bench(brake_ms=0)
    bench.nmt(1)
    for word in (6, 7, 0x0F):
        bench.word(word)
    assert bench.power_state == "operation enabled"
    assert not bench.axis.brake_closed


# -- stops -----------------------------------------------------------------------------------------------------------

SLOW, QUICK, SPEED = 100_000, 400_000, 40_000
RAMP_MS = {1: SPEED / SLOW * 1e3, 2: SPEED / QUICK * 1e3, 3: SPEED / QUICK * 500, 4: SPEED / QUICK * 500}


def moving(bench, mode=9, **objects):
    bench.enable(mode, x6083=2_000_000, x6084=SLOW, x6085=QUICK, **objects)
    bench.velocity(SPEED)
    bench.run(100)
    assert bench.axis.set_velocity == pytest.approx(SPEED / K)


@pytest.mark.parametrize("option", range(1, 9))
def test_quick_stop_options(bench, option):
    moving(bench, x605A=option)
    bench.word(0x02)
    assert bench.run_to_rest() == pytest.approx(RAMP_MS[option if option < 5 else option - 4], abs=1.5)
    bench.run(200)
    if option < 5:
        assert bench.power_state == "switch on disabled"
        assert not bench.axis.powered
        assert bench.axis.brake_closed
    else:
        assert bench.power_state == "quick stop active"
        assert bench.axis.powered
        assert not bench.axis.brake_closed
        bench.word(0x0F)
        bench.run(100)
        assert bench.axis.set_velocity == pytest.approx(SPEED / K)


def test_quick_stop_option_0_coasts(bench):
    moving(bench, x605A=0)
    bench.word(0x02)
    assert bench.power_state == "switch on disabled"
    assert not bench.axis.powered


@pytest.mark.parametrize("option", [1, 2, 3, 4])
def test_halt_stops_and_keeps_enabled(bench, option):
    moving(bench, x605D=option)
    bench.word(0x10F)
    assert bench.run_to_rest() == pytest.approx(RAMP_MS[option], abs=1.5)
    bench.run(300)
    assert bench.power_state == "operation enabled"
    assert not bench.axis.brake_closed
    bench.word(0x0F)
    bench.run(100)
    assert bench.axis.set_velocity == pytest.approx(SPEED / K)


@pytest.mark.parametrize("option", [1, 2, 3, 4])
def test_fault_reaction_options(bench, option):
    moving(bench, x605E=option)
    bench.trip(0x3210)
    assert bench.run_to_rest() == pytest.approx(RAMP_MS[option], abs=1.5)
    assert bench.power_state == "fault reaction active"
    bench.run(60)
    assert bench.power_state == "fault"
    assert not bench.axis.powered


def test_fault_reaction_0_coasts(bench):
    moving(bench, x605E=0)
    bench.trip(0x3210)
    assert bench.power_state == "fault"
    assert not bench.axis.powered


@pytest.mark.parametrize(("index", "word", "state"), [(0x605B, 6, "ready to switch on"), (0x605C, 7, "switched on")])
def test_shutdown_and_disable_operation(bench, index, word, state):
    moving(bench, **{f"x{index:X}": 1})
    bench.word(word)
    assert bench.run_to_rest() == pytest.approx(RAMP_MS[1], abs=1.5)
    bench.run(60)
    assert bench.power_state == state
    assert not bench.axis.powered


# -- limits ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("side", [1, -1])
def test_limit_switch_stops_towards_its_side_only(make_bench, direction, side):
    bench = make_bench(joint={"direction": direction})
    bench.enable(x6083=2_000_000, x6084=SLOW, x6085=QUICK)
    bench.velocity(direction * side * SPEED)
    bench.run(300)
    bench.axis.limit_switch = side
    bench.run(1)
    assert bench.read(0x6041) & 0x800
    assert bench.read(0x60FD) == (1 if side * direction < 0 else 2)
    bench.run(150)
    assert bench.axis.set_velocity == 0.0
    assert bench.power_state == "operation enabled"
    bench.velocity(-direction * side * SPEED)
    bench.run(200)
    assert bench.axis.set_velocity == pytest.approx(-side * SPEED / K)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("side", [1, -1])
def test_software_limits_stop_in_time(make_bench, direction, side):
    bench = make_bench(joint={"direction": direction}, position=0.0)
    bench.enable(x6083=200_000, x6085=200_000, x607D_1=-30_000, x607D_2=30_000)
    bench.velocity(direction * side * 50_000)
    bench.run(3000)
    assert bench.axis.set_velocity == pytest.approx(0.0, abs=0.01)
    assert bench.axis.position == pytest.approx(side * 30_000 / K, abs=60 / K)
    assert bench.read(0x6041) & 0x800
    bench.velocity(-direction * side * 10_000)
    bench.run(500)
    assert bench.axis.set_velocity == pytest.approx(-side * 10_000 / K)


def test_following_error_trips_after_its_time(bench):
    bench.enable(x6065=2000, x6066=20)
    bench.axis.blocked = True
    bench.velocity(20_000)
    bench.run(100)
    assert bench.read(0x60F4, signed=True) < 2000
    error = 0
    while error <= 2000:
        bench.run(1)
        error = bench.read(0x60F4, signed=True)
    bench.run(18)
    assert bench.emergencies() == []
    bench.run(4)
    assert bench.emergencies() == [(0x8611, 0x21)]
    bench.run(500)
    assert bench.power_state == "fault"
    assert len(bench.emergencies()) == 1


# -- status bits of the modes ----------------------------------------------------------------------------------------


def test_bit_12_cyclic_follows_the_command(bench):
    moving(bench)
    assert bench.read(0x6041) & 0x1000
    bench.word(0x10F)
    assert not bench.read(0x6041) & 0x1000
    bench.word(0x0F)
    assert bench.read(0x6041) & 0x1000
    bench.word(0x02)
    assert not bench.read(0x6041) & 0x1000


def test_bits_10_and_12_in_profile_velocity(bench):
    bench.enable(3, x607F=100_000, x6080=100_000, x6083=100_000)
    assert bench.read(0x6041) & 0x1400 == 0x1400  # speed is zero, as is the target
    bench.velocity(20_000)
    bench.run(50)
    assert bench.read(0x6041) & 0x1400 == 0
    bench.run(200)
    assert bench.read(0x6041) & 0x1400 == 0x0400
    bench.word(0x10F)
    bench.run(10)
    assert bench.read(0x6041) & 0x1400 == 0
    bench.run(500)
    assert bench.read(0x6041) & 0x1400 == 0x1400


def test_warning_bit_while_an_error_is_there_that_is_no_fault(bench):
    bench.nmt(1)
    bench.send(0x203, 6)
    assert bench.read(0x6041) & 0x80
    bench.word(6)
    assert not bench.read(0x6041) & 0x80
