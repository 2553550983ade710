"""Whatever is on the bus, the drive does not raise, and powers its axis only after shutdown and enable commands."""

from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo_drivers.can.frames import CanFrame

INTERESTING = [0, 0x80, 0x83, 0x183, 0x203, 0x303, 0x403, 0x503, 0x583, 0x603, 0x703, 0x77F]
INDICES = [0x1003, 0x1005, 0x1006, 0x1010, 0x1014, 0x1016, 0x1017, 0x1029, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6007,
           0x6040, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6060, 0x6065, 0x607D, 0x6083, 0x6085, 0x60FF]  # fmt: skip

anything = st.builds(
    CanFrame,
    id=st.one_of(st.sampled_from(INTERESTING), st.integers(0, 0x7FF)),
    data=st.binary(max_size=8),
    remote=st.booleans(),
    extended=st.booleans(),
)
words = st.builds(
    lambda low, high: CanFrame(id=0x203, data=bytes([low, high])),
    st.one_of(st.sampled_from([0, 2, 6, 7, 15, 0x80, 0x8F]), st.integers(0, 255)),
    st.sampled_from([0, 1]),
)
writes = st.builds(
    lambda index, sub, size, value: CanFrame(
        id=0x603,
        data=bytes([0x23 | (4 - size) << 2, index & 0xFF, index >> 8, sub]) + value.to_bytes(4, "little"),
    ),
    st.sampled_from(INDICES),
    st.sampled_from([0, 0, 1, 2, 5]),
    st.sampled_from([1, 2, 4]),
    st.one_of(st.integers(0, 20), st.integers(0, 2**32 - 1)),
)
commands = st.builds(lambda c: CanFrame(id=0, data=bytes([c, 3])), st.sampled_from([1, 1, 1, 2, 0x80, 0x81, 0x82]))
syncs = st.just(CanFrame(id=0x80))
waits = st.integers(-10, 200)
handshakes = st.sampled_from([
    (6, 7, 15), (6, 15), (0, 0x80, 6, 15), (0, 0x80, 0, 6, 7, 15), (7, 15), (15, 6), (6, 7), (0x8F, 15), (11, 15),
    (0x10F, 15), (6, 7, 0, 15), (6, 7, 2, 15), (6, 0, 15), (6, 2, 7, 15),
])  # fmt: skip
trips = st.sampled_from(["0x3210", "reboot", "limit", "invert"])
mixed = st.one_of(anything, words, handshakes, handshakes, handshakes, writes, commands, syncs, waits, waits, trips)
steps = st.lists(mixed, min_size=5, max_size=60)


class Handshake:
    """What the control words so far allow, by the standard: bits 0 to 3 and 7 of each word that the drive took."""

    def __init__(self, dictionary, machine):
        self.ready = self.enable = False
        dictionary.changed(0x6040, lambda sub, word: (self.word(word), machine.control(word)))

    def word(self, word):
        low = word & 0x8F
        if low & 0x87 == 0x06:
            self.ready = True
        elif low & 0x82 == 0 or low & 0x86 == 0x02:  # disable voltage, quick stop: all to be done again
            self.ready = False
        self.enable = self.ready and low == 0x0F


@settings(max_examples=250)
@given(steps=steps)
def test_no_sequence_raises_or_powers_without_the_handshake(steps, fuzz_bench):
    bench = fuzz_bench()
    handshake = Handshake(bench.node.dictionary, bench.node.machine)
    bench.nmt(1)
    for step in steps:
        was = bench.axis.powered
        if isinstance(step, int):
            if step < 0:  # a clock that runs backwards
                bench.node.advance(bench.t + step * 1_000_000)
            bench.run(max(step, 0))
        elif isinstance(step, CanFrame):
            bench.node.receive(step, bench.t)
        elif isinstance(step, tuple):
            for word in step:
                bench.word(word)
        elif step == "reboot":
            bench.node.power_up(bench.t)
            handshake.ready = handshake.enable = False
        elif step == "limit":
            bench.axis.limit_switch = (bench.axis.limit_switch + 2) % 3 - 1
        elif step == "invert":
            bench.axis.inverted_encoder = not bench.axis.inverted_encoder
        else:
            bench.node.trip(int(step, 16), bench.t)
        if bench.axis.powered and not was:
            assert handshake.enable
        assert bench.node.due_ns() > bench.t
        assert all(len(frame.data) <= 8 and 0 < frame.id <= 0x7FF for frame in bench._collect())
    bench.word(0)
    bench.nmt(0x81)
    bench.run(1000)
    assert not bench.axis.powered
    assert bench.axis.brake_closed
