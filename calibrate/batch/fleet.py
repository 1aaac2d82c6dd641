"""Validity and drift of every cell of a fleet, collected from their state folders into one table."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import msgspec

from calibrate.batch.storage import cell_folder, whole
from calibrate.batch.workers import BatchWorkers, Lost, pool
from calibrate.errors import CalibrationError
from calibrate.files.calibration import read_calibration
from calibrate.files.folders import cameras, current_validity, current_version, readable_folder
from calibrate.files.validity import ValidityState, time_text
from calibrate.quality.checks import CheckEntry, Trend, find_trend, read_checks

UNREADABLE = "unreadable"


class CameraRecord(msgspec.Struct, frozen=True):
    """One camera of one cell: what is installed, whether it holds, and its drift checks."""

    cell: str
    """State folder of the cell, a path or a URL."""
    camera: str
    state: str
    """valid, unverified, in-doubt, withdrawn, or unreadable: nothing can be said"""
    since: str = ""
    """UTC, ISO format."""
    reason: str = ""
    """Code of the cause, or of what is wrong with the cell's files."""
    reason_text: str = ""
    verified: str = ""
    """Time of the last proof."""
    version: int | None = None
    robot: str = ""
    camera_device: str = ""
    """Model and serial number."""
    translation_sigma_mm: float | None = None
    rotation_sigma_deg: float | None = None
    trend: Trend | None = None
    """Drift over the checks of this version that chance does not explain."""
    checks: tuple[CheckEntry, ...] = ()
    """Drift checks of all versions, oldest first."""

    @property
    def current_checks(self) -> list[CheckEntry]:
        """Those of the installed version."""
        return [entry for entry in self.checks if entry.generation == self.version]

    @property
    def to_look_at(self) -> bool:
        """Tell whether it does not hold, is not known to, or drifts."""
        return self.state not in (ValidityState.VALID, ValidityState.UNVERIFIED) or self.trend is not None

    @property
    def why(self) -> str:
        """Say for people what there is to look at."""
        said = "" if self.state == ValidityState.VALID else self.reason_text or self.reason
        return f"{said} {'' if self.trend is None else self.trend.text}".strip()


Progress = Callable[[int, int, str], None]


def collect_fleet(
    cells: Sequence[Path | str],
    now: datetime | None = None,
    workers: BatchWorkers | None = None,
    progress: Progress | None = None,
) -> list[CameraRecord]:
    """Read the state of every camera of every cell, in the order of `cells` and by camera.

    `cells`: state folders, paths or fsspec's URLs. `now` decides what is too old. Equal inputs give equal
    records, whoever reads them. A cell that cannot be read is a record, too.
    """
    todo = list(dict.fromkeys(whole(place) for place in cells))
    work = partial(collect_cell, now=now or datetime.now(UTC))
    found: dict[str, list[CameraRecord]] = {}
    with closing((workers or pool())(work, todo)) as answers:
        for count, (cell, answer) in enumerate(answers, 1):
            if isinstance(answer, Lost):
                answer = [CameraRecord(cell, "", UNREADABLE, reason="lost", reason_text=answer.reason)]
            found[cell] = answer
            if progress:
                progress(count, len(todo), Path(cell).name)
    return [record for cell in todo for record in found[cell]]


def collect_cell(cell: str, now: datetime) -> list[CameraRecord]:
    """Read one cell, in a worker. Any failure is a record."""
    try:
        with cell_folder(cell) as folder:
            found = [_record(cell, folder, camera, now) for camera in cameras(folder)]
    except (CalibrationError, OSError) as problem:
        found = [_unreadable(cell, "", problem)]
    said = "Nothing was ever installed here."
    return found or [CameraRecord(cell, "", UNREADABLE, reason="nothing-installed", reason_text=said)]


def _unreadable(cell: str, camera: str, problem: CalibrationError | OSError) -> CameraRecord:
    code = problem.code if isinstance(problem, CalibrationError) else "state-folder"
    return CameraRecord(cell, camera, UNREADABLE, reason=code, reason_text=str(problem))


def _record(cell: str, folder: Path, camera: str, now: datetime) -> CameraRecord:
    try:
        place = readable_folder(folder, camera)
        version, path = current_version(place)
        validity, calibration = current_validity(place, now), read_calibration(path)
        checks = read_checks(folder, camera)
    except (CalibrationError, OSError) as problem:
        return _unreadable(cell, camera, problem)
    robot, device, sigma = calibration.robot, calibration.camera, calibration.sigma
    return CameraRecord(
        cell=cell,
        camera=camera,
        state=validity.state,
        since=validity.since,
        reason=validity.reason.code,
        reason_text=validity.reason.text,
        verified=validity.verified,
        version=version,
        robot=f"{robot.model} {robot.serial}".strip(),
        camera_device=f"{device.model} {device.serial}".strip(),
        translation_sigma_mm=sigma.translation_mm,
        rotation_sigma_deg=sigma.rotation_deg,
        trend=find_trend(checks, version),
        checks=tuple(checks),
    )


_TABLES = """
CREATE TABLE cameras (
    cell TEXT, camera TEXT, state TEXT, since TEXT, reason TEXT, reason_text TEXT, verified TEXT,
    version INTEGER, robot TEXT, camera_device TEXT, translation_sigma_mm REAL, rotation_sigma_deg REAL,
    checks INTEGER, checks_failed INTEGER,
    trend_mm REAL, trend_deg REAL, trend_days REAL, PRIMARY KEY (cell, camera));
CREATE TABLE checks (
    cell TEXT, camera TEXT, version INTEGER, time TEXT, recording TEXT, passed INTEGER,
    x_m REAL, y_m REAL, z_m REAL, rx_rad REAL, ry_rad REAL, rz_rad REAL, covariance TEXT,
    statistic REAL, threshold REAL);
CREATE INDEX checks_of ON checks (cell, camera, time);
"""


def fleet_table(records: Sequence[CameraRecord]) -> bytes:
    """Write an SQLite file with the tables `cameras` and `checks`; times UTC, shifts in metres and radians.

    `checks` are those of all versions, `cameras.checks` counts those of the installed one; `covariance` is a
    JSON array (6, 6). Equal records give equal bytes.
    """
    with closing(sqlite3.connect(":memory:")) as table:
        table.executescript(_TABLES)
        table.executemany(f"INSERT INTO cameras VALUES ({'?,' * 16}?)", map(_camera_row, records))
        for record in records:
            table.executemany(f"INSERT INTO checks VALUES ({'?,' * 14}?)", _check_rows(record))
        table.commit()
        return table.serialize()


def _camera_row(record: CameraRecord) -> tuple[object, ...]:
    trend = record.trend
    return (
        *msgspec.structs.astuple(record)[:12],
        len(record.current_checks),
        sum(not entry.passed for entry in record.current_checks),
        *((trend.shift_mm, trend.shift_deg, trend.days) if trend else (None, None, None)),
    )


def _check_rows(record: CameraRecord) -> Iterator[tuple[object, ...]]:
    for entry in record.checks:
        yield (
            record.cell,
            record.camera,
            entry.generation,
            time_text(datetime.fromtimestamp(entry.wall_s, UTC)),
            entry.recording,
            entry.passed,
            *entry.shift,
            msgspec.json.encode(entry.covariance).decode(),
            entry.statistic,
            entry.threshold,
        )
