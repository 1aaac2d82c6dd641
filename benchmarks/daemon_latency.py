"""Latency of STOP through the daemon, and lateness of its loop while 75 fps are recorded."""

from __future__ import annotations

import asyncio
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from recordings.recorder import Recorder
from recordings.schema.messages import Image, SessionInfo, Stamps
from station.cell.status import StationState
from station.cli.demo import simulated_daemon
from station.protocol.client import Client
from station.session import Session
from station.simulation.launch_cell import SimulationOptions, simulated_cell

PRESSES = 200
RECORD_S = 15.0
FPS = 75.0
_NOTE = (
    "The reply to STOP follows the daemon's stop call and its acknowledgement by the controller, so the "
    "first row bounds the call from above. {} pictures were dropped by the recorder."
)
STOP_GOAL_MS, LAG_GOAL_MS = 100.0, 20.0


def run() -> str:
    stop_ms = asyncio.run(_stop_latencies())
    lag_ms, dropped = asyncio.run(_loop_lags())
    return "\n".join(
        [
            "| what | n | p50 | p90 | p99 | max | goal (p99) |",
            "|---|---|---|---|---|---|---|",
            _row("STOP: request written → reply read, previews at full rate (ms)", stop_ms, STOP_GOAL_MS),
            _row("working loop late, while recording 75 fps of 1280×1024 (ms)", lag_ms, LAG_GOAL_MS),
            "",
            _NOTE.format(dropped),
        ]
    )


def _row(name: str, values: list[float], goal: float) -> str:
    p50, p90, p99 = np.percentile(values, [50, 90, 99])
    return f"| {name} | {len(values)} | {p50:.1f} | {p90:.1f} | {p99:.1f} | {max(values):.1f} | {goal:.0f} |"


async def _stop_latencies() -> list[float]:
    """Presses on one connection while another asks for previews as fast as it can."""
    with tempfile.TemporaryDirectory() as folder, simulated_daemon(Path(folder), []) as socket:
        async with (
            await Client.connect(socket) as operator,
            await Client.connect(socket) as screen,
        ):
            async for status in operator.statuses():
                if status.state is StationState.IDLE and status.camera.connected:
                    break
            watching = asyncio.create_task(_watch(screen))
            latencies = []
            for _ in range(PRESSES):
                begun_s = time.perf_counter()
                await operator.request("stop")
                latencies.append(1000 * (time.perf_counter() - begun_s))
                await operator.request("acknowledge")
                await asyncio.sleep(0.05)
            watching.cancel()
            return latencies


async def _watch(screen: Client) -> None:
    while True:
        await screen.request("preview", width=480, height=384)


async def _loop_lags() -> tuple[list[float], int]:
    """The daemon's own loop beside a recorder that gets a free-running camera's pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cell = await asyncio.to_thread(simulated_cell, SimulationOptions(), folder / "cell")
        session = Session(cell, folder)
        await session.start()
        try:
            while session.store.state is not StationState.IDLE:
                await asyncio.sleep(0.05)
            await asyncio.sleep(3.0)  # camera and worker start too
            model = cell.config.camera.model
            assert model is not None
            info = SessionInfo("lag", "eye-in-hand", "simulated", cell.config.board, model)
            recorder = Recorder(folder / "lag.mcap", info)
            ended = threading.Event()
            source = threading.Thread(target=_pictures, args=(recorder, model.width, model.height, ended))
            session.supervisor.lags_s.clear()
            source.start()
            await asyncio.sleep(RECORD_S)
            lags = [1000 * lag for lag in session.supervisor.lags_s]
            ended.set()
            await asyncio.to_thread(source.join)
            await asyncio.wrap_future(recorder.finish())
            return lags, recorder.dropped
        finally:
            await session.close()


def _pictures(recorder: Recorder, width: int, height: int, ended: threading.Event) -> None:
    image = np.random.default_rng(0).integers(0, 255, (height, width), dtype=np.uint8)
    begun_s, number = time.monotonic(), 0
    while not ended.is_set():
        stamps = Stamps(time.monotonic_ns(), time.time_ns(), device_ns=time.monotonic_ns())
        recorder.image(Image(image, stamps, frame_id=number % 65535 + 1, sequence=number))
        number += 1
        time.sleep(max(0.0, begun_s + number / FPS - time.monotonic()))
