"""The daemon's door to results: clients install, undo and withdraw by it, and all hear of every change."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.folders import calibrations_folder, validity_of
from calibrate.files.install import install, installed_calibration, rollback, withdraw
from calibrate.files.touch import Touch
from calibrate.files.versions import read_log
from calibrate.results import Gate
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.analysis.pool import Workers
from station.analysis.result_files import start_reader
from station.cell.socket_folder import user_name
from station.cell.status import StationState
from station.protocol.results import Kept, Result
from station.server.approval import Peer, Process
from station.server.dispatch import SessionDispatcher
from tests.codes import raises
from tests.patience import until
from tests.station.calibrated_cell import calibration_of
from tests.station.session_rig import TRUTH, NewRig, Rig

ME = os.getuid()
GOOD = calibration_of(
    TRUTH, RobotIdentity(serial="1", model="UR10"), CameraIdentity(serial="2", model="camera")
)
FAILING = msgspec.structs.replace(
    GOOD,
    created="2026-03-01T00:00:00+00:00",
    quality=msgspec.structs.replace(GOOD.quality, gates=(Gate("views", False, 3.0, 8.0, "3 of 8 views"),)),
)


class Client:
    """A client of a rig's daemon, at a terminal or without one."""

    def __init__(self, rig: Rig, number: int = 1, terminal: str = "pts/3") -> None:
        def see(pid: int) -> Process:
            return Process(ME, 77, terminal)

        self._dispatcher = SessionDispatcher(rig.session, see)
        self._peer = Peer(number, 4711, ME)

    async def ask(self, verb: str, **args: object) -> object:
        return await self._dispatcher.handle(self._peer, verb, msgspec.Raw(msgspec.json.encode(args)))

    async def result(self, session: str = "") -> Result:
        return msgspec.convert((await self.ask("result", session=session)).result, Result)

    async def sessions(self) -> list[Kept]:
        return msgspec.convert((await self.ask("sessions")).sessions, list[Kept])


Solved = Callable[[str], Path]


@pytest.fixture
def solved(rig: Rig) -> Solved:
    """Make a solved session below the root of the rig's daemon; return its calibration file."""
    count = 0

    def make(name: str) -> Path:
        nonlocal count
        count += 1
        folder = rig.session.context.root / "sessions" / name
        folder.mkdir(parents=True)
        provenance = msgspec.structs.replace(GOOD.provenance, session=name)
        created = f"2026-01-0{count}T00:00:00+00:00"
        made = msgspec.structs.replace(GOOD, created=created, provenance=provenance)
        write_calibration(made, folder / "calibration.yaml")
        return folder / "calibration.yaml"

    return make


async def test_what_a_client_installs_is_what_the_command_installs_by_the_clients_name(
    rig: Rig, solved: Solved
) -> None:
    path, client, root = solved("s-1"), Client(rig), rig.session.context.root
    made = await client.ask("install", session="s-1")
    assert made.version == 1 and made.validity == "valid"
    assert rig.session.store.status.results.installed == 1, "the status tells it before the answer does"
    assert installed_calibration(root) == read_calibration(path)
    assert [entry.who for entry in read_log(root)] == [user_name(ME)]
    found = await client.result()
    assert found.installed and found.session == "s-1" and found.state.version == 1
    assert [(kept.session.name, kept.word) for kept in await client.sessions()] == [("s-1", "INSTALLED")]


async def test_undoing_goes_back_and_withdrawing_ends_the_use(rig: Rig, solved: Solved) -> None:
    client, folder = Client(rig), calibrations_folder(rig.session.context.root)
    for name in ("s-1", "s-2"):
        solved(name)
        await client.ask("install", session=name)
    assert (await client.result("s-2")).state.before.session == "s-1"
    made = await client.ask("rollback", seen=2)
    assert (made.version, made.validity) == (1, "unverified")
    assert (await client.result("s-2")).became == "installed before"
    with raises("reason-too-short"):
        await client.ask("withdraw", reason="x", seen=1)
    await client.ask("withdraw", reason="the bracket was loose", seen=1)
    validity = validity_of(folder, 1)
    assert (validity.state, validity.reason.text) == ("withdrawn", "the bracket was loose")
    assert validity.who == user_name(ME)
    assert rig.session.store.status.results.validity == "withdrawn"


@pytest.mark.parametrize("verb", ["rollback", "withdraw"])
async def test_what_a_person_did_not_see_installed_is_not_changed(
    rig: Rig, solved: Solved, verb: str
) -> None:
    """Another program installed meanwhile: the question was about something else."""
    client, root = Client(rig), rig.session.context.root
    for name in ("s-1", "s-2"):
        install(solved(name), root, cell="simulated")
    arguments = {"seen": 1} | ({"reason": "the bracket was loose"} if verb == "withdraw" else {})
    with raises("other-version"):
        await client.ask(verb, **arguments)
    assert validity_of(calibrations_folder(root), 2).state == "valid"
    assert rig.session.store.status.results.installed in (None, 2)


