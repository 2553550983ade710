"""Small disks on which a cell's state lies, for fault trials of the whole service: one that is filled to the last byte,
one that becomes read-only while files on it are open. To mount them is root's.
"""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

from stereoservo.client import Client
from stereoservo_sim.benchmarks.service_bench import CELL, ServiceBench, VoidTrialError

DISK_MIB = 64
RECORDS_S = 10.0
"""After which a recording that was asked for has begun, or has not."""
GROWS_S = 20.0
"""After which a flight ring that can be written again is."""
FILLS = """
import sys, time
zeros, full = bytes(1 << 20), False
with open(sys.argv[1], "ab", buffering=0) as file:
    while True:
        try:
            file.write(zeros)
        except OSError:
            if not full:
                print("full", flush=True)
            full = True
            time.sleep(0.005)
"""
"""Fills a disk to its last byte, and takes what becomes free."""
RING, RECORDING = "flight ring", "left out"
"""Of the notes that nothing is recorded."""


def memory_disk(bench: ServiceBench) -> None:
    """The state directory lies on a file system in memory. Raises VoidTrialError where nothing may be mounted."""
    _mount(bench, bench.directories.state, "-t", "tmpfs", "-o", f"size={DISK_MIB}m,mode=700", "stereoservo")


def image_disk(bench: ServiceBench) -> None:
    """It lies on an ext4 in a file, which, unlike one in memory, becomes read-only while files on it are open: as a
    disk with errors does. Raises VoidTrialError.

    The file is in memory: what is written to a disk that the drives and slots of the trial lie on could hold them up.
    """
    memory = bench.folder / "memory"
    _mount(bench, memory, "-t", "tmpfs", "-o", f"size={2 * DISK_MIB}m,mode=700", "stereoservo")
    image = memory / "disk.img"
    with image.open("wb") as file:
        file.truncate(DISK_MIB << 20)
    _called("mkfs.ext4", "-q", "-m", "0", str(image))
    _mount(bench, bench.directories.state, "-o", "loop,errors=remount-ro", str(image))


def _mount(bench: ServiceBench, place: Path, *arguments: str) -> None:
    """Mount at a place, until `ServiceBench.forget_state`."""
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    _called("mount", *arguments, str(place))
    bench.mounts.callback(_unmount, place)


def _unmount(place: Path) -> None:
    """At once, or, where a process still has files open, for all who come later."""
    try:
        _called("umount", str(place))
    except VoidTrialError:
        _called("umount", "--lazy", str(place))


def _called(*words: str) -> None:
    try:
        subprocess.run(words, capture_output=True, check=True, text=True)
    except OSError as error:
        raise VoidTrialError(f"{words[0]}: {error.strerror}") from error
    except subprocess.CalledProcessError as error:
        raise VoidTrialError(f"{words[0]}: {error.stderr.strip().splitlines()[0]}") from error


def full_disk(bench: ServiceBench) -> int:
    """The disk is full; the flight is being recorded."""
    _record(bench)
    filler = bench.directories.state / "filler"
    bench.lasting.callback(filler.unlink)
    t0_ns = time.monotonic_ns()
    bench.start_lasting(FILLS, str(filler))
    return t0_ns


def read_only_disk(bench: ServiceBench) -> int:
    """The file system is read-only from now on, for files that are open, too; the flight is being recorded."""
    _record(bench)
    t0_ns = time.monotonic_ns()
    _called("mount", "-o", "remount,abort,errors=remount-ro", str(bench.directories.state))
    return t0_ns


def _record(bench: ServiceBench) -> None:
    """Record the flight, from the moment that the file is begun. Raises VoidTrialError."""
    with Client(CELL) as client:
        client.record()
        until = time.monotonic() + RECORDS_S
        while not client.info().recording:
            if time.monotonic() > until:
                raise VoidTrialError(f"no recording had begun after {RECORDS_S:g} s")
            time.sleep(0.02)


def records_again(bench: ServiceBench) -> str:
    """What is wrong with recording now that there is room: the flight ring goes on, a recording that is asked for
    begins; empty where nothing is.
    """
    until = time.monotonic() + GROWS_S

    def ring_grows(client: Client) -> bool:
        while any(RING in note for note in client.status().notes):
            if time.monotonic() > until:
                return False
            time.sleep(0.05)
        return True

    if not bench.asked(ring_grows):
        return f"the flight ring is not written {GROWS_S:g} s after there was room"
    try:
        _record(bench)
        with Client(CELL) as client:
            file = Path(client.info().recording)
            client.record(on=False)
    except VoidTrialError as error:
        return str(error)
    return unexpected(bench) if file.is_file() and file.stat().st_size else f"nothing is in {file}"


def starts_again(bench: ServiceBench) -> str:
    """What is wrong with a daemon that ends, and one that starts, on a disk that cannot be written; empty where nothing
    is.
    """
    code = bench.daemon.stop()
    wrong = [f"the daemon ended with exit code {code}"] if code else []
    wrong.append(unexpected(bench))
    bench.ready()
    wrong.append(unexpected(bench))
    return "; ".join(filter(None, wrong))


def unexpected(bench: ServiceBench) -> str:
    """Lines of the daemon's log that no disk is a reason for: a process that ended, a traceback; empty without."""
    words = ("Traceback", "starting again", "Error")
    return "; ".join(
        line for line in bench.daemon.output().splitlines() if any(word in line for word in words)
    )
