"""Puts together the calibration document from everything a solve found."""

from __future__ import annotations

import platform
import sys
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from typing import Any

import msgspec
import numpy as np

from calibrate.boards.model import ambiguity_text
from calibrate.files.calibration import (
    FORMAT,
    Arm,
    BoardFound,
    Calibration,
    Folds,
    FramePose,
    Gate,
    Holdout,
    Lens,
    Proof,
    Provenance,
    Quality,
    Rejected,
    Session,
    Sigma,
    TableError,
    ViewQuality,
    Views,
    ViewWeight,
)
from calibrate.handeye.solution import Remark, Solution
from calibrate.lens.intrinsics import Intrinsics
from calibrate.lens.pnp import view_rms_px
from calibrate.lens.uncertainty import LensUncertainty
from calibrate.load import LoadedViews
from calibrate.options import JobOptions
from calibrate.projection import intrinsics_names
from calibrate.views import ViewSet
from recordings.reader import Recording

_PACKAGES = ("calibration-station", "numpy", "scipy", "opencv-python-headless", "clarabel")


def make_calibration(
    recording: Recording,
    loaded: LoadedViews,
    views: ViewSet,
    intrinsics: Intrinsics | None,
    solution: Solution,
    gates: tuple[Gate, ...],
    options: JobOptions,
    lens_known: LensUncertainty | None = None,
) -> Calibration:
    info = recording.info
    return Calibration(
        format=FORMAT,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        source=info.source,
        mount=solution.mount,
        result=FramePose.of(solution.parent_from_child),
        sigma=Sigma(solution.sigma_translation_m * 1e3, float(np.degrees(solution.sigma_rotation_rad))),
        covariance=tuple(tuple(row) for row in solution.covariance.tolist()),
        confidence_threshold=float(solution.confidence_threshold),
        board_place=FramePose.of(solution.board_place),
        intrinsics=_lens(views, intrinsics, solution),
        board=loaded.board,
        robot=info.robot,
        camera=info.camera_identity,
        views=Views(
            used=list(solution.used),
            rejected=sorted(
                (
                    Rejected(r.index, r.name, r.reason, r.kind)
                    for r in (*loaded.without_board, *solution.rejected)
                ),
                key=lambda r: r.index,
            ),
            turned=list(solution.turned),
            weights=[ViewWeight(i, round(w, 4)) for i, w in solution.weights.items() if w < 0.9999],
        ),
        quality=_quality(solution, gates, loaded, intrinsics, lens_known),
        provenance=Provenance(
            recording=recording.path.name,
            recording_sha256=recording.sha256,
            session=info.name,
            software=software_versions(),
            profile=solution.profile,
            seed=solution.seed,
            options=_options(options),
            recorded_wall_ns=info.created_wall_ns,
            plan_sha256=info.plan_sha256,
        ),
    )


def software_versions() -> dict[str, str]:
    return dict(_software_versions())


@cache
def _software_versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": f"{sys.platform} {platform.machine()}"}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def _options(options: JobOptions) -> dict[str, Any]:
    """The choices that differ from the defaults, except how many threads worked."""
    default = type(options)()
    return {
        name: msgspec.to_builtins(getattr(options, name))
        for name in vars(options)
        if name not in ("threads", "profile", "seed") and getattr(options, name) != getattr(default, name)
    }


def _lens(views: ViewSet, intrinsics: Intrinsics | None, solution: Solution) -> Lens:
    camera = solution.camera
    if intrinsics is not None:
        rms_px = intrinsics.rms_px
    else:
        squares = [view_rms_px(v, views.camera, v.camera_from_board) ** 2 for v in views]  # type: ignore[arg-type]
        rms_px = float(np.sqrt(np.mean(squares)))
    return Lens(
        width=camera.width,
        height=camera.height,
        matrix=camera.matrix or (),
        distortion=camera.distortion,
        distortion_model=camera.distortion_model,
        rms_px=rms_px,
        found="given" if intrinsics is None else "from these pictures",
        sigma=_lens_sigma(solution),
    )