async def test_every_change_by_a_command_is_told(rig: Rig, solved: Solved) -> None:
    """Each raises the number by which a screen knows that it must ask again."""
    root, store = rig.session.context.root, rig.session.store
    first = solved("s-1")
    await rig.session.results.look()
    changes = store.status.results.changes

    async def told(installed: int, validity: str) -> None:
        nonlocal changes
        await rig.session.results.look()
        now = store.status.results
        assert (now.installed, now.validity) == (installed, validity) and now.changes > changes
        changes = now.changes

    install(first, root, cell="simulated")
    await told(1, "valid")
    second = solved("s-2")
    install(second, root, cell="simulated")
    await told(2, "valid")
    rollback(root)
    await told(1, "unverified")
    withdraw(root, "the bracket was loose")
    await told(1, "withdrawn")
    assert [event.values["validity"] for event in rig.told("calibration-changed")] == [
        "valid",
        "valid",
        "unverified",
        "withdrawn",
    ]
    assert rig.told("calibration-changed")[-1].level == "warning"
    await rig.session.results.look()
    assert store.status.results.changes == changes, "nothing changed"


async def test_the_daemon_looks_by_itself(rig: Rig, solved: Solved) -> None:
    path = solved("s-1")
    await rig.session.results.look()
    install(path, rig.session.context.root, cell="simulated")
    await until(lambda: rig.session.store.status.results.installed == 1)


async def test_a_failed_gate_is_installed_by_a_person_with_a_reason_only(
    new_rig: NewRig, tmp_path: Path
) -> None:
    """A program that has control gives none: a reason is a person's."""
    rig = await new_rig(with_plan=False, source="real")
    await rig.until(StationState.IDLE)
    folder = rig.session.context.root / "sessions" / "s-1"
    folder.mkdir(parents=True)
    write_calibration(msgspec.structs.replace(FAILING, source="real"), folder / "calibration.yaml")
    person, program = Client(rig), Client(rig, terminal="")
    with raises("gate-failed"):
        await person.ask("install", session="s-1")
    with raises("no-terminal"):
        await program.ask("install", session="s-1", override="measured with the tape")
    await person.ask("install", session="s-1", override="measured with the tape")
    override = installed_calibration(rig.session.context.root).override
    assert override is not None
    assert (override.reason, override.who) == ("measured with the tape", user_name(ME))


async def test_a_simulated_calibration_never_installs_on_a_real_cell(new_rig: NewRig) -> None:
    rig = await new_rig(with_plan=False, source="real")
    await rig.until(StationState.IDLE)
    folder = rig.session.context.root / "sessions" / "s-1"
    folder.mkdir(parents=True)
    write_calibration(GOOD, folder / "calibration.yaml")
    for override in ("", "measured with the tape"):
        with raises("other-cell"):
            await Client(rig).ask("install", session="s-1", override=override)


@pytest.mark.parametrize("name", ["../s-1", "..", ".", "/etc", "a\0b", "s-1/../../x"])
@pytest.mark.parametrize("verb", ["result", "install"])
async def test_a_session_is_named_and_never_a_path(rig: Rig, verb: str, name: str) -> None:
    with raises("no-such-session"):
        await Client(rig).ask(verb, session=name)


async def test_touches_go_into_the_file_and_the_installed_version(rig: Rig, solved: Solved) -> None:
    path, client, root = solved("s-1"), Client(rig), rig.session.context.root
    await client.ask("install", session="s-1")
    touch = Touch(0, (0.0, 0.0), (9.0, 0.0), (0.1, 0.1), "read from the arm", "somebody", "2026-01-01")
    noted = await client.ask("note_touches", session="s-1", touches=[msgspec.to_builtins(touch)])
    assert (noted.file, noted.version) == (str(path), 2)
    (kept,) = read_calibration(path).verification
    assert kept == msgspec.structs.replace(touch, who=user_name(ME)), "the daemon knows who it was"
    assert installed_calibration(root).verification == [kept]
    assert rig.session.store.status.results.validity == "in-doubt"
    noted = await client.ask("note_touches", session="", touches=[msgspec.to_builtins(touch)])
    assert (noted.file, noted.version) == ("", 3)
    with raises("wrong-arguments"):
        await client.ask("note_touches", session="s-1", touches=[{"corner": "first"}])


async def test_what_is_damaged_or_missing_is_said(rig: Rig, solved: Solved) -> None:
    client, path = Client(rig), solved("s-1")
    with raises("nothing-installed"):
        await client.ask("installed")
    path.write_text("format: handeye-calibration/2\n")
    found = await client.result("s-1")
    assert found.calibration is None and str(path) in found.problem and found.verdict == "FAIL"
    assert (await client.ask("result", session="s-9")).result is None


async def test_a_process_of_its_own_reads_and_changes_the_files(rig: Rig, solved: Solved) -> None:
    """As in a daemon: all that goes there and comes back can be sent."""
    solved("s-1")
    client = Client(rig)
    rig.session.results.reader = Workers(start_reader)
    try:
        with raises("nothing-installed"):
            await client.ask("installed")
        assert (await client.ask("install", session="s-1")).version == 1
        assert (await client.result()).installed
        assert [kept.verdict for kept in await client.sessions()] == ["PASS"]
        await client.ask("withdraw", reason="the bracket was loose", seen=1)
        touch = Touch(0, (0.0, 0.0), (0.1, 0.0), (0.1, 0.1), "read from the arm", "anna", "2026-01-01")
        noted = await client.ask("note_touches", session="s-1", touches=[msgspec.to_builtins(touch)])
        assert noted.version == 2
    finally:
        rig.session.results.close()
