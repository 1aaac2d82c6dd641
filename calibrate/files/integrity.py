"""Verification of a calibration file: hash and consistency of the result. Needs only NumPy and PyYAML."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from calibrate.errors import CalibrationFileError
from calibrate.files.earlier import FORMATS, digits_of_before, lift_calibration
from calibrate.files.fields import wrong_field
from calibrate.files.folders import VERSION_NAME
from recordings import strict_yaml
from recordings.files import read_beginning
from recordings.geometry import Array, is_rigid, matrix_from_quaternion

_MCAP = b"\x89MCAP"
_LIMIT_BYTES = 4 * 1024 * 1024


def read_bounded(path: Path) -> bytes:
    """Read a file, at most one byte over the size limit. CalibrationFileError where it cannot be read."""
    try:
        return read_beginning(path, _LIMIT_BYTES + 1)
    except OSError as problem:
        raise CalibrationFileError(path=path, why=problem.strerror or str(problem)) from None


def require_content_of_name(path: Path, content: bytes) -> None:
    """Compare an installed version with the digits in its name, which say what was installed by its number.

    Files with other names, or in other folders, may hold anything. Raises CalibrationFileError.
    """
    match = VERSION_NAME.fullmatch(path.name)
    if match is None or path.parent.name != "gen":
        return
    digits = match[2]
    if digits not in (hashlib.sha256(content).hexdigest()[:8], digits_of_before(content)):
        why = "it is not the file that was installed by this name: another one was copied over it"
        raise CalibrationFileError("damaged-calibration", path=path, why=why)


def verified_plain(content: bytes, where: str) -> dict[str, Any]:
    """Parse a calibration file to plain data of today's format, without `sha256`, after verifying its hash.

    CalibrationFileError says what is wrong.
    """
    if content.startswith(_MCAP):
        solve = f"First run: calibrate solve {shlex.quote(where)}"
        raise CalibrationFileError("not-a-calibration", path=where, why="it is a recording", advice=solve)
    if len(content) > _LIMIT_BYTES:
        raise _other(where, f"it is larger than {_LIMIT_BYTES} bytes")
    try:
        plain = strict_yaml.load_plain(content)
        found = plain.get("format") if isinstance(plain, dict) else None
        if not isinstance(plain, dict) or found not in FORMATS:
            raise _other(where, f"format is {found!r}, expected {FORMATS[-1]!r}")
        if plain.pop("sha256", None) == content_sha256(plain):
            return lift_calibration(plain)
        why = "the content does not fit its hash"
    except (strict_yaml.StrictYamlError, TypeError, ValueError) as problem:
        why = str(problem)
    raise CalibrationFileError("damaged-calibration", path=where, why=why)


def _other(where: str, why: str) -> CalibrationFileError:
    give = "Give one that `calibrate solve` wrote."
    return CalibrationFileError("not-a-calibration", path=where, why=why, advice=give)


def content_sha256(plain: dict[str, Any]) -> str:
    """Compute the hash over everything but `sha256` and `created`, independent of layout."""
    content = {key: value for key, value in plain.items() if key not in ("sha256", "created")}
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def canonical_json(value: object) -> str:
    """Encode as JSON with sorted keys and no spaces, as `msgspec.json.encode(order="deterministic")` does.

    TypeError for what JSON does not have, ValueError for numbers that are not finite.
    """
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _number_text(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(map(canonical_json, value))}]"
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        entries = (f"{canonical_json(key)}:{canonical_json(value[key])}" for key in sorted(value))
        return f"{{{','.join(entries)}}}"
    raise TypeError(f"a calibration file holds no {type(value).__name__}, and its keys are texts")


def _number_text(number: float) -> str:
    """The shortest text, with an exponent below 1e-5 and from 1e16: Python's own begins one power earlier."""
    if not math.isfinite(number):
        raise ValueError(f"{number} is not a finite number")
    text = float.__repr__(number)
    mantissa, _, exponent = text.partition("e")
    if not exponent:
        return text
    power = int(exponent)
    return f"{Decimal(text):f}" if power == -5 else f"{mantissa}e{power}"


def check_plain(plain: dict[str, Any], where: str) -> None:
    """Check what `verified_plain` returned as `read_calibration` does, without msgspec.

    CalibrationFileError says what is wrong.
    """
    if wrong := wrong_field(plain):
        raise CalibrationFileError(path=where, why=wrong)
    check_result(plain, where)


def check_result(plain: dict[str, Any], where: str) -> None:
    """Check that a result is consistent, else raise CalibrationFileError (code `contradiction`).

    plain: whose fields are of the kinds that they must be of.
    """
    with np.errstate(all="ignore"):  # huge numbers end as a contradiction
        wrong = _wrong_result(plain) or _wrong_arm(plain.get("arm_table"))
    if wrong:
        raise CalibrationFileError("contradiction", path=where, why=wrong)


def _wrong_result(plain: dict[str, Any]) -> str:
    """Say why X and its covariance cannot be; empty: they can."""
    result, mount = plain["result"], plain["mount"]
    parent = "flange" if mount == "eye-in-hand" else "base"
    if (result["parent_frame"], result["child_frame"]) != (parent, "camera"):
        return f"{mount} with {result['parent_frame']}_from_{result['child_frame']}"
    matrix = _square(result["matrix"], 4)
    quaternion = np.array(result["rotation_xyzw"], float)
    if matrix is None or not is_rigid(matrix) or not abs(np.linalg.norm(quaternion) - 1) <= 1e-6:
        return "the result is not a rigid transform"
    turned = np.abs(matrix_from_quaternion(quaternion) - matrix[:3, :3]).max()
    shifted = np.abs(matrix[:3, 3] - np.array(result["translation_m"], float)).max()
    if not (turned <= 1e-9 and shifted <= 1e-12):
        return "matrix, translation and quaternion do not agree"
    covariance = _square(plain["covariance"], 6)
    if covariance is None:
        return "the covariance is not 6 × 6 finite numbers"
    rounding = 1e-9 * float(np.abs(covariance).max())
    asymmetry = np.abs(covariance - covariance.T).max()
    if not asymmetry <= rounding or not _least_eigenvalue(covariance) >= -rounding:
        return "the covariance is not symmetric and positive"
    return ""


def _square(rows: list[list[float]], size: int) -> Array | None:
    """The rows as a matrix (size, size); None where they are another one, or not finite."""
    if len(rows) != size or any(len(row) != size for row in rows):
        return None
    matrix = np.array(rows, float)
    return matrix if np.isfinite(matrix).all() else None


def _least_eigenvalue(symmetric: Array) -> float:
    try:
        return float(np.linalg.eigvalsh(symmetric).min())
    except np.linalg.LinAlgError:
        return math.nan


def _wrong_arm(table: dict[str, Any] | None) -> str:
    """Say why the corrected arm and its X cannot be; empty: they can."""
    if table is None:
        return ""
    nominal = [table.get(key) is not None for key in ("nominal", "learned")]
    corrected = [table.get(key) is not None for key in ("corrected", "corrected_chain")]
    X = table.get("result")
    frames = None if X is None else (X["parent_frame"], X["child_frame"])
    known = frames in (("corrected_flange", "camera"), ("corrected_base", "camera"))
    if not table["offered"] == known == (X is not None) or sum(nominal) != 1:
        return "the corrected arm and its X do not belong together"
    if corrected != (nominal if table["offered"] else [False, False]):
        return "the corrected arm is of another kind than the nominal one"
    return ""