def _quality(
    solution: Solution,
    gates: tuple[Gate, ...],
    loaded: LoadedViews,
    intrinsics: Intrinsics | None,
    lens_known: LensUncertainty | None,
) -> Quality:
    proof, noise = solution.certificate, solution.noise
    remarks = _remarks(solution, loaded, intrinsics)
    return Quality(
        gates=list(gates),
        certificate=Proof(
            proof.certified,
            float(proof.relative_gap),
            float(proof.objective),
            proof.distance_sigma,
            proof.problem,
        ),
        holdout=_holdout(solution),
        rms_px=solution.rms_px,
        views=[_view_quality(index, solution) for index in solution.used],
        board_spread_mm=_scaled(solution.board_spread_m, 1e3),
        board_spread_deg=_scaled(solution.board_spread_rad, float(np.degrees(1.0))),
        predicted_error_mm=_scaled(solution.predicted_error_m, 1e3),
        working_distance_m=solution.working_distance_m,
        projection_sigma_px={} if lens_known is None else lens_known.figures,
        noise={}
        if noise is None
        else {
            "corner_px": noise.corner_px,
            "robot_mm": noise.robot_m * 1e3,
            "robot_deg": float(np.degrees(noise.robot_rad)),
        },
        error_shares=solution.error_shares,
        weakest=solution.observability.weakest_text,
        board_scale=None if solution.board is None else 1.0 + solution.board.scale,
        board=None if solution.board is None else BoardFound(**vars(solution.board)),
        cross_validation=_folds(solution),
        session=Session(solution.session.reading.value, _session_text(solution)),
        arm=_arm(solution),
        warnings=[remark.text for remark in remarks],
        warning_codes=[remark.code for remark in remarks],
    )


def _remarks(solution: Solution, loaded: LoadedViews, intrinsics: Intrinsics | None) -> list[Remark]:
    ambiguity = ambiguity_text(loaded.board)
    return [
        *(Remark("recording-loss", loss) for loss in loaded.losses),
        *([Remark("symmetric-board", ambiguity)] if ambiguity else []),
        *(
            Remark("view-left-out-of-lens", f"View {i + 1} left out of the first lens: {why}.")
            for i, why in (intrinsics.dropped if intrinsics else {}).items()
        ),
        *solution.warnings,
    ]


def _session_text(solution: Solution) -> str:
    code = solution.session.reading.value
    return next((remark.text for remark in solution.warnings if remark.code == code), "")


def _lens_sigma(solution: Solution) -> dict[str, float]:
    if solution.lens_covariance is None:
        return {}
    sigma = np.sqrt(np.maximum(np.diag(solution.lens_covariance), 0.0)).tolist()
    return dict(zip(intrinsics_names(solution.camera), sigma, strict=True))


def _folds(solution: Solution) -> Folds | None:
    found = solution.cross_validation
    if found is None:
        return None
    return Folds(found.rms_m * 1e3, float(np.degrees(found.rms_rad)), found.claimed_m * 1e3, found.folds)


def _arm(solution: Solution) -> Arm | None:
    arm = solution.arm
    if arm is None:
        return None
    table = [TableError(name, value, sigma) for name, (value, sigma) in arm.errors.items()]
    return Arm(arm.detected, arm.log_bayes, arm.size_mm, table)


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else float(value * factor)


def _view_quality(index: int, solution: Solution) -> ViewQuality:
    rms_px = solution.residual_px.get(index)
    metres, radians = solution.residual_robot.get(index, (None, None))
    return ViewQuality(index, rms_px, _scaled(metres, 1e3), _scaled(radians, float(np.degrees(1.0))))


def _holdout(solution: Solution) -> Holdout | None:
    score = solution.holdout
    if score is None:
        return None
    return Holdout(
        e_t_m=float(score.e_t_m),
        e_R=float(score.e_R),
        samples_e_t_m=np.asarray(score.samples_e_t_m, dtype=float).tolist(),
        samples_e_R=np.asarray(score.samples_e_R, dtype=float).tolist(),
        pairs=[(int(i), int(j)) for i, j in score.pairs],
        fitted_views=score.fitted_views,
        note=score.note,
    )
