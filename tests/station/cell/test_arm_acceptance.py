"""What an acceptance holds for, and what makes it void."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from station.cell.arm_acceptance import (
    ACCEPTANCE_NAME,
    Acceptance,
    ArmSubject,
    not_accepted,
    read_acceptance,
    write_acceptance,
)

SUBJECT = ArmSubject("real", "UR10e", "2024", "5.11.1", (1.2, 0.0, 0.0, 0.05), "ur_rtde")
PASSED = Acceptance(SUBJECT, True, 0.25, 1, "anna", ())


def test_it_holds_for_the_arm_that_was_tested(tmp_path: Path) -> None:
    write_acceptance(tmp_path, PASSED)
    assert read_acceptance(tmp_path) == PASSED
    assert not_accepted(read_acceptance(tmp_path), SUBJECT) == ""


@pytest.mark.parametrize(
    ("change", "void"),
    [
        ({"serial": "2025"}, True),
        ({"controller_version": "5.12.0"}, True),
        ({"payload": (1.3, 0.0, 0.0, 0.05)}, True),
        ({"payload": (1.2, 0.0, 0.02, 0.05)}, True),
        ({"payload": ()}, True),
        ({"payload": (1.2001, 0.0, 0.0001, 0.05)}, False),  # as RTDE rounds it
        ({"control_path": "script"}, True),
        ({"source": "simulated"}, True),
    ],
)
def test_another_arm_firmware_payload_or_path_makes_it_void(change: dict[str, object], void: bool) -> None:
    assert bool(not_accepted(PASSED, msgspec.structs.replace(SUBJECT, **change))) is void


def test_it_holds_up_to_the_speed_that_passed() -> None:
    slow = msgspec.structs.replace(PASSED, speed_m_s=0.05)
    assert not_accepted(slow, SUBJECT, 0.25) and not not_accepted(slow, SUBJECT, 0.05)
    assert not not_accepted(PASSED, SUBJECT, 0.25)
    assert "--speed 0.25" in not_accepted(slow, SUBJECT, 0.25), "the speed that is missing, to be typed"


def test_never_tested_failed_and_unreadable_are_not_accepted(tmp_path: Path) -> None:
    assert not_accepted(read_acceptance(tmp_path), SUBJECT)
    assert not_accepted(msgspec.structs.replace(PASSED, accepted=False), SUBJECT)
    (tmp_path / ACCEPTANCE_NAME).write_text('{"accepted": true}')
    assert not_accepted(read_acceptance(tmp_path), SUBJECT)


def test_a_file_of_the_eight_ways_and_stages_is_still_read(tmp_path: Path) -> None:
    figure = {"name": "moved", "value": 0.0, "unit": "rad", "limit": 0.001, "source": "", "least": False}
    result = {"way": "slider", "speed_m_s": 0.03, "figures": [figure], "repeated": 0}
    old = msgspec.to_builtins(PASSED) | {"results": [result], "report": "/var/lib/station/acceptance.html"}
    (tmp_path / ACCEPTANCE_NAME).write_bytes(msgspec.json.encode(old))
    assert not not_accepted(read_acceptance(tmp_path), SUBJECT, 0.25)
