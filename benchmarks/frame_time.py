"""Errors of frames' times, sweeps that find them, and lost frames that are counted.

The first table: the plan of `station capture --sweep` with rendered pictures, detected and solved as in the
product. Controller and camera have clocks of their own (offset at random, controller up to ± 30 ppm, camera
as stated), messages and round trips are delayed at random (0.1 ms and an exponential 0.1 ms each way), the
camera's clock is read once a second, and its stamps are wrong by as much as stated. The driver's own code
makes the times. Found: the sweep's 95 % interval holds the injected error, and where there is one it does not
hold 0. Bound: every frame's time of a run within its bound of the truth, where the stamps are right; and the
drift within its uncertainty. The second table: frame ids of a million frames each, some lost at random.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np

from calibrate.boards.detect import detect
from calibrate.boards.model import board_points
from calibrate.geometry import Array, inverse
from calibrate.kinematics import MODELS, forward
from calibrate.lens.pnp import candidate_poses
from calibrate.quality.sweep import UNSEEN_DELAY_S, estimate_time_offset, on_host
from calibrate.views import BoardView
from recordings.schema.frame_ids import FrameIds
from recordings.schema.messages import ClockReading, Image, Stamps
from station.devices.frames import FrameClock, FrameCounter
from station.plan.files import JOINT_ACCELERATION_RAD_S2, JOINT_SPEED_RAD_S, sweep_plan
from station.simulation.cell import CellTruth
from station.simulation.renderer import Light, render, scaled
from station.simulation.scenes import make_cell

SHARE = float(os.environ.get("BENCH_SHARE", "1"))
RUNS = max(2, round(40 * SHARE))
FRAMES = max(20_000, round(1_000_000 * SHARE))
RATE_HZ, EXPOSURE_S, READOUT_S, STATES_HZ = 6.0, 0.010, 0.0133, 500.0
MARGIN_S = 0.5
"""The arm stands before and after its swings."""
START_NS = 10**13
CASES = ((0.0, 0.0), (0.001, 0.0), (-0.001, 0.0), (0.005, 0.0), (-0.005, 0.0), (0.0, 20.0), (0.0, -20.0))
"""Stamp error (s), drift of the camera's clock (ppm)"""
DELAY_S = 1e-4


class Run(NamedTuple):
    offset_s: float
    sigma_s: float
    inside: bool
    """Every frame's time is within its bound of the truth"""
    bound_s: float
    """Largest"""
    drift_error: float
    drift_uncertainty: float
    sources: set[str]


def run() -> str:
    with ProcessPoolExecutor() as pool:
        runs = list(zip(*pool.map(one_seed, range(RUNS)), strict=True))
    columns = (
        "stamp error|drift|found|mean − injected|sigma p50|times inside their bound|bound p50|drift found"
    )
    lines = [
        f"{RUNS} runs a row, {RATE_HZ:g} frames/s of {EXPOSURE_S * 1e3:g} ms.",
        "",
        f"| {columns.replace('|', ' | ')} |",
        "|" + "---|" * 8,
    ]
    for (error_s, drift_ppm), results in zip(CASES, runs, strict=True):
        lines.append(_row(error_s, drift_ppm, results))
    lines += ["", "| frame ids | frames | lost | losses found | false losses |", "|" + "---|" * 5]
    rng = np.random.default_rng(0)
    lines += [_ids_row(name, rng) for name in _NUMBERINGS]
    return "\n".join(lines)


def _row(error_s: float, drift_ppm: float, results: tuple[Run, ...]) -> str:
    offsets = np.array([r.offset_s for r in results])
    sigmas = np.array([r.sigma_s for r in results])
    found = np.abs(offsets + error_s) <= 1.96 * sigmas
    if error_s:
        found &= np.abs(offsets) > 1.96 * sigmas
    told = "-" if error_s else f"{sum(r.inside for r in results)}"
    drift = sum(r.drift_error <= r.drift_uncertainty for r in results)
    uncertainty_ppm = 1e6 * np.median([r.drift_uncertainty for r in results])
    bound_ms = 1e3 * np.median([r.bound_s for r in results])
    return (
        f"| {1e3 * error_s:+.0f} ms | {drift_ppm:+.0f} ppm | {found.sum()} "
        f"| {1e3 * (offsets + error_s).mean():+.3f} ms | {1e3 * np.median(sigmas):.3f} ms "
        f"| {told} | {bound_ms:.2f} ms | {drift}, ± {uncertainty_ppm:.0f} ppm |"
    )


