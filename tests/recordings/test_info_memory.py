"""`recordings info` of a long recording: its memory does not grow with the robot states."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import msgspec

from recordings.schema.messages import Stamps
from recordings.writer import RecordingWriter
from tests.recordings.small_recording import START_NS, make_info, make_state

STATES = 200_000
LIMIT_MIB = 128
_PROGRAM = """
import json, re, sys
from pathlib import Path
from recordings.info import recording_info
from recordings.reader import open_recording
facts = recording_info(open_recording(Path(sys.argv[1])))
peak_kib = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
print(json.dumps([facts, int(peak_kib) / 1024]))  # rusage would count what the parent had before exec
"""


def test_info_of_many_states_stays_small(tmp_path: Path) -> None:
    state = make_state(0)
    with RecordingWriter(tmp_path / "long.mcap", make_info()) as writer:
        for count in range(STATES):
            now_ns = count * 2_000_000
            stamps = Stamps(now_ns + 7_000_000_000, START_NS + now_ns, 50 + count * 0.002)
            writer.robot_state(msgspec.structs.replace(state, stamps=stamps))
        path = writer.finish()
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    facts, peak_mib = json.loads(done.stdout)
    assert facts["robot_states"]["count"] == STATES
    assert peak_mib < LIMIT_MIB
