"""What the solve learnt of the cell besides X, in sentences: the board, and what limits X."""

from __future__ import annotations

from collections.abc import Iterator

from calibrate.files.calibration import BoardFound, Calibration

_SAID = 3.0
"""Sigmas from which a finding is told."""
_COSTLY = 0.2
"""Share of X's variance from which its source is named with its remedy."""
_REMEDIES = {
    "intrinsics": "calibrate the lens from more pictures",
    "board": "measure the board and state its tolerance (square_tolerance, flatness_m)",
    "kinematics": "have the arm calibrated",
    "corners": "take better or more pictures",
    "robot_translation": "take more poses",
    "robot_rotation": "take more poses",
}


def cell_sentences(calibration: Calibration) -> list[str]:
    """One sentence for each thing worth knowing, most telling first."""
    quality = calibration.quality
    sentences: list[str] = []
    if quality.board is not None:
        sentences += _board(quality.board, calibration.board.square_m * 1e3)
    shares = sorted(quality.error_shares.items(), key=lambda item: -item[1])
    if shares and shares[0][1] > _COSTLY and (name := shares[0][0]) in _REMEDIES:
        label = name.replace("_", " ")
        sentences.append(
            f"{label.capitalize()} make up {shares[0][1]:.0%} of the variance: {_REMEDIES[name]}."
        )
    return sentences


def _board(board: BoardFound, square_mm: float) -> Iterator[str]:
    if abs(board.scale) > _SAID * board.sigma[0]:
        size = square_mm * (1 + board.scale)
        yield (
            f"The board's squares are {size:.3f} ± {square_mm * board.sigma[0]:.3f} mm, "
            f"{square_mm:g} mm are stated."
        )
    if abs(board.anisotropy) > _SAID * board.sigma[1]:
        wider = "wider than tall" if board.anisotropy > 0 else "taller than wide"
        yield f"The print is {abs(board.anisotropy):.2%} {wider}."
    bends = [b for b, sigma in zip(board.bend_m, board.sigma[2:], strict=True) if abs(b) > _SAID * sigma]
    if bends:
        yield f"The board is bent by {max(map(abs, bends)) * 1e3:.2f} mm."