def one_seed(seed: int) -> list[Run]:
    """All cases with the same cell, motion and pictures."""
    rng = np.random.default_rng([seed, 21])
    cell = make_cell(seed=seed)
    times_s, joints = _swings(cell)
    model = MODELS[cell.robot_model]
    flange = forward(model, joints)
    frames_s = np.arange(MARGIN_S, times_s[-1] - MARGIN_S, 1 / RATE_HZ) + rng.uniform(0, 1 / RATE_HZ)
    middles_s, boards = _seen(cell, times_s, joints, frames_s, rng)
    controller_ppm = rng.uniform(-30, 30)
    arrivals_s = times_s + DELAY_S / 2 + rng.exponential(2e-4, len(times_s))
    robot_s = on_host(times_s * (1 + controller_ppm * 1e-6) + rng.uniform(0, 1e4), arrivals_s)
    results = []
    for error_s, drift_ppm in CASES:
        told_s, inside, bound_s, clock = _told(middles_s, error_s, drift_ppm, rng)
        found = estimate_time_offset(robot_s, flange, told_s, boards)
        fit = clock.readings.fit
        assert fit is not None and clock.timing is not None
        results.append(
            Run(
                found.offset_s,
                math.hypot(found.sigma_s, UNSEEN_DELAY_S),
                inside,
                bound_s,
                abs(-fit.drift_ppm - drift_ppm) * 1e-6,
                fit.drift_uncertainty,
                {clock.timing.source},
            )
        )
    return results


def _swings(cell: CellTruth) -> tuple[Array, Array]:
    """Times (n,) s and joints (n, 6) of the sweep's plan: trapezoids of speed, a breath between swings."""
    plan = sweep_plan(cell.robot_model, cell.mount, cell.start_joints_rad)
    corners = np.array([cell.start_joints_rad, *(pose.joints_rad for pose in plan.poses)])
    parts = [np.repeat(corners[:1], round(MARGIN_S * 2 * STATES_HZ), axis=0)]
    for a, b in itertools.pairwise(corners):
        turn = float(np.abs(b - a).max())
        speed = min(JOINT_SPEED_RAD_S, math.sqrt(turn * JOINT_ACCELERATION_RAD_S2))
        rise = speed / JOINT_ACCELERATION_RAD_S2
        total = turn / speed + rise
        t = np.arange(0, total, 1 / STATES_HZ)
        up, down = np.minimum(t, rise), np.maximum(t - (total - rise), 0)
        gone = JOINT_ACCELERATION_RAD_S2 * (up**2 - down**2) / 2 + speed * np.clip(t - rise, 0, None)
        parts.append(a + np.clip(gone / turn, 0, 1)[:, None] * (b - a))
        parts.append(np.repeat(b[None], round(0.1 * STATES_HZ), axis=0))
    parts.append(np.repeat(corners[-1:], round(MARGIN_S * 2 * STATES_HZ), axis=0))
    joints = np.concatenate(parts)
    return np.arange(len(joints)) / STATES_HZ, joints


