"""Repairs a recording that was cut or damaged: writes all complete messages to a new MCAP file with an
index."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from pipeline.errors import SourceError
from pipeline.io.atomic_files import write_beside
from pipeline.io.readers.mcap_file import McapFile


@dataclass(frozen=True, slots=True)
class Mended:
    """Result of a repair.

    Attributes:
        messages: Number of messages in the new file.
        losses: Parts that are lost, by reason.
    """

    messages: int
    losses: dict[str, int]


def mend(path: Path, out: Path) -> Mended:
    """Write all complete messages of a recording to a new file, which appears when it is complete; return
    what was written and lost.

    Args:
        path: The recording, which does not change.
        out: The new file.

    Raises:
        SourceError: It cannot be read, is not an MCAP file, or has no complete message.
        StemmapError: The new file cannot be written.
    """
    with closing(McapFile(path)) as recording:
        lost, written = Counter[str](), 0
        with write_beside(out) as partial, partial.open("wb") as target:
            writer = Writer(target, compression=CompressionType.LZ4)
            writer.start(profile="ros2", library="stemmap")
            schemas, channels = {0: 0}, dict[int, int]()
            for record in recording.whole_records():
                match record:
                    case Schema(id=known) if known not in schemas:
                        schemas[known] = writer.register_schema(record.name, record.encoding, record.data)
                    case Channel(id=known) if known not in channels and record.schema_id in schemas:
                        channels[known] = writer.register_channel(
                            record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                        )
                    case Message(channel_id=known) if known in channels:
                        writer.add_message(
                            channels[known], record.log_time, record.data, record.publish_time,
                            record.sequence,
                        )  # fmt: skip
                        written += 1
                    case Message():
                        lost["messages of an unknown topic"] += 1
                    case Attachment():
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
            if not written:
                raise SourceError("nothing in the recording is whole", where=str(path))
            writer.finish()
        return Mended(written, {**recording.damage, **lost})
