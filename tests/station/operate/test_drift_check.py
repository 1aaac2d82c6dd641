"""What `station check` says before its poses take the place of a plan."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any, cast

import pytest

from station.cell.status import PoseStatus, SessionStatus, StationStatus
from station.cli import session as cli_session
from station.operate.drift_check import never_run
from station.protocol.client import Client


class FakeClient:
    def __init__(self, *attempts: int) -> None:
        poses = tuple(PoseStatus(i, f"p{i}", attempt=attempt) for i, attempt in enumerate(attempts))
        self.status = StationStatus(session=SessionStatus(poses=poses))
        self.asked: list[str] = []

    async def statuses(self) -> AsyncIterator[StationStatus]:
        yield self.status

    async def request(self, verb: str, **args: Any) -> None:
        self.asked.append(verb)


@pytest.mark.parametrize(("attempts", "lost"), [((), 0), ((0, 0, 0), 3), ((1, 0, 0), 0)])
async def test_a_plan_that_was_never_run_is_named_before_it_is_replaced(
    attempts: tuple[int, ...], lost: int, capsys: pytest.CaptureFixture[str]
) -> None:
    client = FakeClient(*attempts)
    assert never_run(client.status) == lost
    await cli_session._make(cast(Client, client), 8)
    assert client.asked == ["make_plan"]
    words = " ".join(capsys.readouterr().err.split())
    assert (f"loaded plan of {lost} poses, which was never run" in words) is bool(lost)
