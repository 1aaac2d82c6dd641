"""Verification of a calibration file: hash and consistency of the result. Needs only NumPy and PyYAML."""

from __future__ import annotations

import hashlib
import shlex
from json.encoder import encode_basestring
from pathlib import Path
from typing import Any

import numpy as np

from calibrate.errors import CalibrationFileError
from calibrate.geometry import Array, is_rigid, skew
from calibrate.kinematics import TABLE_COLUMNS
from recordings import strict_yaml
from recordings.files import read_beginning

FORMAT_NAME = "handeye-calibration/1"
_MCAP = b"\x89MCAP"
_LIMIT_BYTES = 4 * 1024 * 1024


def read_bounded(path: Path) -> bytes:
    """Read a file, at most one byte over the size limit. CalibrationFileError where it cannot be read."""
    try:
        return read_beginning(path, _LIMIT_BYTES + 1)
    except OSError as problem:
        raise CalibrationFileError(path=path, why=problem.strerror or str(problem)) from None


_GIVE = "Give one that `calibrate solve` wrote."


def proven_plain(content: bytes, where: str) -> dict[str, Any]:
    """Parse a calibration file to plain data without `sha256`, after verifying hash and result.

    CalibrationFileError says what is wrong.
    """
    if content.startswith(_MCAP):
        raise CalibrationFileError(
            "not-a-calibration",
            path=where,
            why="it is a recording",
            advice=f"First run: calibrate solve {shlex.quote(where)}",
        )
    if len(content) > _LIMIT_BYTES:
        raise CalibrationFileError(
            "not-a-calibration",
            path=where,
            why="it is larger than any",
            advice=_GIVE,
            size_bytes=len(content),
            limit_bytes=_LIMIT_BYTES,
        )
    try:
        plain = strict_yaml.load_plain(content)
    except strict_yaml.StrictYamlError as problem:
        raise CalibrationFileError("damaged-calibration", path=where, why=str(problem)) from None
    if not isinstance(plain, dict) or plain.get("format") != FORMAT_NAME:
        found = plain.get("format") if isinstance(plain, dict) else None
        raise CalibrationFileError(
            "not-a-calibration",
            path=where,
            why=f"format is {found!r}, expected {FORMAT_NAME!r}",
            advice=_GIVE,
        )
    try:
        hash_now = content_sha256(plain)
    except (TypeError, ValueError) as problem:
        raise CalibrationFileError("damaged-calibration", path=where, why=str(problem)) from None
    if plain.pop("sha256", None) != hash_now:
        raise CalibrationFileError("damaged-calibration", path=where, why="the content does not fit its hash")
    return plain


def content_sha256(plain: dict[str, Any]) -> str:
    """Compute the hash over everything but `sha256` and `created`, independent of layout."""
    content = {key: value for key, value in plain.items() if key not in ("sha256", "created")}
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def canonical_json(value: object) -> str:
    """Encode as JSON with sorted keys and no spaces, as `msgspec.json.encode(order="deterministic")` does.

    TypeError for types that JSON does not have, ValueError for keys that are not text.
    """
    if isinstance(value, str):
        return str(encode_basestring(value))
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(map(canonical_json, value))}]"
    if isinstance(value, dict):
        if not all(isinstance(key, str) for key in value):
            raise ValueError("a key is no text")
        return f"{{{','.join(f'{canonical_json(k)}:{canonical_json(value[k])}' for k in sorted(value))}}}"
    raise TypeError(f"{type(value).__name__} is no JSON")


def _number(value: float) -> str:
    """Format with the shortest digits that read back as `value`; 1e-5 as 0.00001, 1e16 without a +."""
    mantissa, _, exponent = repr(value).partition("e")
    if not exponent:
        return mantissa if np.isfinite(value) else "null"
    if int(exponent) == -5:
        sign = "-" if mantissa.startswith("-") else ""
        return f"{sign}0.0000{mantissa.lstrip('-').replace('.', '')}"
    return f"{mantissa}e{int(exponent)}"


def check_result(plain: dict[str, Any], where: str) -> None:
    """Check that a result is consistent, else raise CalibrationFileError (code `contradiction`)."""
    result, mount = plain["result"], plain["mount"]
    matrix, quaternion, translation, covariance = (
        np.array(value, float)
        for value in (
            result["matrix"],
            result["rotation_xyzw"],
            result["translation_m"],
            plain["covariance"],
        )
    )
    parent = "flange" if mount == "eye-in-hand" else "base"
    wrong = ""
    if (result["parent_frame"], result["child_frame"]) != (parent, "camera"):
        wrong = f"{mount} with {result['parent_frame']}_from_{result['child_frame']}"
    elif matrix.shape != (4, 4) or not is_rigid(matrix) or abs(np.linalg.norm(quaternion) - 1) > 1e-6:
        wrong = "the result is not a rigid transform"
    elif (
        np.abs(_rotation(quaternion) - matrix[:3, :3]).max() > 1e-9
        or np.abs(matrix[:3, 3] - translation).max() > 1e-12
    ):
        wrong = "matrix, translation and quaternion do not agree"
    elif covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        wrong = "the covariance is not 6 × 6 finite numbers"
    else:
        rounding = 1e-9 * float(np.abs(covariance).max())
        asymmetry = np.abs(covariance - covariance.T).max()
        if asymmetry > rounding or np.linalg.eigvalsh(covariance).min() < -rounding:
            wrong = "the covariance is not symmetric and positive"
    wrong = wrong or _wrong_table(plain.get("arm_table"), parent)
    if wrong:
        raise CalibrationFileError("contradiction", path=where, why=wrong)


def _wrong_table(arm: dict[str, Any] | None, parent: str) -> str:
    """Say what is wrong with an offered table of the arm; empty when nothing is."""
    if arm is None or not (arm["offered"] or arm.get("result") or arm.get("corrected")):
        return ""
    result = arm.get("result") or {}
    frames = (result.get("parent_frame"), result.get("child_frame"))
    if not arm["offered"] or not arm.get("corrected") or frames != (f"corrected_{parent}", "camera"):
        return "the arm's table and its X do not belong together"
    numbers = [np.array(arm["corrected"][key], float) for key in TABLE_COLUMNS]
    if not is_rigid(np.array(result["matrix"], float)) or not all(
        column.shape == (6,) and np.isfinite(column).all() for column in numbers
    ):
        return "the arm's table or its X holds impossible numbers"
    return ""


def _rotation(quaternion_xyzw: Array) -> Array:
    """Convert a unit quaternion (4,): R = (w² - v·v) I + 2 v vᵀ + 2 w [v]× (Kuipers 1999, eq. 5.11)."""
    v, w = quaternion_xyzw[:3], quaternion_xyzw[3]
    return np.asarray((w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * skew(v))


def refused_table(reason: str) -> CalibrationFileError:
    """Make the error for a calibration that offers no table of the arm."""
    return CalibrationFileError("table-not-offered", reason=reason)
