"""What a hand finds at a corner becomes an offset in millimetres with the right sign."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.geometry import Array, pose, rotation_exp
from station.cell.errors import RefusedError, StationError
from station.cell.status import HoverOffer, MotionPreview
from station.operate.touch_test import (
    Hovering,
    read_offset_mm,
    tip_on_board_m,
    touch_of,
    touch_told,
    two_lengths_mm,
)

TIP = (0.01, -0.02, 0.15)
BASE_FROM_BOARD = pose(rotation_exp([np.pi, 0.0, 0.3]), [0.6, 0.1, 0.05])
OFFER = HoverOffer(
    go=MotionPreview("t", "hover", "ab" * 32, 2, 1.0, 0.5, 0.05, 3.0, ""),
    corner=7,
    corner_m=(0.1, 0.05),
    standoff_m=0.08,
    tip_m=TIP,
    base_from_board=tuple(map(tuple, BASE_FROM_BOARD.tolist())),  # type: ignore[arg-type]
    sigma_m=(0.0001, 0.0002),
    pointer="a needle",
)


def flange_with_tip_at(place_m: tuple[float, float, float]) -> Array:
    """base_from_flange that puts the pointer's tip there in `board`, however the flange is turned."""
    R = rotation_exp([0.4, 2.8, -0.1])
    return pose(R, (BASE_FROM_BOARD @ [*place_m, 1.0])[:3] - R @ TIP)


@pytest.mark.parametrize("place", [(0.1, 0.05, -0.08), (0.0, 0.0, 0.0), (-0.3, 0.2, 0.1)])
def test_the_tip_is_found_on_the_board(place: tuple[float, float, float]) -> None:
    assert tip_on_board_m(OFFER, flange_with_tip_at(place)) == pytest.approx(place, abs=1e-9)


def test_a_tip_over_its_corner_has_arrived_and_knows_how_far_beside_it_stands() -> None:
    hovering = Hovering.arrived(OFFER, flange_with_tip_at((0.1004, 0.0497, -0.08)), "")
    assert hovering.beside_mm == pytest.approx([0.4, -0.3])
    assert touch_told(hovering, "1, 1", None).offset_mm == pytest.approx((0.6, 1.3))


@pytest.mark.parametrize("place", [(0.106, 0.05, -0.08), (0.1, 0.044, -0.08), (0.1, 0.05, -0.074)])
def test_a_tip_that_is_elsewhere_did_not_come(place: tuple[float, float, float]) -> None:
    with pytest.raises(StationError) as problem:
        Hovering.arrived(OFFER, flange_with_tip_at(place), "STOP by anna")
    assert problem.value.code == "not-over-corner" and "STOP by anna" in problem.value.text


def test_the_tip_on_the_true_corner_tells_the_offset_the_other_way_round() -> None:
    assert read_offset_mm(OFFER, np.array([0.1002, 0.0499, 0.001])) == pytest.approx([-0.2, 0.1])


@pytest.mark.parametrize(
    ("touching", "code", "distance_m"),
    [
        ((0.1, 0.05, 0.011), "not-touching", 0.011),
        ((0.1, 0.05, -0.011), "not-touching", 0.011),
        ((0.16, 0.05, 0.0), "other-corner", 0.06),
    ],
)
def test_a_tip_off_the_board_or_at_another_corner_is_no_touch(
    touching: tuple[float, float, float], code: str, distance_m: float
) -> None:
    with pytest.raises(RefusedError) as refused:
        read_offset_mm(OFFER, np.array(touching))
    assert refused.value.code == code
    assert refused.value.values["distance_m"] == pytest.approx(distance_m)


@pytest.mark.parametrize(
    "said", ["0.2,-0.1", " 0.2 ; -0.1 ", "0.2 mm, -0.1mm", "200 um, -100 µm", "0.02 CM,-.1"]
)
def test_two_lengths_as_people_type_them(said: str) -> None:
    assert two_lengths_mm(said) == pytest.approx([0.2, -0.1])


@pytest.mark.parametrize(
    "said", ["", "0.2", "0.2,0.1,0", "a,b", "nan,0", "inf,0", "51,0", "0,-51", "6 cm, 0", "0.2 px, 0"]
)
def test_anything_else_is_refused(said: str) -> None:
    with pytest.raises(RefusedError) as refused:
        two_lengths_mm(said)
    assert (refused.value.code, refused.value.values["limit_mm"]) == ("no-offset", 50.0)


def test_what_goes_into_the_file_is_in_millimetres() -> None:
    hovering = Hovering.arrived(OFFER, flange_with_tip_at((0.1, 0.05, -0.08)), "")
    touch = touch_of(hovering, np.array([0.12345, -0.2]), "told by a person")
    assert (touch.corner, touch.pointer, touch.found) == (7, "a needle", "told by a person")
    assert touch.corner_mm == pytest.approx((100, 50))
    assert touch.offset_mm == (0.123, -0.2)
    assert touch.sigma_mm == (0.1, 0.2)
    assert touch.standoff_mm == pytest.approx(80)
