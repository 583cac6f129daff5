"""A writer of MCAP files that puts the messages in the order of the recorder's clock, some of them backfilled."""

import random
from typing import Any

from mcap.writer import Writer

BACKFILL_SHARE = 0.02
MAX_BACKFILL_NS = 5_000_000_000


class SortedWriter(Writer):
    """Sorts by log time. A few messages come up to 5 s late, as backfilled ones do."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._waiting: list[tuple[int, int, int, bytes, int]] = []
        self._chance = random.Random(31)

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0) -> None:
        """Keep a message until the end."""
        if self._chance.random() < BACKFILL_SHARE:
            log_time += self._chance.randrange(MAX_BACKFILL_NS)
        self._waiting.append((log_time, channel_id, publish_time, data, sequence))

    def finish(self) -> None:
        """Write all messages, and the end of the file."""
        for log_time, channel_id, publish_time, data, sequence in sorted(self._waiting, key=lambda each: each[0]):
            super().add_message(channel_id, log_time, data, publish_time, sequence)
        super().finish()  # type: ignore[no-untyped-call]  # as half of its methods
