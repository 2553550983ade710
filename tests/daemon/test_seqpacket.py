"""The message channel: whole messages or none, in order, never blocking."""

from pathlib import Path

import pytest

from stereoservo.daemon.channels.seqpacket import (
    MAX_MESSAGE_BYTES,
    ChannelError,
    ChannelServer,
    PacketChannel,
)
from stereoservo.messages.directories import DirectoryError


def test_messages_arrive_whole_and_in_order_both_ways(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock")
    client = PacketChannel.connect(tmp_path / "a.sock")
    (peer,) = server.accept()
    assert all(client.send(bytes([k]) * (k + 1)) for k in range(5))
    assert peer.receive() == [bytes([k]) * (k + 1) for k in range(5)]
    assert peer.receive() == []
    assert peer.send(b"answer")
    assert client.receive() == [b"answer"]
    assert client.send(b"x" * MAX_MESSAGE_BYTES)
    assert peer.receive() == [b"x" * MAX_MESSAGE_BYTES]
    client.close()
    server.close()
    assert not (tmp_path / "a.sock").exists()


def test_a_full_channel_says_so_and_loses_nothing_that_it_took(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock")
    client = PacketChannel.connect(tmp_path / "a.sock")
    (peer,) = server.accept()
    taken = 0
    while client.send(taken.to_bytes(4, "little") * 1000):
        taken += 1
    assert taken > 10
    assert client.is_open
    received = []
    while some := peer.receive():
        received += [int.from_bytes(message[:4], "little") for message in some]
    assert received == list(range(taken))
    assert client.send(b"room again")
    client.close()
    server.close()


def test_a_closed_peer_is_noticed_on_either_side(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock")
    client = PacketChannel.connect(tmp_path / "a.sock")
    (peer,) = server.accept()
    client.send(b"last words")
    client.close()
    assert peer.receive() == [b"last words"]
    assert not peer.is_open
    assert peer.send(b"x") is False
    assert server.accept() == []
    assert server.peers == []
    server.close()


def test_last_words_survive_a_send_to_a_peer_that_has_gone(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock")
    client = PacketChannel.connect(tmp_path / "a.sock")
    (peer,) = server.accept()
    assert peer.send(b"never read")  # what the peer leaves unread resets the connection
    client.send(b"last words")
    client.close()
    assert peer.send(b"x") is False
    assert peer.receive() == [b"last words"]
    assert not peer.is_open
    server.close()


def test_a_single_server_keeps_only_the_newest_peer(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock", single=True)
    old = PacketChannel.connect(tmp_path / "a.sock")
    server.accept()
    new = PacketChannel.connect(tmp_path / "a.sock")
    (peer,) = server.accept()
    assert old.receive() == []
    assert not old.is_open
    new.send(b"hello")
    assert peer.receive() == [b"hello"]
    server.close()


def test_peers_are_bounded(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock", max_peers=2)
    clients = [PacketChannel.connect(tmp_path / "a.sock") for _ in range(3)]
    assert len(server.accept()) == 2
    clients[2].receive()
    assert [client.is_open for client in clients] == [True, True, False]
    server.close()


def test_a_server_that_hangs_holds_up_nobody_who_connects(tmp_path: Path) -> None:
    server = ChannelServer(tmp_path / "a.sock")
    waiting = list[PacketChannel]()

    def connect_without_end() -> None:
        while True:  # once the server's queue was full it waited, without end
            waiting.append(PacketChannel.connect(tmp_path / "a.sock"))

    with pytest.raises(ChannelError, match="accepts no connection"):
        connect_without_end()
    assert waiting[0].send(b"first")
    assert server.accept()[0].receive() == [b"first"]
    for channel in waiting:
        channel.close()
    server.close()


def test_what_cannot_work_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ChannelError, match="nobody listens") as caught:
        PacketChannel.connect(tmp_path / "none.sock")
    assert caught.value.code == "unreachable"
    server = ChannelServer(tmp_path / "a.sock")
    with PacketChannel.connect(tmp_path / "a.sock") as client, pytest.raises(ChannelError, match="at most"):
        client.send(b"x" * (MAX_MESSAGE_BYTES + 1))
    server.close()
    with pytest.raises(DirectoryError, match="at most 107"):
        ChannelServer(tmp_path / ("x" * 120))


def test_a_socket_file_left_by_a_killed_process_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.sock").touch()
    server = ChannelServer(tmp_path / "a.sock")
    PacketChannel.connect(tmp_path / "a.sock").close()
    server.close()
