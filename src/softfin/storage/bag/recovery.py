"""A bag that was cut off or damaged in, a whole one out, with every message that can be read; the original stays."""

from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.records import Channel, Message, Schema

from softfin.core.errors import LogError
from softfin.storage import artifact as artifacts
from softfin.storage.bag.messages import start_writer
from softfin.storage.bag.scan import Damage, scan
from softfin.storage.paths import check_recoverable


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
        damages = [{"byte": one.start, "bytes": one.length, "reason": one.reason} for one in self.damages]
        return {**self._asdict(), "damages": damages}


def recovered_path(path: Path) -> Path:
    """Path that is written unless another is given: ``run.recovered.mcap`` beside ``run.mcap``."""
    return path.with_name(f"{path.stem}.recovered.mcap")


def recover(path: Path, out: Path, overwrite: bool = False) -> Recovery:
    """Save what can be read; raises LogError where nothing can, or `out` exists."""
    check_recoverable(path)
    if out.exists() and (not overwrite or out.is_dir() or out.samefile(path)):
        raise LogError(f"{out}: exists already; give another --out")
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts, times, damages = Counter[int](), [2**64, 0], list[Damage]()
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
                times = [min(times[0], item.log_time), max(times[1], item.log_time)]
    messages = Counter[str]()
    for number in sorted(channels.keys() & counts):
        messages[channels[number].topic] += counts[number]
    orphans = sum(count for number, count in counts.items() if number not in channels)
    if orphans:
        damages.append(Damage(0, 0, f"{orphans:,} messages whose topic is not known"))
    recovery = Recovery(not damages, dict(messages), max(0, times[1] - times[0]) / 1e9, orphans, tuple(damages))
    if damages and not messages:
        reason = damages[0].reason
        raise LogError(f"{path}: no message in it can be read ({reason}); copy it again from where it was recorded")
    if damages:
        artifacts.write_file(out, lambda file: _copy(path, file, schemas, channels))
    return recovery


def _copy(path: Path, file: BinaryIO, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
    writer = start_writer(file)
    registered = {0: 0} | {
        number: writer.register_schema(one.name, one.encoding, one.data) for number, one in schemas.items()
    }
    written = {
        number: writer.register_channel(one.topic, one.message_encoding, registered.get(one.schema_id, 0), one.metadata)
        for number, one in channels.items()
    }
    for item in scan(path):
        if isinstance(item, Message) and item.channel_id in written:
            writer.add_message(written[item.channel_id], item.log_time, item.data, item.publish_time, item.sequence)
    writer.finish()
