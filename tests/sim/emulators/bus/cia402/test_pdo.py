"""PDO parameters and PDOs of the emulated drive."""

import struct

import pytest

CONTROL, TARGET, MODE = 0x60400010, 0x60FF0020, 0x60600008
STATUS, POSITION, VELOCITY, TORQUE = 0x60410010, 0x60640020, 0x606C0020, 0x60770010
OFF = 1 << 31
STATE, NOT_MAPPABLE, TOO_LONG, INVALID = 0x08000022, 0x06040041, 0x06040042, 0x06090030


def remap(bench, number, *objects, transmit=False, kind=255, event=0, inhibit=0):
    com, base = (0x1800, 0x1A00) if transmit else (0x1400, 0x1600)
    com, mapping = com + number - 1, base + number - 1
    cob_id = (0x180 if transmit else 0x200) + 0x100 * (number - 1) + bench.id
    codes = [bench.write(com, 1, cob_id | OFF, 4), bench.write(mapping, 0, 0, 1)]
    codes += [bench.write(mapping, k, word, 4) for k, word in enumerate(objects, 1)]
    codes += [
        bench.write(mapping, 0, len(objects), 1),
        bench.write(com, 2, kind, 1),
        bench.write(com, 5, event, 2),
    ]
    if transmit:
        codes.append(bench.write(com, 3, inhibit, 2))
    codes.append(bench.write(com, 1, cob_id, 4))
    assert not any(codes), [hex(code) for code in codes]


@pytest.fixture
def quiet(bench):
    bench.quiet_pdos()
    return bench


def test_order_of_changes_is_kept(bench):
    assert bench.write(0x1600, 0, 0, 1) == STATE  # exists
    assert bench.write(0x1600, 1, TARGET, 4) == STATE
    assert bench.write(0x1400, 1, 0x203 | OFF, 4) == 0
    assert bench.write(0x1600, 2, TARGET, 4) == STATE  # count is not 0
    assert bench.write(0x1600, 0, 0, 1) == 0
    assert bench.write(0x1600, 2, TARGET, 4) == 0
    assert bench.write(0x1600, 0, 2, 1) == 0
    assert bench.write(0x1400, 1, 0x203, 4) == 0
    assert bench.read(0x1600, 0) == 2


@pytest.mark.parametrize(
    ("mapping", "word", "code"),
    [
        (0x1600, STATUS, NOT_MAPPABLE),  # read only
        (0x1600, 0x60850020, NOT_MAPPABLE),  # not mappable
        (0x1600, 0x60400020, NOT_MAPPABLE),  # wrong length
        (0x1600, 0x60400008, NOT_MAPPABLE),
        (0x1600, 0x29990010, 0x06020000),
        (0x1600, 0x60400110, 0x06090011),
        (0x1A00, 0x00050008, NOT_MAPPABLE),  # gaps are for RPDOs
        (0x1A00, 0x10170010, NOT_MAPPABLE),
        (0x1600, 0x00050008, 0),
        (0x1600, TARGET, 0),
        (0x1A00, POSITION, 0),
    ],
)
def test_what_can_be_mapped(bench, mapping, word, code):
    com = mapping - 0x200
    assert bench.write(com, 1, bench.read(com, 1) | OFF, 4) == 0
    assert bench.write(mapping, 0, 0, 1) == 0
    assert bench.write(mapping, 1, word, 4) == code


def test_nine_bytes_do_not_fit(bench):
    assert bench.write(0x1A00 - 0x200, 1, bench.read(0x1800, 1) | OFF, 4) == 0
    assert bench.write(0x1A00, 0, 0, 1) == 0
    for k, word in enumerate((STATUS, POSITION, TORQUE, 0x60610008), 1):
        assert bench.write(0x1A00, k, word, 4) == 0
    assert bench.write(0x1A00, 0, 4, 1) == TOO_LONG
    assert bench.write(0x1A00, 0, 3, 1) == 0
    assert bench.write(0x1A00, 0, 0, 1) == 0
    assert bench.write(0x1A00, 0, 5, 1) == NOT_MAPPABLE  # the fifth is empty
    assert bench.write(0x1A00, 0, 9, 1) == 0x06090031


