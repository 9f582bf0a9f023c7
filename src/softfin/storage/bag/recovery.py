"""A bag that was cut off or damaged in, a whole one out, with every message that can be read; the original stays."""

import contextlib
import importlib.metadata
import os
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from softfin.core.errors import LogError, RunError
from softfin.storage.bag.chunks import CHANNEL, MESSAGE, SCHEMA
from softfin.storage.bag.messages import writer_on
from softfin.storage.bag.scan import BagScan, Damage
from softfin.storage.paths import check_recoverable

DEFINITIONS_BYTES = 64 * 2**20
"""All definitions of messages together; those of ROS 2's common messages are below 100 kB."""

MESSAGE_HEAD = 22
"""Bytes of a message's record before its data."""

_STAMPED = struct.Struct("<HxxxxQ").unpack_from
"""Channel and time of logging of a message's record."""


class Recovery(NamedTuple):
    """What came of it."""

    whole: bool
    """Nothing was wrong, so nothing was written."""
    messages: dict[str, int]
    """Saved, or there, by topic."""
    seconds: float
    """From the first to the last message's time of logging [s]."""
    orphans: int
    """Messages whose topic is no longer known: they are not saved."""
    damages: tuple[Damage, ...]
    """What could not be read."""

    def described(self) -> dict[str, Any]:
        """For JSON."""
        damages = [{"byte": one.start, "bytes": one.length, "reason": one.reason} for one in self.damages]
        return {**self._asdict(), "damages": damages}


class _Schema(NamedTuple):
    name: str
    encoding: str
    data: bytes


class _Channel(NamedTuple):
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class _Definitions(NamedTuple):
    schemas: dict[int, _Schema]
    channels: dict[int, _Channel]


def recovered_path(path: Path) -> Path:
    """Where it is written unless told: ``run.recovered.mcap`` beside ``run.mcap``."""
    return path.with_name(f"{path.stem}.recovered.mcap")


def recover(path: Path, out: Path, overwrite: bool = False) -> Recovery:
    """Save what can be read; raises LogError where nothing can, or `out` exists."""
    check_recoverable(path)
    if out.exists() and (not overwrite or out.is_dir() or (path.exists() and out.samefile(path))):
        raise LogError(f"{out}: exists already; give another --out")
    definitions, recovery = _survey(BagScan(path))
    if recovery.whole:
        return recovery
    if not recovery.messages:
        reason = recovery.damages[0].reason
        raise LogError(f"{path}: no message in it can be read ({reason}); copy it again from where it was recorded")
    _write(out, lambda file: _copy(path, definitions, file))
    return recovery


def _survey(scan: BagScan) -> tuple[_Definitions, Recovery]:
    """Definitions may stand behind their messages where the first chunk is lost: the index repeats them."""
    definitions, counts, partial = _Definitions({}, {}), Counter[int](), list[Damage]()
    first, last, room = 2**64, 0, DEFINITIONS_BYTES
    for opcode, content in scan.records():
        if opcode == MESSAGE and len(content) >= MESSAGE_HEAD:
            channel, stamp = _STAMPED(content)
            counts[channel] += 1
            first, last = min(first, stamp), max(last, stamp)
        elif opcode in (SCHEMA, CHANNEL):
            room -= len(content)
            if room < 0:
                raise LogError(f"{scan.path}: over {DEFINITIONS_BYTES / 1e6:.0f} MB of definitions: no recording")
            if not _define(definitions, opcode, content):
                partial.append(Damage(0, len(content), "a definition that cannot be read"))
        elif opcode in (0, MESSAGE):
            partial.append(Damage(0, len(content), "a record that is not whole"))
    messages: Counter[str] = Counter()
    orphans = 0
    for channel, count in counts.items():
        if channel in definitions.channels:
            messages[definitions.channels[channel].topic] += count
        else:
            orphans += count
    if orphans:
        partial.append(Damage(0, 0, f"{orphans:,} messages of which nothing says the topic"))
    damages = (*scan.damages, *partial)
    return definitions, Recovery(not damages, dict(messages), max(0, last - first) / 1e9, orphans, damages)


def _define(definitions: _Definitions, opcode: int, content: memoryview) -> bool:
    """The first definition of a number stands, as the MCAP specification has it; False if it cannot be read."""
    try:
        number = struct.unpack_from("<H", content)[0]
        if opcode == SCHEMA:
            name, at = _text(content, 2)
            encoding, at = _text(content, at)
            data, _ = _bytes(content, at)
            definitions.schemas.setdefault(number, _Schema(name, encoding, data))
        else:
            schema = struct.unpack_from("<H", content, 2)[0]
            topic, at = _text(content, 4)
            encoding, at = _text(content, at)
            pairs, _ = _bytes(content, at)
            definitions.channels.setdefault(number, _Channel(schema, topic, encoding, _pairs(pairs)))
    except (struct.error, UnicodeDecodeError):
        return False
    return True


def _bytes(content: memoryview, at: int) -> tuple[bytes, int]:
    length = struct.unpack_from("<I", content, at)[0]
    return struct.unpack_from(f"<{length}s", content, at + 4)[0], at + 4 + length


def _text(content: memoryview, at: int) -> tuple[str, int]:
    data, following = _bytes(content, at)
    return data.decode(), following


def _pairs(data: bytes) -> dict[str, str]:
    pairs, at, view = {}, 0, memoryview(data)
    while at < len(data):
        name, at = _text(view, at)
        pairs[name], at = _text(view, at)
    return pairs


def _copy(path: Path, definitions: _Definitions, file: BinaryIO) -> None:
    writer = writer_on(file, f"softfin {importlib.metadata.version('softfin')}")
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    for opcode, content in BagScan(path).records():
        if opcode != MESSAGE or len(content) < MESSAGE_HEAD:
            continue
        number, sequence, logged, published = struct.unpack_from("<HIQQ", content)
        channel = definitions.channels.get(number)
        if channel is None:
            continue
        if number not in channels:
            if channel.schema not in schemas:
                schema = definitions.schemas.get(channel.schema)
                schemas[channel.schema] = 0 if schema is None else writer.register_schema(*schema)
            channels[number] = writer.register_channel(
                channel.topic, channel.encoding, schemas[channel.schema], channel.metadata
            )
        writer.add_message(channels[number], logged, bytes(content[MESSAGE_HEAD:]), published, sequence)
    writer.finish()


def _write(out: Path, write: Callable[[BinaryIO], None]) -> None:
    """Beside its place, then renamed into it."""
    beside = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(out)
    except OSError as error:
        raise RunError(
            f"{out}: cannot be written ({error.strerror or error}); make room, or give another --out"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink()
