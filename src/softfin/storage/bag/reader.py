"""Reads the messages of a bag, ROS 2 (MCAP or SQLite) or ROS 1. Needs neither ROS nor an index, a
profile or `metadata.yaml`."""

from collections import defaultdict
from collections.abc import Collection
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
from softfin.storage.bag.messages import CHANNEL_TOPICS, type_store
from softfin.storage.bag.recovery import MAX_RECORD_BYTES, check_bag
from softfin.storage.paths import BAGS

ENCODINGS = {"cdr": "CDR (ROS 2)", "ros1": "ROS 1"}
"""Encodings of messages that `decode_message` reads, with their names."""

READERS: dict[str, Any] = {".db3": Sqlite3Reader, ".bag": Ros1Reader}
"""Readers of files by suffix."""


class BagMessage(NamedTuple):
    """A message before it is decoded."""

    kind: str
    encoding: str
    logged_ns: int
    """Time at which it was recorded, since 1970 [ns]."""
    data: bytes


class BagContents:
    """Types of the topics of a bag, and the messages of wanted topics and of softfin's channels."""

    def __init__(self, wanted: Collection[str]) -> None:
        self.types: dict[str, str] = {}
        self.messages: defaultdict[str, list[BagMessage]] = defaultdict(list)
        self._wanted = wanted

    def is_wanted(self, topic: str) -> bool:
        """Whether the messages of a topic are kept."""
        return topic in self._wanted or topic.startswith(CHANNEL_TOPICS)

    def add(self, topic: str, kind: str, encoding: str, logged_ns: int, data: bytes) -> None:
        """Keep the type, and the message of a wanted topic."""
        # ROS 1 omits the middle part of a type's name.
        package, _, name = kind.rpartition("/")
        kind = kind if "/" in package else f"{package}/msg/{name}"
        self.types[topic] = kind
        if self.is_wanted(topic):
            if data.startswith(zstandard.FRAME_HEADER):
                # ROS 2 can compress each message.
                data = zstandard.decompress(data, MAX_RECORD_BYTES)
            self.messages[topic].append(BagMessage(kind, encoding, logged_ns, data))


def read_contents(path: Path, wanted: Collection[str]) -> BagContents:
    """Read a file, or the folder of a bag; raises LogError if it cannot be read."""
    contents = BagContents(wanted)
    files = [path]
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in BAGS]
    # A folder without such files has compressed ones, which rosbags unpacks.
    for file in files or [path]:
        try:
            if file.suffix.lower() == ".mcap":
                _read_mcap(file, contents)
            else:
                _read_with_rosbags(file, contents)
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
    for messages in contents.messages.values():
        messages.sort(key=lambda message: message.logged_ns)
    return contents


def _read_mcap(file: Path, contents: BagContents) -> None:
    check_bag(file)
    with file.open("rb") as stream:
        reader = NonSeekingReader(stream)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            kind = "" if schema is None else schema.name
            encoding = channel.message_encoding
            contents.add(channel.topic, kind, encoding, message.log_time, message.data)


def _read_with_rosbags(path: Path, contents: BagContents) -> None:
    reader = READERS.get(path.suffix.lower(), Reader)(path)
    reader.open()
    try:
        contents.types |= {each.topic: each.msgtype for each in reader.connections}
        wanted = [each for each in reader.connections if contents.is_wanted(each.topic)]
        # With an empty list of connections, the reader would read all topics.
        for connection, logged_ns, data in reader.messages(wanted) if wanted else ():
            encoding = getattr(connection.ext, "serialization_format", "ros1")
            contents.add(connection.topic, connection.msgtype, encoding, logged_ns, bytes(data))
    finally:
        reader.close()


@cache
def _ros1_types() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def decode_message(message: BagMessage) -> Any:
    """Decode a message with ROS's own definitions, not with the bag's: rosbags turns definitions
    into code, and a bag may come from an untrusted source.

    Raises any exception for damaged bytes.
    """
    if message.encoding == "ros1":
        return _ros1_types().deserialize_ros1(message.data, message.kind)
    return type_store().deserialize_cdr(message.data, message.kind)
