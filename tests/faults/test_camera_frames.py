"""Faults 17 to 19, 23 and 26: frames keep to their poses; changed settings, bad light, a ringing bracket."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.analysis.worker import assess, image_motion
from station.cell.errors import CameraError
from station.devices.frames import FrameCounter, frames_between
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell
from tests.codes import raises
from tests.faults.conftest import LOOP


@LOOP
@pytest.mark.process
@pytest.mark.parametrize("fault", ["missed-trigger", "lost-frame"])
async def test_17_18_a_trigger_without_a_frame_costs_one_pose_and_no_more(
    camera: RenderedCamera, fault: str
) -> None:
    first, missing = await camera.capture(), camera.counter.missing
    await camera.inject(fault)
    with raises("no-image", limit_s=0.5):
        await camera.capture(timeout_s=0.5)
    again = await camera.capture()
    assert (again.sequence, camera.counter.missing) == (first.sequence + 1, missing + 1)


@LOOP
@pytest.mark.process
async def test_19_a_second_frame_for_one_trigger_is_never_taken_for_the_next_pose(
    camera: RenderedCamera,
) -> None:
    await camera.inject("double-frame")
    first = await camera.capture()
    with raises("surplus-frames", frames=1):
        await camera.capture()
    third = await camera.capture()
    assert first.frame_id and third.frame_id and frames_between(first.frame_id, third.frame_id) == 2


@LOOP
@pytest.mark.process
async def test_23_a_camera_that_changes_its_exposure_is_refused(camera: RenderedCamera) -> None:
    await camera.capture()
    await camera.inject("exposure", 7000)
    with raises("settings-changed"):
        await camera.capture()
    await camera.inject("exposure")
    await camera.capture()


@LOOP
@pytest.mark.process
async def test_26_over_and_under_exposure_are_named_with_what_to_set(camera: RenderedCamera) -> None:
    for light, cause in ((1.0, ""), (4.0, "over-exposed"), (0.08, "under-exposed")):
        await camera.inject("illumination", light)
        picture = await camera.capture()
        advice = assess(picture.pixels, None, picture.exposure_us, picture.gain_db)
        assert advice.cause == cause
        assert not cause or (advice.exposure_us < picture.exposure_us) == (light > 1)
    await camera.inject("illumination", 1.0)


@LOOP
@pytest.mark.process
async def test_a_resting_camera_shows_no_motion_and_a_ringing_one_does(camera: RenderedCamera) -> None:
    """A bracket that rings on while the joints rest."""

    async def motion_px() -> float:
        looks = [await camera.glimpse() for _ in range(3)]
        found = image_motion([look.pixels for look in looks], make_cell().camera.width)
        assert found is not None
        return found

    assert await motion_px() < 0.25
    await camera.inject("ringing", {"amplitude_rad": 0.004, "frequency_hz": 6.3})
    assert max([await motion_px() for _ in range(3)]) > 1.0
    await camera.inject("ringing")
    assert await motion_px() < 0.25


def test_18_a_gap_in_the_frame_ids_is_an_error_even_where_a_picture_came() -> None:
    counter = FrameCounter()
    counter.accept(65_531)
    with raises("frames-lost"):
        counter.accept(65_534)
    assert counter.missing == 2 and counter.accept(65_535) == 1
    with raises("frame-twice"):
        counter.accept(65_535)
    assert counter.accept(1) == 2


@given(st.integers(1, 65_535), st.lists(st.sampled_from(["good", "lost", "extra pulse"]), max_size=40))
def test_whatever_happens_only_undisturbed_pictures_are_accepted(first_id: int, events: list[str]) -> None:
    """A camera and a box that miscount at random: no accepted picture follows an unnoticed disturbance."""
    counter, frame_id, pulse = FrameCounter(), first_id, 50
    counter.accept(frame_id, pulse)
    accepted = 1
    for event in events:
        frame_id, pulse = frame_id % 65_535 + 1, pulse + 1
        if event == "lost":  # this trigger's frame never comes; the driver says so and goes on
            counter.lost(pulse)
            continue
        if event == "extra pulse":
            pulse += 1
            with pytest.raises(CameraError):
                counter.accept(frame_id, pulse)
            continue
        assert counter.accept(frame_id, pulse) == accepted
        accepted += 1
