"""A session goes on only with the robot, camera, board, mount and lens that it began with."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import msgspec
import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from recordings.schema.messages import BoardKind, BoardSpec, CameraIdentity, RobotIdentity
from station.cell.errors import CameraError
from station.cell.pose_plan import Plan
from station.cell.session_folder import read_state, write_state
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose
from tests.codes import raises
from tests.patience import until
from tests.station.session_rig import CameraInMemory, Rig, crash

OTHER_ROBOT = RobotIdentity(model="UR10", serial="ANOTHER", controller_version="5.15.0")
OTHER_CAMERA = CameraIdentity(model="double", serial="2", driver="rendered")
Change = Callable[[Rig], None]
NextDaemon = Callable[[Change], Awaitable[Rig]]


def other_robot(rig: Rig) -> None:
    rig.arm.identity = OTHER_ROBOT


def other_camera(rig: Rig) -> None:
    rig.camera.identity = OTHER_CAMERA


def other_robot_found_later(rig: Rig) -> None:
    """It says who it is only when it is connected, as a real one does."""
    rig.arm.identity = RobotIdentity(model="UR10")
    connect = rig.arm.connect

    async def connected() -> RobotIdentity:
        rig.arm.identity = OTHER_ROBOT
        return await connect()

    rig.arm.connect = connected


def other_camera_found_later(rig: Rig) -> None:
    rig.camera.identity = CameraIdentity(driver="aravis")

    async def opened() -> CameraIdentity:
        rig.camera.identity = OTHER_CAMERA
        return OTHER_CAMERA

    rig.camera.open = opened


def other_board(rig: Rig) -> None:
    cell = rig.session.context.cell
    board = BoardSpec(BoardKind.CHESSBOARD, 9, 6, 0.03)
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, board=board))


def other_mount(rig: Rig) -> None:
    cell = rig.session.context.cell
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, mount="eye-to-hand"))


def other_size(rig: Rig) -> None:
    known = rig.session.context.cell.config.camera.model
    assert known is not None
    rig.configure(camera={"model": msgspec.structs.replace(known, width=known.width // 2)})


def other_model(rig: Rig) -> None:
    rig.configure(robot={"model": "UR5"})
    rig.arm.identity = RobotIdentity(model="UR5")


def configured_serial(rig: Rig) -> None:
    """The arm has not told its serial number yet, the configuration does."""
    rig.configure(robot={"serial": "ANOTHER"})
    rig.arm.identity = RobotIdentity(model="UR10")


@pytest.fixture
async def folder(tmp_path: Path, rig: Rig) -> Path:
    """Folder of a session of one pose, as a killed daemon leaves it."""
    await rig.go_until_the_second_move()
    folder = rig.session.context.require_recording().folder
    crash(rig)
    return folder


@pytest.fixture
async def next_daemon(tmp_path: Path) -> AsyncIterator[NextDaemon]:
    rigs: list[Rig] = []

    async def start(change: Change) -> Rig:
        rig = Rig(tmp_path / "root")
        rigs.append(rig)
        change(rig)
        await rig.start()
        return rig

    yield start
    for rig in rigs:
        await rig.session.close()


def serials(folder: Path) -> set[str]:
    recover_recording(folder)
    return {segment.info.robot.serial for segment in open_recording(folder).segments}


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (other_board, "board"),
        (other_mount, "mounting"),
        (other_size, "lens"),
        (other_model, "robot"),
        (configured_serial, "robot"),
        (other_robot, "robot"),
        (other_camera, "camera"),
    ],
)
async def test_what_is_known_at_once_is_compared_before_a_session_is_shown(
    folder: Path, next_daemon: NextDaemon, change: Change, what: str
) -> None:
    rig = await next_daemon(change)
    [event] = rig.told("interrupted-elsewhere")
    assert event.values["what"] == what
    assert event.values["first"] != event.values["now"]
    assert rig.session.context.recording is None
    assert serials(folder) == {"DOUBLE"}, "what was recorded is still there"


@pytest.mark.parametrize(
    ("change", "what", "first", "now"),
    [
        (other_robot_found_later, "robot", "UR10 DOUBLE", "UR10 ANOTHER"),
        (other_camera_found_later, "camera", "double 1", "double 2"),
    ],
)
async def test_a_session_does_not_go_on_with_another_device(
    folder: Path, next_daemon: NextDaemon, change: Change, what: str, first: str, now: str
) -> None:
    rig = await next_daemon(change)
    await until(lambda: rig.told("interrupted-elsewhere"), "told as soon as the device says who it is")
    assert rig.state is S.STOPPED
    assert now in rig.session.store.status.reason
    await rig.session.acknowledge("anna")
    rig.session.take_lease(1, "anna")
    for purpose in (Purpose.RESUME, Purpose.RUN):
        with raises("interrupted-elsewhere", what=what, first=first, now=now):
            await rig.session.prepare(1, purpose)
    with raises("interrupted-elsewhere", what=what):
        await rig.session.switch_free_drive(1, True)
    assert rig.state is S.PAUSED
    assert "start control" not in rig.arm.log
    assert "move" not in rig.arm.log
    await rig.session.finish(1)
    assert rig.state is S.IDLE
    recording = open_recording(folder)
    assert [segment.info.robot.serial for segment in recording.segments] == ["DOUBLE"]
    assert [view.index for view in recording.views()] == [0]
    await rig.go_until(S.CHECKING)
    await rig.until(S.IDLE)
    assert rig.session.store.status.session.name != folder.name, "a new session is this cell's own"


async def test_the_same_cell_goes_on(folder: Path, next_daemon: NextDaemon) -> None:
    rig = await next_daemon(lambda rig: None)
    await rig.until(S.STOPPED)
    await rig.session.acknowledge("anna")
    rig.session.take_lease(1, "anna")
    await rig.go_until(S.IDLE, purpose=Purpose.RESUME)
    assert not rig.told("interrupted-elsewhere")
    assert len(open_recording(folder).segments) == 2


@pytest.mark.parametrize("change", [other_robot, other_camera])
async def test_a_session_of_an_earlier_version_is_compared_by_its_first_file(
    folder: Path, next_daemon: NextDaemon, change: Change
) -> None:
    state = read_state(folder)
    assert state is not None and state.first is not None
    write_state(folder, msgspec.structs.replace(state, first=None))
    rig = await next_daemon(change)
    assert rig.told("interrupted-elsewhere")
    assert rig.session.context.recording is None


async def test_a_lens_that_is_told_otherwise_does_not_go_on(rig: Rig, next_daemon: NextDaemon) -> None:
    known = rig.session.context.cell.config.camera.model
    assert known is not None and known.matrix is not None
    (fx, *rest), *rows = known.matrix
    other = msgspec.structs.replace(known, matrix=((fx + 1, *rest), *rows))
    rig.configure(camera={"model_is_rough": False})
    await rig.go_until_the_second_move()
    crash(rig)
    second = await next_daemon(lambda rig: rig.configure(camera={"model_is_rough": False, "model": other}))
    [event] = second.told("interrupted-elsewhere")
    assert event.values["what"] == "lens"


async def test_a_first_file_that_recovery_made_readable_is_compared_before_the_next(
    folder: Path, next_daemon: NextDaemon
) -> None:
    state = read_state(folder)
    assert state is not None
    write_state(folder, msgspec.structs.replace(state, first=None))
    [file] = folder.glob("*.mcap.part")
    content = file.read_bytes()
    begins = content.index(b"session")
    file.write_bytes(content[:begins] + b"?" + content[begins + 1 :])
    rig = await next_daemon(other_robot)
    await rig.until(S.STOPPED)
    await rig.session.acknowledge("anna")
    rig.session.take_lease(1, "anna")
    await rig.give_go(Purpose.RESUME)
    await rig.until(S.PAUSED)
    assert rig.cause == "interrupted-elsewhere"
    assert "move" not in rig.arm.log
    assert serials(folder) == {"DOUBLE"}


async def test_without_any_file_the_plan_is_compared(folder: Path, next_daemon: NextDaemon) -> None:
    state = read_state(folder)
    assert state is not None
    write_state(folder, msgspec.structs.replace(state, first=None))
    for file in folder.glob("*.mcap*"):
        file.unlink()
    rig = await next_daemon(other_mount)
    assert rig.told("interrupted-elsewhere")
    assert rig.session.context.recording is None


@pytest.mark.parametrize(("change", "what"), [(other_robot, "robot"), (other_camera, "camera")])
async def test_a_device_exchanged_in_a_pause_does_not_go_on(rig: Rig, change: Change, what: str) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    moves = rig.arm.log.count("move")
    change(rig)
    with raises("interrupted-elsewhere", what=what):
        await rig.session.prepare(1, Purpose.RESUME)
    assert rig.arm.log.count("move") == moves


async def test_a_camera_exchanged_while_the_arm_moves_gives_no_view(rig: Rig) -> None:
    await rig.go_until_it_moves()
    other_camera(rig)
    rig.arm.arrive.set()
    await rig.until(S.FAULT)
    assert rig.cause == "interrupted-elsewhere"
    assert rig.pose_states[0] != "done"
    folder = rig.session.context.require_recording().folder
    await rig.session.acknowledge("anna")
    await rig.session.finish(1)
    assert not open_recording(folder).views()


async def test_no_recording_begins_before_the_camera_told_who_it_is(
    rig: Rig, small_plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def not_open(camera: CameraInMemory) -> dict[str, object]:
        raise CameraError("not-open")

    monkeypatch.setattr(CameraInMemory, "settings", not_open)
    rig.camera.identity = CameraIdentity(driver="aravis")
    await rig.give_go()
    await rig.until(S.IDLE)
    assert rig.cause == "not-open"
    assert "move" not in rig.arm.log