@pytest.mark.parametrize(
    ("sub", "value", "size", "code"),
    [
        (1, 0x204, 4, STATE),  # another id while it exists
        (1, OFF | 0x204, 4, 0),
        (1, OFF, 4, 0),
        (1, 0x20000203, 4, INVALID),  # 29 bits
        (1, 0x000, 4, INVALID),
        (1, 0x603, 4, INVALID),
        (2, 1, 1, 0),
        (2, 240, 1, 0),
        (2, 241, 1, INVALID),
        (2, 253, 1, INVALID),
        (2, 254, 1, 0),
        (5, 20, 2, 0),
    ],
)
def test_communication_parameters(bench, sub, value, size, code):
    assert bench.write(0x1400, sub, value, size) == code


def test_inhibit_time_and_start_value_only_while_the_tpdo_is_off(bench):
    assert bench.write(0x1800, 3, 50, 2) == STATE
    assert bench.write(0x1800, 6, 2, 1) == STATE
    assert bench.write(0x1800, 1, bench.read(0x1800, 1) | OFF, 4) == 0
    assert bench.write(0x1800, 3, 50, 2) == 0
    assert bench.write(0x1800, 6, 2, 1) == 0


def test_an_rpdo_of_type_255_acts_at_once_of_type_1_at_the_next_sync(quiet):
    remap(quiet, 1, CONTROL, TARGET, kind=255)
    quiet.nmt(1)
    quiet.send(0x203, *struct.pack("<Hi", 6, 1234))
    assert quiet.power_state == "ready to switch on"
    assert quiet.read(0x60FF, signed=True) == 1234
    remap(quiet, 1, CONTROL, TARGET, kind=1)
    quiet.send(0x203, *struct.pack("<Hi", 7, -5))
    assert quiet.power_state == "ready to switch on"
    quiet.sync()
    assert quiet.power_state == "switched on"
    assert quiet.read(0x60FF, signed=True) == -5


def test_pdos_only_in_operational(quiet):
    remap(quiet, 1, STATUS, transmit=True, kind=1)
    quiet.word(6)
    assert quiet.power_state == "switch on disabled"
    assert quiet.sync() == []
    quiet.nmt(1)
    assert [f.id for f in quiet.sync()] == [0x183]
    quiet.nmt(2)
    assert quiet.sync() == []


@pytest.mark.parametrize("kind", [1, 2, 5, 240])
def test_synchronous_tpdo_every_so_many_syncs(quiet, kind):
    remap(quiet, 1, STATUS, POSITION, transmit=True, kind=kind)
    quiet.nmt(1)
    sent = [len(quiet.sync()) for _ in range(2 * kind)]
    assert sent == ([0] * (kind - 1) + [1]) * 2


def test_synchronous_tpdo_holds_the_values_of_its_sync(quiet):
    remap(quiet, 1, STATUS, POSITION, transmit=True, kind=1)
    quiet.nmt(1)
    for position in (0.3, -1.1, 2.5):
        quiet.axis.position = position
        (frame,) = quiet.sync()
        status, counts = struct.unpack("<Hi", frame.data)
        assert status & 0x4F == 0x40
        assert abs(counts / (4096 * 100) * 6.283185307179586 - position) < 1e-5


def test_sync_start_value(quiet):
    remap(quiet, 1, STATUS, transmit=True, kind=3)
    assert quiet.write(0x1800, 1, 0x183 | OFF, 4) == 0
    assert quiet.write(0x1800, 6, 4, 1) == 0
    assert quiet.write(0x1800, 1, 0x183, 4) == 0
    quiet.nmt(1)
    counters = [k % 10 + 1 for k in range(20)]
    assert [c for c in counters if quiet.send(0x80, c)] == [4, 7, 10, 3, 6, 9]


def test_acyclic_synchronous_tpdo_only_when_changed(quiet):
    remap(quiet, 1, POSITION, transmit=True, kind=0)
    quiet.nmt(1)
    assert len(quiet.sync()) == 1
    assert len(quiet.sync()) == 0
    quiet.axis.position += 0.1
    assert len(quiet.sync()) == 1
    assert len(quiet.sync()) == 0


