"""Complete simulated cells for the daemon: controller process, real driver, rendered camera.

In a rehearsal, of the user's own configuration: the true poses are drawn within the sigmas of the configured
initial poses, and no address in the configuration is ever used.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np

from recordings.geometry import Array, base_from_flange, perturb
from recordings.schema.messages import CameraModel
from station.cell.config import PoseGuess, StationConfig, matrix4, vector6
from station.cell.layout import guess_matrix, known_places, layout_of, require_kept_clear
from station.devices.base import Camera
from station.devices.cell import Cell
from station.devices.ur import UrRobot
from station.plan.planner import PlanOptions, candidate_pool
from station.simulation.camera import RenderedCamera
from station.simulation.launch import start_controller
from station.simulation.truth import CellTruth, Light, write_truth

GIGE_PACKET_BYTES = 8996
TRUTH = "truth.json"


def simulated_cell(
    truth: CellTruth,
    config: StationConfig,
    folder: Path,
    *,
    time_scale: float = 1.0,
    gige: bool = False,
    path: str = "",
    attachments: dict[str, bytes] | None = None,
) -> Cell:
    """Make a cell that is as `truth` says and start its controller; blocking (a second). Raises StationError.

    `config`: its configuration, but for the controller's address; `path`: its file. `folder` takes truth and
    logs. `time_scale`: speed of simulated time; above 1 in tests only. `gige`: simulate the
    camera over GigE Vision, in a network namespace with only `lo`. `attachments`: of every recording, besides
    the truth.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file, log = folder / TRUTH, folder / "controller.log"
    content = write_truth(truth, file)
    with ExitStack() as ends:
        controller = start_controller(truth.robot_model, truth=file, time_scale=time_scale, log=log)
        camera: Camera
        robot = msgspec.structs.replace(config.robot, host=ends.enter_context(controller).host)
        config = msgspec.structs.replace(config, robot=robot)
        if gige:
            # The simulator has no test packets to negotiate a packet size with; loopback carries the largest.
            changes = {"driver": "aravis", "device": "127.0.0.1", "packet_size": GIGE_PACKET_BYTES}
            seen = msgspec.structs.replace(config.camera, **changes)
            config = msgspec.structs.replace(config, camera=seen)
            camera = _gige(config, truth, folder, ends)
        else:
            camera = RenderedCamera(truth, config.robot.host, config.camera)
        started = ends.pop_all()
    driver = UrRobot(config.robot, folder)
    return Cell(
        config=config,
        arm=driver.link,
        mover=driver,
        camera=camera,
        source="simulated",
        config_path=path,
        attachments={TRUTH: content} | (attachments or {}),
        ended=started.close,
    )


def _gige(config: StationConfig, truth: CellTruth, folder: Path, ends: ExitStack) -> Camera:
    from station.devices.aravis import AravisCamera
    from station.simulation.launch import start_gige

    serial, log = f"SIM{truth.seed:05d}", folder / "camera.log"
    ends.enter_context(start_gige(config.robot.host, folder / TRUTH, serial, log))
    return AravisCamera(config.camera)


FOLDER = "rehearsal"
"""Subfolder of the state folder, which keeps rehearsals apart from real data."""
ATTACHMENT = "rehearsal.json"
REPEATABILITY_M, REPEATABILITY_RAD = 1e-4, 1.7e-4
"""Repeatability of the simulated arm, 1σ per axis, as stated by UR (± 0.1 mm)."""
_WITHIN = 1.5
"""Largest distance of the simulated from the configured poses, in sigmas."""
_FOCAL_SHARE, _K1 = 0.02, -0.05
"""Deviation of a roughly known lens: relative focal length (either sign), radial distortion."""
_NORMAL_EXPOSURE_US = 10_000.0


