"""The points of each curve that TensorBoard reads from a folder."""

from __future__ import annotations

import struct
from collections import defaultdict

from tensorboardX.proto.event_pb2 import Event


def curves(folder):
    """Return {name: [(step, value)]} of the files in a folder, in their order."""
    results = defaultdict(list)
    for path in sorted(folder.glob("events.out.tfevents.*")):
        data, place = path.read_bytes(), 0
        while place < len(data):  # length, checksum, event, checksum
            (length,) = struct.unpack_from("<Q", data, place)
            event = Event.FromString(data[place + 12 : place + 12 + length])
            place += 16 + length
            for one in event.summary.value:
                results[one.tag].append((event.step, one.simple_value))
    return dict(results)
