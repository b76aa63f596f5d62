"""TensorBoard event files, one a trial: `tensorboard --logdir <sweep>/trials`.

The format is a few lines, and the packages that write it import torch, which takes longer than a small sweep's packs do
to their first results. A file is a sequence of TFRecords (length, its checksum, data, its checksum); the data are
`tensorflow.Event` messages, of which only times, steps and scalars are needed here.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import defaultdict

from analysis.records import TrialRecord
from tune_jobs.store.contract import Sweep

_FILE_VERSION = b"brain.Event:2"
# Protocol buffers: number of the field, and how it is written.
_DOUBLE, _VARINT, _BYTES, _FLOAT = 1, 0, 2, 5
_CRC32C_POLYNOMIAL = 0x82F63B78


class ScalarWriter:
    """Writes a trial's returns and speed against its env steps.

    Args:
        sweep: Whose trials they are.
    """

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        # Of this run: one that goes on with a trial writes a further file beside the earlier ones.
        self._name = f"events.out.tfevents.{int(time.time()):010d}.{time.time_ns() % 10**9:09d}.{socket.gethostname()}"
        self._begun: set[str] = set()
        self._unwritten: defaultdict[str, bytearray] = defaultdict(bytearray)

    def write(self, record: TrialRecord, *, evaluated: bool) -> None:
        """Add the trial's current numbers, the evaluation return only where it is new; `flush` writes them to disk."""
        values = {
            "training_return": record.training_return,
            "evaluation_return": record.evaluation_return if evaluated else None,
            "num_episodes": record.num_episodes,
            "env_steps_per_s": record.num_env_steps / record.time_s if record.time_s else None,
        }
        known = {name: float(value) for name, value in values.items() if value is not None}
        if record.trial_id not in self._begun:
            self._begun.add(record.trial_id)
            self._unwritten[record.trial_id] += _record(_double(1, time.time()) + _bytes(3, _FILE_VERSION))
        self._unwritten[record.trial_id] += _record(_event(record.num_env_steps, known))

    def flush(self) -> None:
        """Append what was added to the files."""
        for trial_id, data in self._unwritten.items():
            self._sweep.trial(trial_id).append_events(self._name, bytes(data))
        self._unwritten.clear()


def _event(step: int, values: dict[str, float]) -> bytes:
    summary = b"".join(_bytes(1, _bytes(1, name.encode()) + _float(2, value)) for name, value in values.items())
    return _double(1, time.time()) + _key(2, _VARINT) + _varint(step) + _bytes(5, summary)


def _record(data: bytes) -> bytes:
    length = struct.pack("<Q", len(data))
    return length + _checksum(length) + data + _checksum(data)


def _key(field: int, kind: int) -> bytes:
    return _varint(field << 3 | kind)


def _double(field: int, value: float) -> bytes:
    return _key(field, _DOUBLE) + struct.pack("<d", value)


def _float(field: int, value: float) -> bytes:
    # Beyond the range of a float it is infinite there, as TensorBoard's own writers have it.
    try:
        return _key(field, _FLOAT) + struct.pack("<f", value)
    except OverflowError:
        return _key(field, _FLOAT) + struct.pack("<f", float("inf") if value > 0 else float("-inf"))


def _bytes(field: int, value: bytes) -> bytes:
    return _key(field, _BYTES) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    data = bytearray()
    while value > 0x7F:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)


def _checksum(data: bytes) -> bytes:
    """CRC-32C (Castagnoli), masked as TFRecords have it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _CRC32C[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    crc ^= 0xFFFFFFFF
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def _crc32c_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (_CRC32C_POLYNOMIAL if byte & 1 else 0)
    return byte


_CRC32C = tuple(map(_crc32c_of, range(256)))
