"""A calibration with every field that a file may have, small, and damaged in every way."""

from __future__ import annotations

import copy
import hashlib
import math
import random
from collections.abc import Iterator
from typing import Any

import msgspec
import yaml

from calibrate.arms.chain import LearnedArm
from calibrate.files.calibration import Calibration, Override
from calibrate.files.touch import Touch
from calibrate.handeye.arm_table import CorrectedArm, FramePose, HeldOutViews
from calibrate.results import AllViews, Excluded, Posterior, ViewQuality, ViewWeight

EYE = tuple(tuple(float(i == j) for j in range(4)) for i in range(4))
TRIPLE = (0.1, 0.2, 0.3)
CHAIN = LearnedArm(axes=(TRIPLE,) * 5, points=(TRIPLE,) * 5, posture_rad=(0.1,) * 5, flange=EYE)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 7, 2**63 - 1, 2**63, 2**64, 10**30, -(10**30), 10**308, 10**400,
    0.0, -0.0, 1.0, 0.5, 1e-300, 1e300, math.nan, math.inf, -math.inf,
    "", "x", "1", "null", "real", "eye-to-hand", "base", "camera", "corrected_base", "plumb_bob", "≤",
    [], [1], [1.0, 2.0], [[1.0]], [0.0] * 3, [0.0] * 6, [["x"]], [None],
    {}, {"x": 1}, {"index": 1, "weight": 1.0}, {"kind": "chessboard"},
)  # fmt: skip
"""What a damaged file has in the place of a value."""


def whole(calibration: Calibration) -> Calibration:
    """The same with every optional part, each of them small."""
    learned = Posterior(
        X=EYE,
        lens=[1.0],
        shape=[0.0] * 5,
        errors=[0.0],
        covariance_lower=[1.0, 0.0, 1.0],
        robot_noise=(1e-4, 1e-4),
        corner_noise_px=(0.1, 0.1, 0.1),
        class_shares=[0.9, 0.1],
        freedom=40.0,
        board_extent_m=(TRIPLE, TRIPLE),
        arm=CHAIN,
        stated_arm_error=(TRIPLE,),
        level=TRIPLE,
        flange_extent_m=TRIPLE,
    )
    camera = FramePose("corrected_flange", "camera", TRIPLE, (0.0, 0.0, 0.0, 1.0), EYE)
    return msgspec.structs.replace(
        calibration,
        override=Override("It must run.", "somebody", ["views"]),
        verification=[Touch(0, (0.0, 0.0), (0.1, 0.1), (0.2, 0.2), "told by a person", "one", "2026")],
        posterior=msgspec.structs.replace(learned, without_joints=learned),
        excluded=Excluded(
            views=[2],
            who="somebody",
            all_views=AllViews(
                problem="none",
                error_mm=0.1,
                holdout_m=0.001,
                failed=["views"],
                shift=(0.0,) * 6,
                views=[ViewQuality(2, 0.1, 0.2, 0.3)],
                weights=[ViewWeight(2, 1.0)],
            ),
        ),
        arm_table=CorrectedArm(
            offered=True,
            model="any",
            nominal_source="learned",
            covariance=(TRIPLE,),
            with_table_mm=0.1,
            without_table_mm=0.2,
            learned=CHAIN,
            joints_rad=[(0.0, 1.0)],
            held_out=HeldOutViews(0.2, 0.1, 5),
            corrected_chain=CHAIN,
            result=camera,
        ),
    )


def short(plain: Any) -> Any:
    """The same plain data with two of many records and six of many numbers: a damaged one is soon read."""
    if isinstance(plain, dict):
        return {key: short(value) for key, value in plain.items()}
    if isinstance(plain, list):
        kept = 2 if plain and isinstance(plain[0], dict) else 6
        return [short(value) for value in plain[:kept]]
    return plain


def with_hash(plain: dict[str, Any]) -> bytes:
    """A file of this content, whatever it is, whose hash is right."""
    content = {key: value for key, value in plain.items() if key not in ("sha256", "created")}
    digest = hashlib.sha256(msgspec.json.encode(content, order="deterministic")).hexdigest()
    written = plain | {"sha256": digest}
    text: str = yaml.dump(written, Dumper=yaml.CSafeDumper, sort_keys=False, allow_unicode=True)
    return text.encode()


def damaged(plain: dict[str, Any], count: int, seed: int) -> Iterator[tuple[str, bytes]]:
    """Yield (what was done, the file): nine of ten with other values and a right hash, else other bytes."""
    rng = random.Random(seed)
    good = with_hash(plain)
    for number in range(count):
        if number % 10 == 9:
            yield _other_bytes(good, rng)
            continue
        tree = copy.deepcopy(plain)
        done = [_other_value(tree, rng) for _ in range(rng.choice((1, 1, 1, 2)))]
        yield "; ".join(done), with_hash(tree)


def _other_bytes(good: bytes, rng: random.Random) -> tuple[str, bytes]:
    place, bit = rng.randrange(len(good)), rng.randrange(8)
    flipped = bytes([good[place] ^ 1 << bit])
    kept = good[:place]
    rest = good[place + 1 :]
    changed = rng.choice((kept + flipped + rest, kept, kept + rest, kept + flipped * 2 + rest))
    return f"byte {place}, bit {bit}", changed


def _other_value(tree: dict[str, Any], rng: random.Random) -> str:
    """Change the tree in one place, and say how."""
    holder, where = _some_holder(tree, rng)
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    what = rng.choice(("replace", "replace", "replace", "remove", "add", "rename", "copy", "near"))
    if what == "add" or not keys:
        value = copy.deepcopy(rng.choice(VALUES))
        if isinstance(holder, dict):
            holder[rng.choice(("unknown", "format", "radon_marker", "safety_checksum", "kind"))] = value
        else:
            holder.insert(rng.randrange(len(holder) + 1), value)
        return f"{where}: {value!r} added"
    key = rng.choice(keys)
    if what == "remove":
        del holder[key]
    elif what == "rename" and isinstance(holder, dict):
        holder[f"{key}_"] = holder.pop(key)
    elif what == "copy":
        other, _ = _some_holder(tree, rng)
        holder[key] = copy.deepcopy(other)
    elif what == "near":
        holder[key] = _near(holder[key], rng)
    else:
        holder[key] = copy.deepcopy(rng.choice(VALUES))
    return f"{where}.{key}: {what}"


def _near(value: Any, rng: random.Random) -> Any:
    """A value like it that another reader may take for the same."""
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, int):
        return rng.choice((float(value), str(value), -value, bool(value)))
    if isinstance(value, float):
        return rng.choice((int(value), str(value), value * (1 + 1e-7), -value))
    if isinstance(value, str):
        return rng.choice((value.upper(), f"{value} ", "1e5", [value]))
    if isinstance(value, list):
        return rng.choice((value[:-1], value + value[-1:], {"0": value}, [value]))
    return [value]


def _some_holder(tree: dict[str, Any], rng: random.Random) -> tuple[Any, str]:
    """A dict or list of the tree, those near its root as often as those below."""
    holder: Any = tree
    where = "$"
    while True:
        inside = holder.items() if isinstance(holder, dict) else enumerate(holder)
        holders = [(key, value) for key, value in inside if isinstance(value, dict | list)]
        if not holders or rng.random() < 0.25:
            return holder, where
        key, holder = rng.choice(holders)
        where = f"{where}.{key}"
