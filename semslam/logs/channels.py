"""Channels of a log: from schema and channel records to `Channel` objects without ids."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from semslam.logs.records import ChannelRecord, Schema, parse_channel, parse_schema


@dataclass(frozen=True)
class Channel:
    """A stream of messages: choose it by topic and schema name.

    One topic may have several channels (other encodings, other publishers). Records of equal content are one `Channel`
    object within a reader, whatever ids their files gave them.
    """

    topic: str
    schema_name: str
    """Empty where the channel has no schema."""
    schema_encoding: str
    schema_data: bytes = field(repr=False)
    message_encoding: str
    metadata: Mapping[str, str] = field(repr=False)

    def __hash__(self) -> int:
        return hash((self.topic, self.schema_name, self.message_encoding, self.schema_encoding))


_NO_SCHEMA = Schema("", "", b"")


class ChannelPool:
    """Makes each channel once, however often, and in however many files, its records are repeated."""

    def __init__(self) -> None:
        self._schemas: dict[bytes, tuple[int, Schema]] = {}
        self._records: dict[bytes, ChannelRecord] = {}
        self._channels: dict[tuple[object, ...], Channel] = {}

    def schema(self, body: bytes) -> tuple[int, Schema]:
        """(id, schema) of a record's body; parsed once, since some writers repeat it in every chunk."""
        known = self._schemas.get(body)
        if known is None:
            known = self._schemas[body] = parse_schema(body)
        return known

    def record(self, body: bytes) -> ChannelRecord:
        known = self._records.get(body)
        if known is None:
            known = self._records[body] = parse_channel(body)
        return known

    def channel(self, record: ChannelRecord, schema: Schema) -> Channel:
        key = (record.topic, record.message_encoding, tuple(sorted(record.metadata.items())), schema)
        known = self._channels.get(key)
        if known is None:
            parts = (record.topic, schema.name, schema.encoding, schema.data, record.message_encoding, record.metadata)
            known = self._channels[key] = Channel(*parts)
        return known


class Definitions:
    """What the ids of one file mean, as far as its surviving records tell.

    A record under a checksum beats one without. The specification forbids giving an id two meanings; where a file does
    so all the same, and both records are equally trustworthy, the id is ambiguous: it is understood in the chunks that
    define it themselves and nowhere else, so that no message is read as something it is not.
    """

    def __init__(self, pool: ChannelPool) -> None:
        self.pool = pool
        self._schemas: dict[int, tuple[Schema, bool]] = {}
        self._channels: dict[int, tuple[Channel, bool]] = {}
        self._ambiguous: set[int] = set()
        self._waiting: dict[int, tuple[ChannelRecord, bool]] = {}

    def schema(self, schema_id: int) -> Schema | None:
        """None where no record with this id survived. Id 0 is the empty schema."""
        if schema_id == 0:
            return _NO_SCHEMA
        known = self._schemas.get(schema_id)
        return known[0] if known else None

    def channel(self, channel_id: int) -> Channel | None:
        """None where no record with this id, or none of its schema, survived, or where its meaning is ambiguous."""
        if channel_id in self._ambiguous:
            return None
        known = self._channels.get(channel_id) or self._late_binding(channel_id)
        return known[0] if known else None

    def ids(self) -> list[int]:
        """Every channel id that has a meaning, ascending."""
        found = self._channels.keys() | self._waiting.keys()
        return sorted(channel_id for channel_id in found if self.channel(channel_id) is not None)

    def offer_schema(self, schema_id: int, schema: Schema, trusted: bool) -> None:
        known = self._schemas.get(schema_id)
        if known is None or (trusted and not known[1]):
            self._schemas[schema_id] = (schema, trusted)

    def offer_channel(self, channel_id: int, channel: Channel, trusted: bool) -> None:
        known = self._channels.get(channel_id)
        if known is None or (trusted and not known[1]):
            self._channels[channel_id] = (channel, trusted)
        elif channel != known[0] and trusted == known[1]:
            self._ambiguous.add(channel_id)

    def wait_for_schema(self, record: ChannelRecord, trusted: bool) -> None:
        """Keep a channel whose schema has not been seen: the summary may still bring it."""
        self._waiting.setdefault(record.id, (record, trusted))

    def _late_binding(self, channel_id: int) -> tuple[Channel, bool] | None:
        record, trusted = self._waiting.get(channel_id, (None, False))
        schema = self.schema(record.schema_id) if record else None
        if record is None or schema is None:
            return None
        self.offer_channel(channel_id, self.pool.channel(record, schema), trusted)
        return self._channels[channel_id]


class Scope:
    """The definitions as seen inside one chunk (or one summary): its own records first, then the file's."""

    def __init__(self, definitions: Definitions, trusted: bool) -> None:
        self._definitions = definitions
        self._trusted = trusted
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def add_schema(self, body: bytes) -> None:
        schema_id, schema = self._definitions.pool.schema(body)
        self._schemas[schema_id] = schema
        self._definitions.offer_schema(schema_id, schema, self._trusted)

    def add_channel(self, body: bytes) -> int:
        """The channel's id."""
        record = self._definitions.pool.record(body)
        schema = self._schemas.get(record.schema_id) or self._definitions.schema(record.schema_id)
        if schema is None:
            self._definitions.wait_for_schema(record, self._trusted)
        else:
            channel = self._channels[record.id] = self._definitions.pool.channel(record, schema)
            self._definitions.offer_channel(record.id, channel, self._trusted)
        return record.id

    def channel(self, channel_id: int) -> Channel | None:
        return self._channels.get(channel_id) or self._definitions.channel(channel_id)
