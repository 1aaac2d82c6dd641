"""Put together the calibration document from everything a solve found."""

from __future__ import annotations

import hashlib
import platform
import sys
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibrate.boards.model import ambiguity_text
from calibrate.files.calibration import (
    FORMAT,
    Calibration,
    Lens,
    Provenance,
    Quality,
    SessionReading,
    Sigma,
)
from calibrate.files.validity import time_text
from calibrate.handeye.arm_table import FramePose
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.solution import Judgement, Solution
from calibrate.lens.intrinsics import Intrinsics
from calibrate.lens.pnp import view_rms_px
from calibrate.pipeline.recorded_views import LoadedViews
from calibrate.results import Gate, Remark, Views, ViewWeight
from calibrate.views.projection import intrinsics_names
from calibrate.views.view_set import ViewSet
from recordings.geometry import Transform
from recordings.plain_text import plain_text
from recordings.reader import Recording
from recordings.schema.messages import BoardKind
from recordings.software import software_versions

_PACKAGES = ("calibration-station", "numpy", "scipy", "opencv-python-headless", "clarabel")


def make_calibration(
    recording: Recording,
    loaded: LoadedViews,
    views: ViewSet,
    intrinsics: Intrinsics | None,
    solution: Solution,
    gates: tuple[Gate, ...],
    options: dict[str, Any],
) -> Calibration:
    """`options`: the choices that differ from the defaults."""
    info = recording.info
    cell = solution.fit
    X, covariance = cell.installed
    frames = cell.parent_from_child
    return Calibration(
        format=FORMAT,
        created=time_text(),
        source=info.source,
        mount=cell.mount,
        result=FramePose.of(Transform(frames.parent, frames.child, X)),
        sigma=Sigma.of(covariance),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        confidence_threshold=float(cell.confidence_threshold),
        board_place=FramePose.of(cell.board_place),
        intrinsics=_lens(views, intrinsics, solution),
        board=loaded.board,
        robot=info.robot,
        camera=info.camera_identity,
        views=_views(solution.evidence.views, loaded),
        quality=_quality(solution, gates, loaded, intrinsics),
        provenance=Provenance(
            recording=plain_text(recording.path.name),
            recording_sha256=recording.sha256,
            session=info.name,
            software=solver_software(),
            profile=solution.profile,
            seed=solution.seed,
            options=options,
            recorded_wall_ns=info.created_wall_ns,
            plan_sha256=info.plan_sha256,
        ),
        arm_table=None if cell.arm is None else cell.arm.result,
        posterior=cell.posterior,
    )


def solver_software() -> dict[str, str]:
    """Machine, Python and the packages that a result depends on; of a changed checkout the source too."""
    return {
        **software_versions(*_PACKAGES),
        "source": _source_sha256()[:12],
        "machine": f"{sys.platform} {platform.machine()}",
    }


@cache
def _source_sha256() -> str:
    """Hash the modules that make a result: in a checkout they change without the version."""
    digest, root = hashlib.sha256(), Path(__file__).parents[2]
    for path in sorted(root.glob("calibrate/**/*.py")) + sorted(root.glob("recordings/**/*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def _views(views: Views, loaded: LoadedViews) -> Views:
    """Add the views that never reached the solver, and round the weights."""
    rejected = sorted((*loaded.without_board, *views.rejected), key=lambda view: view.index)
    weights = [ViewWeight(view.index, round(view.weight, 4)) for view in views.weights]
    return msgspec.structs.replace(views, rejected=rejected, weights=weights)


def _lens(views: ViewSet, intrinsics: Intrinsics | None, solution: Solution) -> Lens:
    camera = solution.fit.camera
    covariance = solution.fit.lens_covariance
    sigma = [] if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    if not solution.evidence.rms_px:  # board poses were told: nothing is known of the lens
        return Lens(0, 0, (), (), camera.distortion_model, None, "not known")
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
        sigma=dict(zip(intrinsics_names(camera), sigma, strict=False)),
    )


def _session(judgement: Judgement) -> SessionReading:
    session = judgement.session
    code = session.reading.value
    text = next((remark.text for remark in judgement.warnings if remark.code == code), "")
    others = [reading.value for reading in session.readings[1:]]
    if session.numbers is None:
        return SessionReading(code, text, others)
    changed_from, first, last = session.numbers
    return SessionReading(code, text, others, changed_from, (first, last))


def _quality(
    solution: Solution,
    gates: tuple[Gate, ...],
    loaded: LoadedViews,
    intrinsics: Intrinsics | None,
) -> Quality:
    cell = solution.fit
    judgement = solution.judgement
    remarks = _remarks(solution, loaded, intrinsics)
    return Quality(
        **msgspec.structs.asdict(judgement.figures),
        gates=list(gates),
        views=list(solution.evidence.residuals),
        noise=_noise(cell.noise),
        weakest=judgement.observability.weakest_text,
        board=cell.board,
        session=_session(judgement),
        arm=None if cell.arm is None else cell.arm.stated,
        warnings=[remark.text for remark in remarks],
        warning_codes=[remark.code for remark in remarks],
    )


def _noise(noise: MeasurementNoise | None) -> dict[str, float]:
    if noise is None:
        return {}
    return {
        "corner_px": noise.corner_px,
        "robot_mm": 1e3 * noise.robot_m,
        "robot_deg": float(np.degrees(noise.robot_rad)),
    }


def _remarks(solution: Solution, loaded: LoadedViews, intrinsics: Intrinsics | None) -> list[Remark]:
    unseen = loaded.board.kind is BoardKind.UNSEEN
    ambiguity = "" if unseen else ambiguity_text(loaded.board)
    return [
        *([Remark("no-pictures", _NO_PICTURES)] if unseen else []),
        *(Remark("recording-loss", loss) for loss in loaded.losses),
        *([Remark("symmetric-board", ambiguity)] if ambiguity else []),
        *(
            Remark("view-left-out-of-lens", f"View {i + 1} excluded from the first intrinsics: {why}.")
            for i, why in (intrinsics.dropped if intrinsics else {}).items()
        ),
        *solution.judgement.warnings,
    ]


_NO_PICTURES = (
    "No pictures: the board's poses were told. Not known, and judged by no gate: lens, image coverage, "
    "reprojection, corners taken for others."
)
