"""Files of a cell: reading with a limit, writing atomically, checksums of JSON files, and damaged files set aside."""

from __future__ import annotations

import errno
import os
import re
import stat
import tempfile
import zlib
from pathlib import Path

MOST_SET_ASIDE = 10_000
_CHECKSUM = re.compile(rb',\n "crc32": "([0-9a-f]{8})"\n\}\s*\Z')


def read_bounded(path: Path, limit: int) -> bytes:
    """Content of a regular file of at most ``limit`` bytes; the size is compared before anything is allocated.

    Raises OSError, ValueError.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a FIFO must not block
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise ValueError("is not a regular file")
        if found.st_size > limit:
            raise ValueError(f"has {found.st_size} bytes; at most {limit} are read")
        with open(handle, "rb", closefd=False) as file:
            return file.read(limit)
    finally:
        os.close(handle)


def set_aside(path: Path) -> str:
    """Rename a damaged file to ``NAME.damaged-<n>``; returns a text on what was done. Nothing is ever deleted."""
    for n in range(1, MOST_SET_ASIDE):
        aside = path.with_name(f"{path.name}.damaged-{n}")
        if os.path.lexists(aside):
            continue
        try:
            path.rename(aside)
        except OSError as error:
            return f"it stays where it is ({error.strerror})"
        return f"it is set aside as {aside.name}"
    return f"it stays where it is ({MOST_SET_ASIDE} damaged ones are beside it)"


def with_checksum(document: bytes) -> bytes:
    """A JSON object, indented by one, with the CRC-32 of its text so far as its last member ``crc32``."""
    body = document.rstrip().removesuffix(b"\n}")
    return body + b',\n "crc32": "%08x"\n}\n' % zlib.crc32(body)


def verify_checksum(data: bytes) -> None:
    """Compare the content of a JSON file with its ``crc32``. Raises ValueError.

    Files without one, and those reformatted by another program, are not compared.
    """
    match = _CHECKSUM.search(data, max(0, len(data) - 200))
    if match is None:
        return
    found = zlib.crc32(data[: match.start()])
    if int(match[1], 16) != found:
        raise ValueError(
            f"its content has CRC {found:08x}, written was {match[1].decode()}: it is damaged, or was edited by hand "
            "(remove the member crc32 then)"
        )


def check_writable(path: Path) -> None:
    """Raise OSError if `write_atomically` cannot write a file: the folder does not exist, or the path is not a file."""
    if not path.parent.is_dir():
        code = errno.ENOTDIR if path.parent.exists() else errno.ENOENT
        raise OSError(code, f"{os.strerror(code)}: a folder that exists is needed", str(path.parent))
    if path.is_dir():
        raise OSError(errno.EISDIR, f"{os.strerror(errno.EISDIR)}: the name of a file is needed", str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "Not a regular file: the name of a file, new or old, is needed", str(path))
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, f"{os.strerror(errno.EACCES)}: a folder to write to is needed", str(path.parent))


def write_atomically(path: Path, data: bytes) -> None:
    """Write ``data`` atomically: a reader finds either the old file or the new one complete, also after a crash.

    Raises OSError, also for a path that is not a regular file: replacing a device would destroy it.
    """
    check_writable(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes 0600; a model is no secret and other users' tools read it.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
