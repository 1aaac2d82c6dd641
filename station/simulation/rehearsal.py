"""A rehearsal: the user's own configuration with a simulated arm and a rendered camera in place of devices.

The guesses are taken for what they say they are: the simulated cell is drawn within their sigmas. No address
of the configuration is ever used.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np

from calibrate.geometry import perturb
from recordings.schema.messages import CameraModel
from station.cell.config import PoseGuess, StationConfig, matrix4, vector6
from station.cell.scene import guess_matrix, require_kept_clear, scene_of
from station.devices.cell import Cell
from station.plan.planner import PlanOptions, candidate_pool
from station.simulation.camera import RenderedCamera
from station.simulation.cell import CellTruth
from station.simulation.launch_cell import start_cell

FOLDER = "rehearsal"
"""Below the state folder: nothing of a rehearsal lies beside what is real."""
ATTACHMENT = "rehearsal.json"
REPEATABILITY_M, REPEATABILITY_RAD = 1e-4, 1.7e-4
"""1σ per axis: an arm as UR states it (± 0.1 mm)."""
_WITHIN = 1.5
"""Sigmas of a guess that the simulated cell is at most away from it."""
_FOCAL_SHARE, _K1 = 0.02, -0.05
"""Deviations of a lens that is roughly known: focal length either way, radial distortion."""
_NORMAL_EXPOSURE_US = 10_000.0


def rehearsed_cell(config: StationConfig, path: str, folder: Path, seed: int = 0) -> Cell:
    """Start the simulated devices of a configuration; blocking (seconds).

    `path`: of the configuration's file. `folder` takes the truth and logs. Raises ConfigError
    where planning lacks something, LimitError where the board cannot be looked at, StationError.
    """
    from station.devices.ur import UrRobot

    truth = truth_within(config, seed)
    ends = ExitStack()
    host, attachments = start_cell(truth, folder, ends)
    simulated = without_devices(config, host)
    about = {
        "configuration": Path(path).name,
        "robot_sigma_mm": 1e3 * REPEATABILITY_M,
        "robot_sigma_deg": float(np.degrees(REPEATABILITY_RAD)),
    }
    return Cell(
        config=simulated,
        robot=UrRobot(simulated.robot, folder),
        camera=RenderedCamera(truth, host, simulated.camera),
        source="simulated",
        config_path=path,
        attachments=attachments | {ATTACHMENT: json.dumps(about).encode()},
        ended=ends.close,
    )


def without_devices(config: StationConfig, host: str) -> StationConfig:
    """The configuration with the controller at `host` and no other device of it.

    Limits, board, guesses, approval and goals stay. The factory's kinematic corrections are of the real arm.
    """
    robot = msgspec.structs.replace(config.robot, host=host, serial="", kinematics=None)
    camera = msgspec.structs.replace(
        config.camera, driver="rendered", device="", trigger="software", frame_rate_hz=None, region=None
    )
    return msgspec.structs.replace(config, robot=robot, camera=camera, trigger=None)


def truth_within(config: StationConfig, seed: int) -> CellTruth:
    """Draw a cell that the configuration describes rightly, its arm where the camera sees the board."""
    require_kept_clear(config)
    scene = scene_of(config)
    assert config.camera_guess is not None and config.board_guess is not None  # scene_of wants both
    rng = np.random.default_rng([22, seed])
    group, _ = candidate_pool(scene, PlanOptions(seed=seed), None, rng)
    middle = np.abs(group.joints_rad - np.median(group.joints_rad, axis=0)).max(axis=1).argmin()
    camera = config.camera
    return CellTruth(
        scene=FOLDER,
        seed=seed,
        mount=config.mount,
        robot_model=config.robot.model,
        board=config.board,
        camera=_lens_within(scene.camera, camera.model_is_rough, rng),
        camera_mount=matrix4(_within(config.camera_guess, rng)),
        board_place=matrix4(_within(config.board_guess, rng)),
        start_joints_rad=vector6(group.joints_rad[middle]),
        robot_sigma_m=REPEATABILITY_M,
        robot_sigma_rad=REPEATABILITY_RAD,
        # Exposure and gain are taken to be right for the cell's light.
        illumination=_NORMAL_EXPOSURE_US / camera.exposure_us * 10 ** (-camera.gain_db / 20),
        exposure_us=camera.exposure_us,
        gain_db=camera.gain_db,
    )


def _within(guess: PoseGuess, rng: np.random.Generator) -> np.ndarray:
    sigmas = np.repeat([guess.sigma_m, guess.sigma_rad], 3)
    return np.asarray(perturb(guess_matrix(guess), sigmas * np.clip(rng.normal(size=6), -_WITHIN, _WITHIN)))


def _lens_within(camera: CameraModel, rough: bool, rng: np.random.Generator) -> CameraModel:
    """The lens as it is stated; one that is rough differs a little."""
    if not rough:
        return camera
    K = np.array(camera.matrix)
    K[[0, 1], [0, 1]] *= 1 + rng.uniform(-_FOCAL_SHARE, _FOCAL_SHARE)
    matrix = tuple(tuple(float(value) for value in row) for row in K)
    return msgspec.structs.replace(
        camera, matrix=matrix, distortion=camera.distortion or (_K1, 0.0, 0.0, 0.0, 0.0)
    )
