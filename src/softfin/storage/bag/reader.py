"""Reads the messages of a bag, ROS 2 (MCAP or SQLite) or ROS 1. Needs neither ROS nor an index, a
profile or `metadata.yaml`."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.reader import NonSeekingReader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.errors import InputError, LogError, one_line
from softfin.core.printable import printable
from softfin.storage.bag.messages import type_store
from softfin.storage.bag.recovery import MAX_RECORD_BYTES, check_bag
from softfin.storage.paths import BAGS

ENCODINGS = {"cdr": "CDR (ROS 2)", "ros1": "ROS 1"}
"""Message encodings that `decode_message` can read, with their names."""

READERS: dict[str, Any] = {".db3": Sqlite3Reader, ".bag": Ros1Reader}
"""Readers of files by suffix."""


class BagMessage(NamedTuple):
    """A message before it is decoded."""

    topic: str
    kind: str
    encoding: str
    logged_ns: int
    """Time at which it was recorded, since 1970 [ns]."""
    data: bytes


def read_messages(path: Path) -> Iterator[BagMessage]:
    """Yield the messages of a file, or of the folder of a bag; raises LogError if it cannot be
    read."""
    files = [path]
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in BAGS]
    # A folder without such files has compressed ones, which rosbags unpacks.
    for file in files or [path]:
        try:
            is_mcap = file.suffix.lower() == ".mcap"
            yield from _mcap_messages(file) if is_mcap else _rosbags_messages(file)
        except InputError:
            raise
        except Exception as error:
            # A damaged bag may fail in the database, the decompression or the reader, each with
            # its own exception type.
            reason = printable(one_line(error), most=300)
            raise LogError(
                f"{file}: cannot be read as a bag ({reason}); copy it again from where it was "
                "recorded"
            ) from None


def _mcap_messages(file: Path) -> Iterator[BagMessage]:
    check_bag(file)
    with file.open("rb") as stream:
        reader = NonSeekingReader(stream)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            kind = "" if schema is None else _full_type(schema.name)
            encoding = channel.message_encoding
            yield BagMessage(channel.topic, kind, encoding, message.log_time, message.data)


def _rosbags_messages(path: Path) -> Iterator[BagMessage]:
    reader = READERS.get(path.suffix.lower(), Reader)(path)
    reader.open()
    try:
        for connection, logged_ns, data in reader.messages(reader.connections):
            encoding = getattr(connection.ext, "serialization_format", "ros1")
            kind = _full_type(connection.msgtype)
            yield BagMessage(connection.topic, kind, encoding, logged_ns, bytes(data))
    finally:
        reader.close()


def _full_type(kind: str) -> str:
    """Return a type's name in ROS 2's form; ROS 1 omits the middle part."""
    package, _, name = kind.rpartition("/")
    return kind if "/" in package else f"{package}/msg/{name}"


@cache
def _ros1_types() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def decode_message(message: BagMessage) -> Any:
    """Decode a message with ROS's own definitions, not with the bag's: rosbags turns definitions
    into code, and a bag may come from an untrusted source.

    Raises any exception for damaged bytes.
    """
    data = message.data
    if data.startswith(zstandard.FRAME_HEADER):
        # ROS 2 can compress each message.
        data = zstandard.decompress(data, MAX_RECORD_BYTES)
    if message.encoding == "ros1":
        return _ros1_types().deserialize_ros1(data, message.kind)
    return type_store().deserialize_cdr(data, message.kind)
