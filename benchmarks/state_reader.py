"""Samples that the state reader keeps at 500 Hz, how well it knows their times, and its cost.

A simulated UR10e in a process of its own, whose clock drifts by 50 ppm; the reader in another, alone, so that
its processor time can be told. The truth of a sample's time is the controller's own grid. Both processes
share the machine's cores with whatever else runs: the controller's own lateness is given beside.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from station.devices.ur_state import StateReader
from station.simulation.cell import write_truth
from station.simulation.launch import start_controller
from station.simulation.scenes import make_cell

SECONDS = 60.0
DRIFT_PPM = 50.0
SETTLE_S = 10.0
"""The clock's line has had time to form."""


class Read(msgspec.Struct):
    """Result that the reader's process sends back."""

    stamps: bytes
    """(n, 3) float64: controller time [s], arrival and fitted host time [ns since the first arrival]"""
    first_ns: int
    lost: int
    cpu_share: float
    memory_mb: float


def _read(host: str, seconds: float, answer: Connection) -> None:
    rows: list[tuple[float, int, int]] = []

    def take(state: object) -> None:
        stamps = state.stamps  # type: ignore[attr-defined]
        fit = reader.clock.fit()
        fitted_ns = fit.to_host_ns(stamps.controller_s) if fit is not None else 0
        rows.append((stamps.controller_s, stamps.host_monotonic_ns, fitted_ns))

    reader = StateReader(host, take, lambda why: None)
    reader.start()
    reader.started.result(5.0)
    time.sleep(1.0)
    wall_s, cpu_s = time.monotonic(), time.process_time()
    time.sleep(seconds)
    share = (time.process_time() - cpu_s) / (time.monotonic() - wall_s)
    reader.close()
    first_ns = rows[0][1]
    table = np.array([(t, a - first_ns, f - first_ns) for t, a, f in rows])
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    answer.send_bytes(msgspec.msgpack.encode(Read(table.tobytes(), first_ns, reader.lost, share, memory_mb)))


def run() -> str:
    """A markdown table."""
    return measure(SECONDS)


def measure(seconds: float) -> str:
    with tempfile.TemporaryDirectory() as folder:
        truth = msgspec.structs.replace(make_cell(seed=1), controller_clock_drift_ppm=DRIFT_PPM)
        path = Path(folder) / "truth.json"
        write_truth(truth, path)
        with start_controller("UR10e", truth=path) as controller, controller.admin() as admin:
            zero_ns = admin.ask("state")["controller_zero_monotonic_ns"]
            context = multiprocessing.get_context("spawn")
            mine, theirs = context.Pipe()
            child = context.Process(target=_read, args=(controller.host, seconds, theirs))
            child.start()
            before = admin.ask("stats")
            while not mine.poll(5.0) and child.is_alive():
                admin.ask("stats")
            after = admin.ask("stats")
            read = msgspec.msgpack.decode(mine.recv_bytes(), type=Read)
            child.join()
    return _table(read, zero_ns, seconds, before, after)


def _table(
    read: Read, zero_ns: int, seconds: float, before: dict[str, float], after: dict[str, float]
) -> str:
    rows = np.frombuffer(read.stamps).reshape(-1, 3)
    true_ns = zero_ns - read.first_ns + rows[:, 0] * 1e9 / (1 + DRIFT_PPM * 1e-6)
    settled = rows[:, 0] > rows[0, 0] + min(SETTLE_S, seconds / 2)
    cycles = round((rows[-1, 0] - rows[0, 0]) * 500) + 1
    late = after["late_cycles"] - before["late_cycles"]
    return "\n".join(
        [
            f"{seconds:g} s at 500 Hz, controller's clock {DRIFT_PPM:g} ppm fast.",
            "",
            "| | |",
            "|---|---|",
            f"| samples made / kept / lost | {cycles} / {len(rows)} / {read.lost} |",
            f"| arrival (kernel's stamp) after the true time | {_spread((rows[:, 1] - true_ns)[settled])} |",
            f"| error of the fitted host time | {_spread(np.abs(rows[:, 2] - true_ns)[settled])} |",
            f"| reader: share of a core, peak memory | {read.cpu_share:.1%}, {read.memory_mb:.0f} MB |",
            f"| controller: late cycles, worst | {late:.0f}, {after['worst_lateness_ms']:.1f} ms |",
        ]
    )


def _spread(errors_ns: NDArray[np.float64]) -> str:
    p50, p99, worst = np.percentile(errors_ns, [50, 99, 100]) / 1e6
    return f"p50 {p50:.2f}, p99 {p99:.2f}, max {worst:.2f} ms"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    print(measure(parser.parse_args().seconds))
