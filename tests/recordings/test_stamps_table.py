"""The clocks of many messages at once are those that each message holds."""

from __future__ import annotations

from pathlib import Path

import msgspec
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recordings.reader import open_recording
from recordings.schema.definitions import encode
from recordings.schema.messages import Stamps
from recordings.schema.topics import Topic
from recordings.streams import stamps_tables
from tests.recordings.crafted import Counts, channel, chunk, message, schema, sealed, session_metadata
from tests.recordings.small_recording import make_state

times = st.one_of(st.just(0), st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**40))
stamps = st.builds(Stamps, times, times, st.floats(allow_nan=False), times)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(stamps, min_size=1, max_size=40), st.booleans(), st.booleans())
def test_every_stamp_comes_back(tmp_path: Path, wanted: list[Stamps], packed: bool, reordered: bool) -> None:
    states = [msgspec.structs.replace(make_state(0), stamps=value) for value in wanted]
    encoded = [encode(state) for state in states]
    if reordered:  # the first field behind the others: allowed, and slow
        encoded[0] = encoded[0][2 + encoded[0][1] :] + encoded[0][: 2 + encoded[0][1]]
    declared = schema(1, Topic.ROBOT_STATE) + channel(1, 1, "/robot/state")
    records = declared + b"".join(message(1, data) for data in encoded)
    stored = {"compression": "zstd", "stored": zstandard.compress(records)} if packed else {}
    counts = Counts(messages=len(states), chunks=1, per_channel={1: len(states)})
    path = tmp_path / "a.mcap"
    path.write_bytes(sealed(session_metadata() + chunk(records, **stored), counts))
    segment = open_recording(path).segments[0]
    assert [state.stamps for state in segment.robot_states()] == wanted
    found = [row for table in stamps_tables(segment, Topic.ROBOT_STATE) for row in table.tolist()]
    assert found == [(s.host_monotonic_ns, s.controller_s, s.device_ns) for s in wanted]
