"""Convert recordings of any kind to Parquet files or ROS 2 bags, one per log.

Time stamps are kept. Only the columns and channels of a log are converted; the other contents of a
bag (references, events) are not.
"""

import io
import re
from pathlib import Path

import numpy as np

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS
from softfin.core.quantities import Log
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.names import RESERVED
from softfin.data.recordings import open_logs
from softfin.storage import artifact as artifacts
from softfin.storage.bag.messages import (
    CHANNEL_TOPICS,
    COMMAND,
    CURRENT,
    JOINT,
    SECOND_NS,
    WRENCH,
    BagWriter,
)
from softfin.storage.log_file import write_log


def convert(
    source: Path,
    out: Path,
    config: ImportConfig | None = None,
    *,
    ignore_errors: bool = False,
    overwrite: bool = False,
) -> JsonObject:
    """Write each log to `out`; several logs are numbered ``NAME-1``, ``NAME-2`` and so on.

    Raises LogError if the logs have errors, unless `ignore_errors` is set.
    """
    if out.suffix not in (".mcap", ".parquet"):
        raise ConfigurationError(
            f"--out {out}: must end in .mcap or .parquet, which sets the file type"
        )
    artifacts.check_writable(out)
    opened = open_logs(source, config or ImportConfig())
    opened.check_issues(str(source), ignore_errors)
    files = [out]
    if len(opened.logs) > 1:
        numbers = range(1, len(opened.logs) + 1)
        files = [out.with_name(f"{out.stem}-{number}{out.suffix}") for number in numbers]
    for file in files:
        artifacts.check_file(file, overwrite)
    for one, file in zip(opened.logs, files, strict=True):
        # Opened logs start at 0; write the time of the recording's clock.
        reading = one.log.reading
        log = one.log._replace(
            reading=reading._replace(time=one.start_s + np.asarray(reading.time, np.float64))
        )
        if out.suffix == ".parquet":
            write_log(file, log)
        else:
            artifacts.write_file(file, encode_bag(log, one.name))
    rows = sum(one.log.rows for one in opened.logs)
    return {"files": [str(file) for file in files], "rows": rows, **opened.inspection.summary()}


def encode_bag(log: Log, source: str) -> bytes:
    """Encode a log as a bag; raises LogError, which names `source`, for times before 1970 and for
    channels that would be lost."""
    time = np.asarray(log.reading.time, np.float64)
    if len(time) and time.min() < 0:
        raise LogError(
            f"{source}: time_s starts at {time.min():g} s; a bag cannot store negative times; add "
            "a constant to time_s"
        )
    names = _channel_topics(log, source)
    channels = dict(log.channels)
    # As from a sensor, a load that was not measured is zero.
    loads = [channels.pop(name, np.zeros(len(time))) for name in LOAD_CHANNELS]
    topics = {names[channel]: values for channel, values in channels.items()}
    sink = io.BytesIO()
    bag = BagWriter(sink, [topic for topic in topics if topic != CURRENT])
    rows = np.stack([*log.columns, *loads, *topics.values()], axis=1)
    for seconds, row in zip(time.tolist(), rows.tolist(), strict=True):
        stamp = round(seconds * SECOND_NS)
        bag.write(COMMAND, stamp, row[:2])
        bag.write(JOINT, stamp, row[2:4])
        bag.write(WRENCH, stamp, row[4:10])
        for topic, value in zip(topics, row[10:], strict=True):
            bag.write(topic, stamp, [value])
    bag.finish()
    return sink.getvalue()


def _channel_topics(log: Log, source: str) -> dict[str, str]:
    """Return the topic of each channel; raises LogError for channels that would be lost."""
    channels: dict[str, str] = {}
    for channel in log.channels:
        # ROS allows no other characters in the name of a topic.
        name = re.sub(r"[^A-Za-z0-9_]", "_", channel)
        if name in RESERVED:
            raise LogError(
                f"{source}: channel {channel!r}: in a bag, every log has {name}; rename it"
            )
        if name in channels:
            raise LogError(
                f"{source}: channels {channels[name]!r} and {channel!r} would both be {name} in a "
                "bag; rename one of them"
            )
        channels[name] = channel
    topics = {channel: CHANNEL_TOPICS + name for name, channel in channels.items()}
    return topics | {CURRENT_CHANNEL: CURRENT}
