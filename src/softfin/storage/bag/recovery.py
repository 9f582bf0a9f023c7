"""A bag that was cut off or damaged in, a whole one out, with every message that can be read; the original stays."""

from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.records import Channel, Message, Schema

from softfin.core.errors import LogError
from softfin.storage import artifact as artifacts
from softfin.storage.bag.messages import start_writer
from softfin.storage.bag.records import Damage, scan


class Recovery(NamedTuple):
    """Result of a recovery."""

    whole: bool
    """Whether the bag was whole, so that nothing was written."""
    messages: dict[str, int]
    """Number of messages saved, or present, by topic."""
    seconds: float
    """Time from the first to the last message [s]."""
    orphans: int
    """Number of messages whose topic is not known any more: they are not saved."""
    damages: tuple[Damage, ...]
    """Parts that could not be read."""

    def to_dict(self) -> dict[str, Any]:
        """Recovery for JSON."""
        return self._asdict() | {
            "damages": [{"byte": one.start, "bytes": one.length, "reason": one.reason} for one in self.damages]
        }


def recovered_path(path: Path) -> Path:
    """Path that is written unless another is given: ``run.recovered.mcap`` beside ``run.mcap``."""
    return path.with_name(f"{path.stem}.recovered.mcap")


def recover(path: Path, out: Path, overwrite: bool = False) -> Recovery:
    """Save what can be read; raises LogError where nothing can, ArtifactError where `out` exists."""
    artifacts.check_file(out, overwrite and out.resolve() != path.resolve())
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts, damages = Counter[int](), list[Damage]()
    first, last = 2**64, 0
    # Definitions may stand behind their messages where the first chunk is lost: the index repeats them.
    for item in scan(path):
        match item:
            case Damage():
                damages.append(item)
            case Schema():
                schemas.setdefault(item.id, item)
            case Channel():
                channels.setdefault(item.id, item)
            case Message():
                counts[item.channel_id] += 1
                first, last = min(first, item.log_time), max(last, item.log_time)
    messages = Counter[str]()
    for number in sorted(channels.keys() & counts):
        messages[channels[number].topic] += counts[number]
    orphans = counts.total() - messages.total()
    if orphans:
        damages.append(Damage(0, 0, f"{orphans:,} messages whose topic is not known"))
    if damages and not messages:
        reason = damages[0].reason
        raise LogError(f"{path}: no message in it can be read ({reason}); copy it again from where it was recorded")

    def copy(file: BinaryIO) -> None:
        writer, registered, written = start_writer(file), {0: 0}, {}
        for number, schema in schemas.items():
            registered[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
        for number, channel in channels.items():
            kind = registered.get(channel.schema_id, 0)
            written[number] = writer.register_channel(channel.topic, channel.message_encoding, kind, channel.metadata)
        for one in scan(path):
            if isinstance(one, Message) and one.channel_id in written:
                writer.add_message(written[one.channel_id], one.log_time, one.data, one.publish_time, one.sequence)
        writer.finish()

    if damages:
        artifacts.write_file(out, copy)
    return Recovery(not damages, dict(messages), max(0, last - first) / 1e9, orphans, tuple(damages))
