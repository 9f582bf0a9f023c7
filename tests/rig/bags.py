"""What the tests ask of a bag, by a reader that is not softfin's."""

from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def events_of(path: Path) -> list[str]:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            each.decoded_message.data
            for each in reader.iter_decoded_messages(topics=["/fin/events"])
        ]


def counts_of(path: Path) -> Counter[str]:
    """Messages by topic."""
    with path.open("rb") as file:
        return Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())


def stack_commands(path: Path) -> list[tuple[float, float]]:
    """Time [s] and angle [rad] of each."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            (each.message.log_time / 1e9, each.decoded_message.position[0])
            for each in reader.iter_decoded_messages(topics=["/fin/command"])
        ]
