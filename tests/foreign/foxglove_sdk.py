"""`python foxglove_sdk.py FROM TO`: the messages of an MCAP file, written again by foxglove-sdk."""

from __future__ import annotations

import sys
from pathlib import Path

import foxglove
from mcap.reader import make_reader

with Path(sys.argv[1]).open("rb") as stream, foxglove.open_mcap(sys.argv[2]):
    channels: dict[str, foxglove.Channel] = {}
    for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
        if channel.topic not in channels:
            described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            channels[channel.topic] = foxglove.Channel(
                channel.topic, schema=described, message_encoding=channel.message_encoding
            )
        channels[channel.topic].log(message.data, log_time=message.log_time)