def rehearsed_cell(config: StationConfig, path: str, folder: Path, control: Path, seed: int = 0) -> Cell:
    """Start the simulated devices of a configuration; blocking (seconds).

    `path`: of the configuration's file. `folder` takes the truth and logs. `control`: path of the control
    socket. Raises ConfigError where planning lacks something, LimitError where the board cannot be looked at,
    StationError. A posted arm stays one: its program declares that its poses are simulated.
    """
    truth, simulated = truth_within(config, seed), without_devices(config)
    if config.robot.driver == "posted":
        return _posted_cell(simulated, path, folder, control, truth)
    about = {
        "configuration": Path(path).name,
        "robot_sigma_mm": 1e3 * REPEATABILITY_M,
        "robot_sigma_deg": float(np.degrees(REPEATABILITY_RAD)),
    }
    return simulated_cell(
        truth,
        simulated,
        folder,
        path=path,
        attachments={ATTACHMENT: json.dumps(about).encode()},
    )


def _posted_cell(config: StationConfig, path: str, folder: Path, control: Path, truth: CellTruth) -> Cell:
    from station.devices.posted import PostedArm

    arm = PostedArm(config, "simulated", control)

    def flange() -> Array:
        return base_from_flange(arm.state().tcp_pose, arm.identity.tcp_offset)

    folder.mkdir(parents=True, exist_ok=True)
    attachments = {TRUTH: write_truth(truth, folder / TRUTH)}
    camera = RenderedCamera(truth, "", config.camera, flange=flange)
    return Cell(config, arm, camera, "simulated", config_path=path, attachments=attachments)


def without_devices(config: StationConfig) -> StationConfig:
    """Remove the devices from a configuration: addresses, serial number, trigger box; the camera is rendered.

    Limits, board, initial poses, approval and goals stay. Factory corrections of the real arm are removed.
    """
    robot = msgspec.structs.replace(config.robot, host="", serial="", kinematics=None)
    camera = msgspec.structs.replace(
        config.camera, driver="rendered", device="", trigger="software", region=None
    )
    return msgspec.structs.replace(config, robot=robot, camera=camera, trigger=None)


def truth_within(config: StationConfig, seed: int) -> CellTruth:
    """Draw a true cell that agrees with the configuration; its arm starts where the board is seen."""
    rng, camera = np.random.default_rng([22, seed]), config.camera
    lens, camera_guess, board_guess = known_places(config)
    start = np.zeros(6)
    if config.robot.driver == "ur":
        require_kept_clear(config)
        group, _ = candidate_pool(layout_of(config), PlanOptions(seed=seed), None, rng)
        middle = np.abs(group.joints_rad - np.median(group.joints_rad, axis=0)).max(axis=1).argmin()
        start = group.joints_rad[middle]
    return CellTruth(
        scene=FOLDER,
        seed=seed,
        mount=config.mount,
        robot_model=config.robot.model,
        board=config.board,
        camera=_lens_within(lens, camera.model_is_rough, rng),
        camera_mount=matrix4(_within(camera_guess, rng)),
        board_place=matrix4(_within(board_guess, rng)),
        start_joints_rad=vector6(start),
        robot_sigma_m=REPEATABILITY_M,
        robot_sigma_rad=REPEATABILITY_RAD,
        # Choose the light for which the configured exposure and gain are right.
        light=Light(
            camera.exposure_us,
            camera.gain_db,
            illumination=_NORMAL_EXPOSURE_US / camera.exposure_us * 10 ** (-camera.gain_db / 20),
        ),
    )


def _within(guess: PoseGuess, rng: np.random.Generator) -> np.ndarray:
    sigmas = np.repeat([guess.sigma_m, guess.sigma_rad], 3)
    return np.asarray(perturb(guess_matrix(guess), sigmas * np.clip(rng.normal(size=6), -_WITHIN, _WITHIN)))


def _lens_within(camera: CameraModel, rough: bool, rng: np.random.Generator) -> CameraModel:
    """Return the configured lens, slightly changed if it is only roughly known."""
    if not rough:
        return camera
    K = np.array(camera.matrix)
    K[[0, 1], [0, 1]] *= 1 + rng.uniform(-_FOCAL_SHARE, _FOCAL_SHARE)
    matrix = tuple(tuple(float(value) for value in row) for row in K)
    return msgspec.structs.replace(camera, matrix=matrix, distortion=camera.distortion or (_K1,))