def test_event_driven_tpdo(quiet):
    remap(quiet, 1, STATUS, transmit=True, kind=255)
    assert [f.id for f in quiet.nmt(1)] == [0x183]
    assert quiet.run(50) == []
    (frame,) = quiet.word(6)
    assert struct.unpack("<H", frame.data)[0] & 0x6F == 0x21
    assert quiet.sync() == []


def test_event_timer(quiet):
    remap(quiet, 1, STATUS, transmit=True, kind=254, event=10)
    quiet.nmt(1)
    assert len([f for f in quiet.run(101) if f.id == 0x183]) == 10


def test_inhibit_time_holds_changes_back_and_the_newest_wins(quiet):
    remap(quiet, 1, STATUS, transmit=True, kind=255, inhibit=100)  # 10 ms
    quiet.nmt(1)
    assert quiet.word(6) == []
    assert quiet.word(7) == []
    (frame,) = quiet.run(11)
    assert struct.unpack("<H", frame.data)[0] & 0x6F == 0x23


def test_remote_request_where_it_is_allowed(quiet):
    remap(quiet, 1, STATUS, transmit=True, kind=1)
    quiet.nmt(1)
    assert [f.id for f in quiet.send(0x183, remote=True)] == [0x183]
    assert quiet.write(0x1800, 1, 0x183 | OFF, 4) == 0
    assert quiet.write(0x1800, 1, 0x183 | 1 << 30, 4) == 0
    assert quiet.send(0x183, remote=True) == []


def test_short_rpdo_is_dropped_and_told_once(quiet):
    remap(quiet, 1, CONTROL, TARGET)
    quiet.nmt(1)
    for _ in range(3):
        quiet.send(0x203, 6, 0, 1, 0, 0)
    assert quiet.power_state == "switch on disabled"
    assert quiet.emergencies() == [(0x8210, 0x11)]
    quiet.send(0x203, *struct.pack("<Hi", 6, 0))
    assert quiet.power_state == "ready to switch on"
    assert quiet.emergencies() == [(0x8210, 0x11), (0, 0)]


def test_long_rpdo_is_taken_and_told(quiet):
    quiet.nmt(1)
    quiet.send(0x203, 6, 0, 99)
    assert quiet.power_state == "ready to switch on"
    assert quiet.emergencies() == [(0x8220, 0x11)]


def test_gaps_in_an_rpdo(quiet):
    remap(quiet, 1, 0x00050008, CONTROL, 0x00050008, TARGET)
    quiet.nmt(1)
    quiet.send(0x203, *struct.pack("<BHBi", 0xEE, 6, 0xEE, 77))
    assert quiet.power_state == "ready to switch on"
    assert quiet.read(0x60FF) == 77


def test_a_value_that_is_refused_leaves_the_rest(quiet):
    remap(quiet, 1, MODE, CONTROL)
    quiet.nmt(1)
    quiet.send(0x203, 4, 6, 0)
    assert quiet.read(0x6061) == 0
    assert quiet.power_state == "ready to switch on"


def test_deadline_of_an_rpdo(make_bench):
    bench = make_bench()
    bench.enable()
    assert bench.write(0x1400, 5, 20, 2) == 0
    bench.run(100)
    assert bench.power_state == "operation enabled"  # begins with the first one
    for _ in range(5):
        bench.word(0x0F)
        bench.run(19)
    assert bench.power_state == "operation enabled"
    assert bench.emergencies() == []
    bench.run(1.5)
    assert bench.emergencies() == [(0x8250, 0x11)]
    bench.run(60)
    assert bench.power_state == "fault"
    bench.run(100)
    assert bench.emergencies() == [(0x8250, 0x11)]
    bench.word(0x00)
    bench.word(0x80)
    assert bench.power_state == "switch on disabled"
    assert bench.emergencies() == [(0x8250, 0x11), (0, 0)]


def test_unused_rpdos_of_the_eds_hear_control_words(bench):
    bench.nmt(1)
    bench.send(0x403, *struct.pack("<Hi", 6, 0))
    assert bench.power_state == "ready to switch on"


def test_drives_without_default_pdos(make_bench):
    bench = make_bench(pdos_by_default=False)
    assert bench.nmt(1) == []
    bench.word(6)
    bench.send(0x403, *struct.pack("<Hi", 6, 0))
    assert bench.sync() == []
    assert bench.power_state == "switch on disabled"