def _seen(
    cell: CellTruth, times_s: Array, joints: Array, frames_s: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """True middles of exposure (m,) s and PnP poses (m, 4, 4) of the pictures that show the board."""
    lens, model = scaled(cell.camera, 0.375), MODELS[cell.robot_model]
    middles, poses = [], []
    for at_s in frames_s:
        at_joints = np.array([np.interp(at_s, times_s, axis) for axis in joints.T])
        view = inverse(forward(model, at_joints) @ np.array(cell.camera_mount)) @ np.array(cell.board_place)
        image = render(lens, cell.board, view, Light(pixel_noise=1.5, blur_px=0.6), rng)
        found = detect(image, cell.board, thorough=False)
        if found.found:
            points = board_points(cell.board)[found.indices]
            seen = BoardView(0, "", np.eye(4), points, found.pixels)
            middles.append(at_s)
            poses.append(candidate_poses(seen, lens, None)[0].camera_from_board)
    return np.array(middles), np.array(poses)


def _told(
    middles_s: Array, error_s: float, drift_ppm: float, rng: np.random.Generator
) -> tuple[Array, bool, float, FrameClock]:
    """The driver's times of the frames (s), whether all are within their bounds, and the largest bound."""
    clock, offset_ns = FrameClock(), int(rng.integers(-(10**15), 10**15))
    clock.restart()

    def device_ns(host_s: float) -> int:
        return START_NS + offset_ns + round(host_s * 1e9 * (1 + drift_ppm * 1e-6))

    told, inside, bounds, next_reading_s = [], True, [], middles_s[0] - 1.0
    for middle_s in middles_s:
        while next_reading_s < middle_s:
            there_s, back_s = DELAY_S + rng.exponential(DELAY_S, 2)
            asked_ns = START_NS + round(next_reading_s * 1e9)
            answered_ns = START_NS + round((next_reading_s + there_s + back_s) * 1e9)
            clock.readings.add(ClockReading(asked_ns, answered_ns, device_ns(next_reading_s + there_s)))
            next_reading_s += 1.0
        start_s = middle_s - EXPOSURE_S / 2
        arrival_s = start_s + EXPOSURE_S + READOUT_S + rng.exponential(DELAY_S)
        stamps = Stamps(START_NS + round(arrival_s * 1e9), device_ns=device_ns(start_s + error_s))
        frame = Image(np.zeros((1, 1), np.uint8), stamps, 1, 0, exposure_us=1e6 * EXPOSURE_S)
        time = clock.timed(frame).time
        assert time is not None and time.source == "latched"
        told.append((time.host_monotonic_ns - START_NS) / 1e9)
        bounds.append(time.bound_s)
        inside &= abs(told[-1] - middle_s - error_s) <= time.bound_s
    return np.array(told), bool(inside), max(bounds), clock


_NUMBERINGS = {
    "GigE Vision: 1 … 65535, 1 …": (FrameIds.BLOCK, 1, 65_535),
    "64 bits from 0 (USB3 Vision)": (FrameIds.WIDE, 0, 2**64),
    "64 bits from 1, not announced": (FrameIds.BLOCK, 1, 2**64),
    "16 bits from 0, 0 again": (FrameIds.WIDE, 0, 65_536),
    "32 bits, 0 again": (FrameIds.WIDE, 2**32 - 400_000, 2**32),
    "none": (FrameIds.WIDE, None, 1),
}


def _ids_row(name: str, rng: np.random.Generator) -> str:
    ids, first, size = _NUMBERINGS[name]
    counter, lost, found, false = FrameCounter(ids), 0, 0, 0
    for number, gap in numbers(first, size, ids is FrameIds.BLOCK and size < 2**17, rng):
        before = counter.missing
        counter.follow(number)
        counted = counter.missing - before
        lost, found, false = lost + gap, found + min(counted, gap), false + max(0, counted - gap)
    told = "-" if first is None else str(found)
    return (
        f"| {name} | {FRAMES} | {lost if first is not None else 0} | {told} | {false + counter.unexpected} |"
    )


def numbers(
    first: int | None, size: int, from_one: bool, rng: np.random.Generator
) -> Iterator[tuple[int | None, int]]:
    """(id of a frame that came, how many were lost just before it)."""
    gaps = np.where(rng.random(FRAMES) < 1e-3, rng.integers(1, 200, FRAMES), 0)
    gaps[0] = 0
    count = -1
    for gap in gaps.tolist():
        count += 1 + gap
        if first is None:
            yield None, 0
        elif from_one:
            yield count % size + 1, gap
        else:
            yield (first + count) % size, gap


if __name__ == "__main__":
    print(run())
