"""Reads the messages of a bag: ROS 2 (MCAP or SQLite) or ROS 1. Needs neither ROS nor an index,
summary, profile or `metadata.yaml`.

MCAP files are read record by record, SQLite files and ROS 1 bags with rosbags.
"""

import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import yaml
import zstandard
from mcap.records import Channel, Message, Schema
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.errors import LogError, one_line
from softfin.core.printable import printable
from softfin.storage.bag.messages import type_store
from softfin.storage.bag.recovery import MAX_RECORD_BYTES, complete_records
from softfin.storage.paths import BAGS

ENCODINGS = {"cdr": "CDR (ROS 2)", "ros1": "ROS 1"}
"""Encodings of messages that `decode_message` reads, with their names."""

COMPRESSED = ".zstd"
"""Suffix of a file that ROS 2 compressed as a whole."""


class BagMessage(NamedTuple):
    """A message before it is decoded."""

    kind: str
    """Type, such as ``sensor_msgs/msg/JointState``."""
    encoding: str
    logged_ns: int
    """Time at which it was recorded, since 1970 [ns]."""
    data: bytes


class BagContents:
    """Types of all topics of a bag, and the messages of some topics in the order in which they were
    recorded."""

    def __init__(self, is_wanted: Callable[[str], bool]) -> None:
        """`is_wanted` selects the topics whose messages are kept."""
        self.types: dict[str, str] = {}
        self.messages: defaultdict[str, list[BagMessage]] = defaultdict(list)
        self.is_wanted = is_wanted

    def add(self, topic: str, kind: str, encoding: str, logged_ns: int, data: bytes) -> None:
        """Keep a message of a wanted topic."""
        if not self.is_wanted(topic):
            return
        if data.startswith(zstandard.FRAME_HEADER):
            # ROS 2 can compress each message.
            data = zstandard.ZstdDecompressor().decompress(data, MAX_RECORD_BYTES)
        self.messages[topic].append(BagMessage(_full_type(kind), encoding, logged_ns, data))


def read_contents(path: Path, is_wanted: Callable[[str], bool]) -> BagContents:
    """Read a file, or the folder of a bag; raises LogError if a file is damaged or of another
    kind."""
    contents = BagContents(is_wanted)
    with ExitStack() as stack:
        for file in _bag_files(path):
            try:
                _read_file(_uncompressed(file, stack), contents, file)
            except LogError:
                raise
            except Exception as error:
                # A damaged file may fail in the database, the decompression or the reader, each
                # with its own exception type.
                reason = printable(one_line(error), most=300)
                raise LogError(
                    f"{file}: cannot be read as a {_format_name(file)} ({reason}); copy it again "
                    "from where it was recorded"
                ) from None
    for messages in contents.messages.values():
        messages.sort(key=lambda message: message.logged_ns)
    return contents


def decode_message(message: BagMessage) -> Any:
    """Decode a message with ROS's own definitions, not with the bag's: rosbags turns definitions
    into code, and a bag may come from an untrusted source.

    Raises ValueError for an unknown encoding, and any exception for damaged bytes.
    """
    if message.encoding not in ENCODINGS:
        raise ValueError(f"softfin reads {' and '.join(ENCODINGS.values())}")
    if message.encoding == "ros1":
        return _ros1_types().deserialize_ros1(message.data, message.kind)
    return type_store().deserialize_cdr(message.data, message.kind)


@cache
def _ros1_types() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def _full_type(kind: str) -> str:
    """Return a type's name in ROS 2's form; ROS 1 omits the middle part."""
    package, _, name = kind.partition("/")
    return kind if "/" in name or not name else f"{package}/msg/{name}"


def _bag_files(path: Path) -> Iterator[Path]:
    """Yield the files of a bag: those in its `metadata.yaml`, or all in its folder if that file
    cannot be read."""
    if not path.is_dir():
        yield path
        return
    try:
        metadata = yaml.safe_load((path / "metadata.yaml").read_text(encoding="utf-8"))
        listed = metadata["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [path / PurePosixPath(name).name for name in listed]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        files = [file for file in sorted(path.iterdir()) if _storage(file) in BAGS]
    if not files:
        raise LogError(f"{path}: the bag has no files; copy it again from where it was recorded")
    for file in files:
        if not file.is_file():
            raise LogError(
                f"{file}: not found, but listed in metadata.yaml; copy it as well, or run ros2 bag "
                f"reindex {path}"
            )
        yield file


def _storage(file: Path) -> str:
    """Return the suffix that determines a file's format."""
    return Path(file.name.lower().removesuffix(COMPRESSED)).suffix


def _format_name(file: Path) -> str:
    return {".db3": "SQLite bag", ".bag": "ROS 1 bag"}.get(_storage(file), "MCAP bag")


def _uncompressed(file: Path, stack: ExitStack) -> Path:
    if not file.name.lower().endswith(COMPRESSED):
        return file
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    unpacked = Path(folder) / file.stem
    with file.open("rb") as source, unpacked.open("wb") as target:
        zstandard.ZstdDecompressor().copy_stream(source, target)
    return unpacked


def _read_file(unpacked: Path, contents: BagContents, file: Path) -> None:
    storage = _storage(file)
    if storage not in (".db3", ".bag"):
        _read_mcap(unpacked, contents)
        return
    reader: Any = Ros1Reader(unpacked) if storage == ".bag" else Sqlite3Reader(unpacked)
    reader.open()
    try:
        wanted = []
        for connection in reader.connections:
            contents.types[connection.topic] = _full_type(connection.msgtype)
            if contents.is_wanted(connection.topic):
                wanted.append(connection)
        # With an empty list of connections, the reader would read all topics.
        for connection, logged_ns, data in reader.messages(wanted) if wanted else ():
            encoding = getattr(connection.ext, "serialization_format", "ros1")
            contents.add(connection.topic, connection.msgtype, encoding, logged_ns, bytes(data))
    finally:
        reader.close()


def _read_mcap(file: Path, contents: BagContents) -> None:
    # In MCAP, schema id 0 means "no schema".
    schemas = {0: ""}
    channels: dict[int, Channel] = {}
    for record in complete_records(file):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record
            contents.types[record.topic] = _full_type(schemas.get(record.schema_id, ""))
        elif isinstance(record, Message) and record.channel_id in channels:
            channel = channels[record.channel_id]
            kind = schemas.get(channel.schema_id, "")
            contents.add(
                channel.topic, kind, channel.message_encoding, record.log_time, record.data
            )
