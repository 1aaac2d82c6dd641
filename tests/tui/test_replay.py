"""A recording in the live screen: it plays, it says PLAYBACK, and nothing can be commanded."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from textual.widgets import DataTable

import recordings
from recordings.images import encode_png
from recordings.writer import RecordingWriter
from station.cell.errors import RefusedError, StationError
from station.cell.status import StationState
from station.protocol import verbs
from station.tui.app import ReplayApp
from station.tui.live import ReplayScreen
from station.tui.replay import END_TEXT, NO_ESTIMATE, ReplayLink, Timeline
from station.tui.widgets.preview import PreviewPane
from tests.recordings.small_recording import make_info, make_picture, make_view
from tests.tui.conftest import FakeLink, app_on, idle, summary, text_of, until

SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"


def replay_app(pace: float) -> ReplayApp:
    async def connect() -> ReplayLink:
        return ReplayLink(SAMPLE, pace)

    return ReplayApp(connect)


def test_the_arm_stands_where_it_stood_when_each_picture_was_taken() -> None:
    timeline = Timeline(SAMPLE)
    for view in timeline.views:
        at_s = timeline._times_s[view.index]
        status = timeline.status(at_s)
        assert timeline.view_at(at_s) == view
        assert status.robot.joints_rad == pytest.approx(view.joints_rad, abs=2e-3)
        assert status.robot.base_from_flange is not None
        for row, recorded in zip(status.robot.base_from_flange[:3], view.base_from_flange[:3], strict=True):
            assert row == pytest.approx(recorded, abs=2e-3)
    assert timeline.status(timeline.duration_s).reason == END_TEXT


def test_a_picture_that_cannot_be_decoded_is_said_in_its_place(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0), encode_png(make_picture(0).pixels)[:-20])
        writer.view(make_view(0))
        writer.finish()
    link = ReplayLink(tmp_path / "a.mcap", 0.0)
    assert not link._look(make_view(0), 80, 24).jpeg_base64
    assert not link._seen.found and "a.mcap" in link._seen.reason


async def test_it_plays_to_its_end_with_pictures_and_marks(link: FakeLink) -> None:
    async with replay_app(pace=1000.0).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "Capture 25/25" in text_of(pilot.app, "#rail"))
        assert "PLAYBACK" in text_of(pilot.app, "#bar")
        assert END_TEXT in text_of(pilot.app, "#next")
        assert NO_ESTIMATE in text_of(pilot.app, "#error")
        preview = pilot.app.screen.query_one(PreviewPane)
        await until(pilot, lambda: preview._image is not None and len(preview._corners) == 42)


async def test_it_pauses_steps_jumps_and_starts_again() -> None:
    app = replay_app(pace=0.0)  # only the keys move it
    async with app.run_test(size=(80, 24)) as pilot:

        async def shows(pictures: int, text: str) -> None:
            await until(pilot, lambda: f"Capture {pictures}/25" in text_of(pilot.app, "#rail"))
            await until(pilot, lambda: text in text_of(pilot.app, "#next"))

        await shows(0, "playing")
        await pilot.press("right", "right", "right")
        await shows(3, "paused")
        third = app.known.status
        await pilot.press("left")
        await shows(2, "paused")
        await pilot.press("right")
        await until(pilot, lambda: app.known.status is not None and app.known.status.robot == third.robot)  # type: ignore[union-attr]
        await pilot.press("space")
        await shows(3, "playing")
        await pilot.press("pagedown")
        await until(pilot, lambda: app.known.status is not None and app.known.status.session.elapsed_s > 10.0)
        await pilot.press("pageup", "home")
        await shows(0, "0:00 of")
        for _ in range(26):
            await pilot.press("right")
        await shows(25, END_TEXT)
        await pilot.press("space")
        await shows(0, "playing")


@pytest.mark.parametrize(
    "verb", [verbs.Stop(), verbs.Lease(), verbs.Prepare(), verbs.Go("t"), verbs.Finish(), verbs.Retake(0)]
)
async def test_nothing_can_be_commanded(verb: verbs.Verb[object]) -> None:
    with pytest.raises(RefusedError) as refused:
        await ReplayLink(SAMPLE).call(verb)
    assert refused.value.code == "playback"


def test_a_missing_recording_is_said_before_the_screen_opens(tmp_path: Path) -> None:
    with pytest.raises(StationError):
        ReplayLink(tmp_path / "none.mcap")


@pytest.fixture
def beside(link: FakeLink) -> FakeLink:
    """A cell whose sessions screen lists the sample."""
    link.answers["sessions"] = [msgspec.structs.replace(summary("s-0"), folder=str(SAMPLE))]
    return link


async def test_beside_a_cell_only_stop_goes_through(beside: FakeLink) -> None:
    async with app_on(beside).run_test(size=(80, 24), notifications=True) as pilot:
        await pilot.pause()
        await pilot.press("7")
        await until(pilot, lambda: pilot.app.screen.query_one(DataTable).row_count == 1)
        await pilot.press("w")
        await until(pilot, lambda: isinstance(pilot.app.screen, ReplayScreen))
        await until(pilot, lambda: "PLAYBACK" in text_of(pilot.app, "#bar"))
        await pilot.press("f5", "f6", "f3", "f2")
        await pilot.pause()
        assert beside.verbs == []
        await pilot.press("f12")
        await until(pilot, lambda: beside.verbs == ["stop"])
        await pilot.press("escape")
        await until(pilot, lambda: not isinstance(pilot.app.screen, ReplayScreen))
        await until(pilot, lambda: "PLAYBACK" not in text_of(pilot.app, "#bar"))


async def test_the_cells_own_work_ends_the_playback(beside: FakeLink) -> None:
    async with app_on(beside).run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        await pilot.press("7")
        await until(pilot, lambda: pilot.app.screen.query_one(DataTable).row_count == 1)
        await pilot.press("w")
        await until(pilot, lambda: isinstance(pilot.app.screen, ReplayScreen))
        beside.show(idle(StationState.STOPPED, "protective stop"))
        await until(pilot, lambda: not isinstance(pilot.app.screen, ReplayScreen))
        await until(pilot, lambda: "STOPPED" in text_of(pilot.app, "#bar"))


async def test_a_recording_alone_is_left_without_a_question() -> None:
    async with replay_app(pace=1.0).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "PLAYBACK" in text_of(pilot.app, "#bar"))
        await pilot.press("ctrl+q")
        await until(pilot, lambda: pilot.app._exit)
