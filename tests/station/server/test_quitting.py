"""`station quit` ends a daemon that its user started by hand, and only where nothing is left to do."""

from __future__ import annotations

import os
from collections.abc import Callable

import msgspec
import pytest

from station.cell.status import StationState as S
from station.protocol.stop_client import ArmMotion
from station.protocol.verbs import Freedrive
from station.server.approval import Peer
from station.server.dispatch import SessionDispatcher
from station.server.quitting import require_nothing_left, way_of_service
from tests.codes import raises
from tests.station.session_rig import Rig

ME = os.getuid()


class Daemon:
    """A rig's dispatcher, and whether its end was begun."""

    def __init__(self, rig: Rig, service: str = "") -> None:
        self.ended = 0
        self._dispatcher = SessionDispatcher(rig.session, end=self._end, service=service)

    def _end(self) -> None:
        self.ended += 1

    async def quit(self, client: int = 1, user: int = ME) -> None:
        await self._dispatcher.handle(Peer(client, 4711, user), "quit", msgspec.Raw(b"{}"))


async def test_a_daemon_at_rest_is_ended_by_its_user_and_by_root(rig: Rig) -> None:
    daemon = Daemon(rig)
    await daemon.quit()
    await daemon.quit(user=0)
    assert daemon.ended == 2
    assert [event.level for event in rig.told("quit")] == ["info"] * 2


async def test_a_daemon_of_a_service_or_of_another_user_is_not_ended(rig: Rig) -> None:
    await rig.session.release(1)
    for daemon, user, code in (
        (Daemon(rig, "systemctl stop station.service"), ME, "quit-service"),
        (Daemon(rig, "systemctl stop station.service"), 0, "quit-service"),
        (Daemon(rig), ME + 1, "quit-other-user"),
    ):
        with raises(code) as refused:
            await daemon.quit(user=user)
        assert not daemon.ended
        assert refused.value.remedy
    assert rig.session.store.status.lease.client_id is None, "control is not given for what is refused"


async def test_only_who_has_control_ends_it(rig: Rig) -> None:
    daemon = Daemon(rig)
    with raises("control-held"):
        await daemon.quit(client=2)
    await rig.session.release(1)
    await daemon.quit(client=2)
    assert daemon.ended == 1


@pytest.mark.parametrize("state", sorted(set(S) - {S.IDLE, S.PAUSED, S.DISCONNECTED}))
async def test_a_station_that_works_or_is_latched_says_what_to_do_first(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, state: S
) -> None:
    monkeypatch.setattr(rig.session.supervisor, "_watch_link", lambda: None)  # it would correct the state
    store = rig.session.store
    calm = store.status
    store.status = msgspec.structs.replace(calm, state=state)
    daemon = Daemon(rig)
    with raises("wrong-state") as refused:
        await daemon.quit()
    assert refused.value.values["state"] == state and refused.value.remedy
    assert not daemon.ended
    store.status = calm


async def test_a_session_that_is_not_finished_is_named(rig: Rig) -> None:
    daemon = Daemon(rig)
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    with raises("quit-session-open") as refused:
        await daemon.quit()
    assert refused.value.values["session"] == rig.session.store.status.session.name
    assert not daemon.ended
    await rig.session.finish(1)
    await rig.until(S.IDLE)
    await daemon.quit()
    assert daemon.ended == 1


async def test_capture_by_hand_is_ended_first(rig: Rig) -> None:
    daemon = Daemon(rig)
    await rig.session.switch_free_drive(1, True)
    with raises("wrong-state"):
        await daemon.quit()
    rig.session.permit(Freedrive, 1)
    assert not daemon.ended


async def test_what_a_person_has_not_acknowledged_keeps_it(rig: Rig) -> None:
    """Also without a change of state: safety held the arm while it rested."""
    daemon = Daemon(rig)
    rig.session.latch.hold("A protective stop.", "protective-stop")
    with raises("quit-latched") as refused:
        await daemon.quit()
    assert "station acknowledge" in refused.value.remedy and not daemon.ended
    await rig.session.acknowledge("anna")
    await daemon.quit()
    assert daemon.ended == 1


async def test_an_arm_that_moves_without_the_station_keeps_it(rig: Rig) -> None:
    with raises("arm-moves"):
        require_nothing_left(rig.session, ArmMotion.MOVES)
    for motion in (ArmMotion.RESTS, ArmMotion.UNKNOWN):
        require_nothing_left(rig.session, motion)


@pytest.mark.parametrize(
    ("group", "notify", "way"),
    [
        ("0::/system.slice/station.service", "/run/systemd/notify", "systemctl stop station.service"),
        ("0::/system.slice/calibrate.service", "", "systemctl stop calibrate.service"),
        (
            "0::/user.slice/user-1000.slice/user@1000.service/app.slice/cell.service",
            "/run/user/1000/systemd/notify",
            "systemctl --user stop cell.service",
        ),
        # A terminal that a desktop started as a service of its user.
        ("0::/user.slice/user-1000.slice/user@1000.service/app.slice/app-konsole@1.service", "", ""),
        ("0::/user.slice/user-1000.slice/session-2.scope", "", ""),
    ],
)
def test_a_service_is_known_by_its_group_and_its_manager(
    monkeypatch: pytest.MonkeyPatch, group: str, notify: str, way: str
) -> None:
    read: Callable[..., str] = lambda path, **_: f"{group}\n"  # noqa: E731
    monkeypatch.setattr("pathlib.Path.read_text", read)
    assert way_of_service(4711, notify) == way
