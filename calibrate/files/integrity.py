"""Verification of a calibration file: hash and consistency of the result. Needs only NumPy and PyYAML."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from calibrate.errors import CalibrationFileError
from calibrate.files.folders import VERSION_NAME
from recordings import strict_yaml
from recordings.files import read_beginning
from recordings.geometry import is_rigid, matrix_from_quaternion

FORMATS = ("handeye-calibration/1", "handeye-calibration/2")
"""The second adds `posterior`."""
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
    digits = match[2].encode()
    of_before = _HASH_LINE.search(content)  # earlier versions of the software took them from this line
    if hashlib.sha256(content).hexdigest()[:8].encode() != digits and (
        of_before is None or of_before[1] != digits
    ):
        why = "it is not the file that was installed by this name: another one was copied over it"
        raise CalibrationFileError("damaged-calibration", path=path, why=why)


_HASH_LINE = re.compile(rb"^sha256: '?([0-9a-f]{8})", re.MULTILINE)


def verified_plain(content: bytes, where: str) -> dict[str, Any]:
    """Parse a calibration file to plain data without `sha256`, after verifying its hash.

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
            return plain
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

    TypeError for types that JSON does not have.
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return _STRING_OR_POWER.sub(_as_msgspec_writes, text)


_STRING_OR_POWER = re.compile(r'"(?:[^"\\]|\\.)*"|-?[\d.]+e[+-]\d+')


def _as_msgspec_writes(found: re.Match[str]) -> str:
    """Strings as they are; 1e-05 as 0.00001, 1e+16 as 1e16."""
    mantissa, _, exponent = found[0].partition("e")
    if found[0].startswith('"'):
        return found[0]
    return f"{Decimal(found[0]):f}" if int(exponent) == -5 else f"{mantissa}e{int(exponent)}"


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
        np.abs(matrix_from_quaternion(quaternion) - matrix[:3, :3]).max() > 1e-9
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
    if wrong:
        raise CalibrationFileError("contradiction", path=where, why=wrong)
