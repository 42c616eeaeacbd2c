"""Checks the checksums of MCAP files before a log is read, and writes them into files that this library writes.

The package that reads and writes messages writes no checksums, and reads flipped bits as other numbers without an
error.

Source: the MCAP format specification, version 0: https://mcap.dev/spec.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from scalargraph.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
FOOTER, CHUNK, DATA_END = 0x02, 0x06, 0x0F
"""Codes of the records that contain a checksum; a checksum of 0 means that it is not known."""
HEAD = struct.Struct("<BQ")
"""Layout of a record's head: its code, and the length of its content."""
TIMES_AND_SIZE, CRC = struct.Struct("<QQQ"), struct.Struct("<I")
"""Layout of the data before the checksum of a chunk, and layout of a checksum."""
BLOCK = 1 << 20
"""Bytes that are read at a time."""


class _Record(NamedTuple):
    """A record of a file: its code, and the offset and length of its content."""

    code: int
    start: int
    length: int


def check_checksums(path: Path) -> None:
    """Compare the checksums of a file with its content; raises `ValueError` for the first that differs."""
    with path.open("rb") as file:
        records = list(_records(file))
        for number, record in enumerate((each for each in records if each.code == CHUNK), start=1):
            stated, content = _chunk(file, record)
            # The content of a compressed chunk is checked when it is unpacked.
            if stated and content is not None and zlib.crc32(content) != stated:
                raise InputError(f"chunk {number} does not fit its checksum: the file is damaged; copy it again")
        for name, stated, computed in _sections(file, records):
            if stated not in (0, computed):
                raise InputError(f"its {name} does not fit its checksum: the file is damaged; copy it again")


def write_checksums(path: Path) -> None:
    """Write the checksums of a file that has none."""
    with path.open("r+b") as file:
        records = list(_records(file))
        for record in (each for each in records if each.code == CHUNK):
            _, content = _chunk(file, record)
            if content is not None:
                _put(file, record.start + TIMES_AND_SIZE.size, zlib.crc32(content))
        # The data section comes first, because its checksum covers the checksums of the chunks.
        for record, (_, _, computed) in zip(_ends(records), _sections(file, records), strict=True):
            _put(file, record.start + record.length - CRC.size, computed)
        file.flush()
        os.fsync(file.fileno())


def _records(file: BinaryIO) -> Iterator[_Record]:
    """The complete records of a file; none if it is not an MCAP file."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return
    at = len(MAGIC)
    while at + HEAD.size <= size:
        file.seek(at)
        code, length = HEAD.unpack(file.read(HEAD.size))
        at += HEAD.size
        if at + length > size:
            return
        yield _Record(code, at, length)
        at += length
        if code == FOOTER:
            return


def _chunk(file: BinaryIO, record: _Record) -> tuple[int, bytes | None]:
    """The stated checksum of a chunk, and its content; None instead of the content if it is compressed."""
    file.seek(record.start)
    content = file.read(record.length)
    (stated,) = CRC.unpack_from(content, TIMES_AND_SIZE.size)
    at = TIMES_AND_SIZE.size + CRC.size
    (compression,) = CRC.unpack_from(content, at)  # length of the method's name, 0 for no compression
    return stated, None if compression else content[at + CRC.size + 8 :]


def _ends(records: list[_Record]) -> list[_Record]:
    """The records that end with the checksum of a section: the data section or the summary."""
    return [record for record in records if record.code in (DATA_END, FOOTER)]


def _sections(file: BinaryIO, records: list[_Record]) -> Iterator[tuple[str, int, int]]:
    """Name, stated checksum and computed checksum of each section, in the order of `_ends`."""
    for record in _ends(records):
        file.seek(record.start)
        content = file.read(record.length)
        (stated,) = CRC.unpack_from(content, record.length - CRC.size)
        if record.code == DATA_END:
            yield "data section", stated, _checksum(file, 0, record.start - HEAD.size)
        else:
            (summary,) = struct.unpack_from("<Q", content)
            begin = summary or record.start - HEAD.size  # without a summary the section consists of the footer
            yield "summary", stated, _checksum(file, begin, record.start + record.length - CRC.size)


def _checksum(file: BinaryIO, begin: int, end: int) -> int:
    checksum = 0
    file.seek(begin)
    while begin < end:
        block = file.read(min(BLOCK, end - begin))
        if not block:
            return checksum
        checksum, begin = zlib.crc32(block, checksum), begin + len(block)
    return checksum


def _put(file: BinaryIO, at: int, checksum: int) -> None:
    file.seek(at)
    file.write(CRC.pack(checksum))
