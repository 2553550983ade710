"""SDO server: against canopen's SDO client over a synchronous loopback, and frame by frame where no client goes."""

import struct
from pathlib import Path

import canopen
import pytest
from canopen.sdo import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st

from stereoservo_sim.emulators.nodes.communication import Dictionary, SdoServer

SMALL = Path(__file__).parent / "small.eds"
NODE = 5


class Loopback(canopen.Network):
    """A bus with nothing but the server on it; answers come before ``send_message`` returns."""

    def __init__(self, answer):
        super().__init__()
        self._answer = answer

    def send_message(self, can_id, data, remote=False):
        for answered, payload in self._answer(can_id, bytes(data)):
            self.notify(answered, bytearray(payload), 0.0)


@pytest.fixture
def server():
    return SdoServer(Dictionary(SMALL, NODE))


@pytest.fixture
def client(server):
    def answer(can_id, data):
        reply = server.request(data, 0) if can_id == 0x600 + NODE else None
        return [] if reply is None else [(0x580 + NODE, reply)]

    return Loopback(answer).add_node(NODE, canopen.import_od(str(SMALL), NODE)).sdo


def abort_code(answer):
    assert answer is not None
    assert len(answer) == 8
    assert answer[0] == 0x80
    return struct.unpack_from("<L", answer, 4)[0]


def test_reads_through_the_client(client):
    assert client[0x1000].raw == 0x20192
    assert client[0x2000].raw == "hello"
    assert client[0x2001].raw == 7
    assert client[0x2003][1].raw == 0x1122334455667788
    assert client[0x2004].raw == 1.5
    assert client[0x2006].raw == 0x185
    assert client.upload(0x2005, 0) == b""


def test_writes_through_the_client(client):
    client[0x2001].raw = -5
    assert client[0x2001].raw == -5
    client[0x2003][1].raw = 1
    assert client[0x2003][1].raw == 1
    client[0x2004].raw = -0.25
    assert client[0x2004].raw == -0.25


@given(text=st.binary(min_size=1, max_size=60))
def test_strings_of_any_length_survive_both_ways(text):
    server = SdoServer(Dictionary(SMALL, NODE))

    def answer(can_id, data):
        reply = server.request(data, 0)
        return [] if reply is None else [(0x580 + NODE, reply)]

    sdo = Loopback(answer).add_node(NODE, canopen.ObjectDictionary()).sdo
    sdo.download(0x2000, 0, text, force_segment=True)
    assert sdo.upload(0x2000, 0) == text


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x3000, 0, b"\1", 0x06020000),
        (0x2003, 7, b"\1", 0x06090011),
        (0x2001, 1, b"\1\0", 0x06090011),
        (0x1000, 0, b"\1\0\0\0", 0x06010002),
        (0x2003, 0, b"\1", 0x06010002),
        (0x2001, 0, b"\1\0\0\0", 0x06070012),
        (0x2001, 0, b"\1", 0x06070013),
        (0x2001, 0, b"\x65\0", 0x06090031),
        (0x2001, 0, b"\xfa\xff", 0x06090032),
        (0x2003, 1, b"\1\0\0\0", 0x06070013),
    ],
)
def test_refused_writes(client, index, sub, data, code):
    with pytest.raises(SdoAbortedError) as refused:
        client.download(index, sub, data)
    assert refused.value.code == code
    assert client[0x2001].raw == 7


@pytest.mark.parametrize(
    ("index", "sub", "code"), [(0x3000, 0, 0x06020000), (0x2003, 9, 0x06090011), (0x2002, 0, 0x06010001)]
)
def test_refused_reads(client, index, sub, code):
    with pytest.raises(SdoAbortedError) as refused:
        client.upload(index, sub)
    assert refused.value.code == code


def test_block_transfer_is_refused(client):
    with pytest.raises(SdoAbortedError) as refused:
        client.open(0x2000, 0, "rb", block_transfer=True)
    assert refused.value.code == 0x05040001
    with pytest.raises(SdoAbortedError) as refused:
        client.open(0x2000, 0, "wb", size=10, block_transfer=True)
    assert refused.value.code == 0x05040001


def test_wrong_toggle_of_an_upload_ends_it(server):
    server.request(bytes.fromhex("4000200000000000"), 0)
    assert abort_code(server.request(bytes.fromhex("7000000000000000"), 0)) == 0x05030000
    assert abort_code(server.request(bytes.fromhex("6000000000000000"), 0)) == 0x05040001


def test_wrong_toggle_of_a_download_ends_it_and_changes_nothing(server):
    server.request(bytes.fromhex("2100200008000000"), 0)
    assert server.request(b"\0abcdefg", 0) == b"\x20" + bytes(7)
    assert abort_code(server.request(b"\x0dh" + bytes(6), 0)) == 0x05030000
    answer = server.request(bytes.fromhex("4000200000000000"), 0)
    assert struct.unpack_from("<L", answer, 4)[0] == len("hello")


@pytest.mark.parametrize(("announced", "code"), [(9, 0x06070013), (7, 0x06070012)])
def test_segments_that_do_not_add_up(server, announced, code):
    server.request(struct.pack("<BHBL", 0x21, 0x2000, 0, announced), 0)
    server.request(b"\0abcdefg", 0)
    assert abort_code(server.request(b"\x1dh" + bytes(6), 0)) == code


def test_endless_download_is_ended(server):
    server.request(bytes.fromhex("2000200000000000"), 0)
    for k in range(200):
        answer = server.request(bytes([0x10 * (k % 2)]) + b"abcdefg", 0)
        if answer[0] == 0x80:
            break
    assert abort_code(answer) == 0x05040005


def test_the_client_may_abort(server):
    server.request(bytes.fromhex("4000200000000000"), 0)
    assert server.request(bytes.fromhex("8000200000000008"), 0) is None
    assert abort_code(server.request(bytes.fromhex("6000000000000000"), 0)) == 0x05040001


def test_a_half_transfer_times_out(server):
    server.request(bytes.fromhex("4000200000000000"), 100)
    due = server.due_ns()
    assert server.advance(due - 1) is None
    assert abort_code(server.advance(due)) == 0x05040000
    assert server.advance(server.due_ns() - 1) is None


def test_a_new_request_replaces_a_half_transfer(server):
    server.request(bytes.fromhex("2100200008000000"), 0)
    assert server.request(bytes.fromhex("4000100000000000"), 0)[:1] == b"\x43"
    assert abort_code(server.request(b"\0abcdefg", 0)) == 0x05040001


def test_frames_of_other_lengths_are_no_requests(server):
    for length in range(8):
        assert server.request(bytes.fromhex("4000100000000000")[:length], 0) is None


def test_reads_of_the_drive_through_the_client(make_bench, eds):
    bench = make_bench()

    def answer(can_id, data):
        return [(f.id, f.data) for f in bench.send(can_id, *data)]

    node = Loopback(answer).add_node(bench.id, canopen.import_od(str(eds), bench.id))
    assert node.sdo[0x1008].raw == "drive402"
    assert node.sdo[0x1000].raw & 0xFFFF == 402
    assert node.sdo[0x1018][4].raw == bench.id
    assert node.sdo[0x6502].raw == 0b1_0000_0101
    node.sdo[0x6060].raw = 9
    assert node.sdo[0x6061].raw == 9
    for mode in (2, 4, 8, 10, -1):
        with pytest.raises(SdoAbortedError) as refused:
            node.sdo[0x6060].raw = mode
        assert refused.value.code == 0x06090030
    assert node.sdo[0x6061].raw == 9
