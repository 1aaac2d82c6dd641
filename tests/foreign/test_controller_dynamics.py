"""The simulated arm's masses and torques, judged by MuJoCo."""

from __future__ import annotations

import random

import numpy as np
import pytest

from station.simulation.controller.dynamics import DRIVES, ROTOR_KG_M2, Body, Posture
from station.simulation.controller.kinematics import TABLES, compose, forward, from_pose
from tests.foreign.judges import FOLDER, missing

LIBRARY = FOLDER / "python"


def _as_mjcf(model: str, payload: Body) -> str:
    """The same arm of Denavit-Hartenberg's frames and points with mass, joint by joint."""
    table, inner = TABLES[model], '<site name="flange"/>'
    for i in reversed(range(6)):
        a, d, alpha = table.a_m[i], table.d_m[i], table.alpha_rad[i]
        points = "".join(
            f'<body pos="{" ".join(map(str, b.place_m))}"><inertial pos="0 0 0" mass="{b.mass_kg}" '
            'diaginertia="1e-12 1e-12 1e-12"/></body>'
            for b in (*DRIVES[model].bodies, payload)
            if b.link == i + 1
        )
        inner = (
            '<body><inertial pos="0 0 0" mass="1e-12" diaginertia="1e-12 1e-12 1e-12"/>'
            f'<joint axis="0 0 1" armature="{ROTOR_KG_M2}"/>'
            f'<body pos="{a} 0 {d}" euler="{alpha} 0 0">{points}{inner}</body></body>'
        )
    return (
        '<mujoco><compiler angle="radian" inertiafromgeom="false" boundmass="0" boundinertia="0"/>'
        f'<option gravity="0 0 0"/><worldbody>{inner}</worldbody></mujoco>'
    )


@pytest.mark.parametrize("model", list(DRIVES))
def test_masses_coriolis_and_jacobians_are_those_of_mujoco(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not (LIBRARY / "mujoco").is_dir():
        missing("mujoco")
    monkeypatch.syspath_prepend(str(LIBRARY))
    import mujoco

    draw, payload = random.Random(1), Body(6, 2.5, (0.01, -0.02, 0.06))
    bodies = [*DRIVES[model].bodies, payload]
    arm = mujoco.MjModel.from_xml_string(_as_mjcf(model, payload))
    data = mujoco.MjData(arm)
    for _ in range(20):
        joints = tuple(draw.uniform(-3, 3) for _ in range(6))
        speeds = tuple(draw.uniform(-2, 2) for _ in range(6))
        data.qpos[:], data.qvel[:] = joints, speeds
        mujoco.mj_forward(arm, data)
        M = np.zeros((6, 6))
        mujoco.mj_fullM(arm, data, M)
        posture = Posture(TABLES[model], joints, speeds)
        np.testing.assert_allclose(posture.mass_matrix(bodies), M, atol=1e-9)
        np.testing.assert_allclose(posture.coriolis(bodies), data.qfrc_bias, atol=1e-8)
        linear, angular = np.zeros((3, 6)), np.zeros((3, 6))
        mujoco.mj_jacSite(arm, data, linear, angular, 0)
        flange = forward(TABLES[model], joints)
        np.testing.assert_allclose(posture.jacobian(flange), np.vstack([linear, angular]), atol=1e-9)


def test_the_jacobians_rate_is_its_difference() -> None:
    table, tool = TABLES["UR5e"], from_pose((0.1, 0.02, 0.2, 0.3, 0, 0))
    joints, speeds, step_s = (0.3, -1.2, 1.1, -0.4, 0.8, 0.2), (0.4, -0.3, 0.8, 1.0, -0.9, 0.5), 1e-6

    def jacobian(t_s: float) -> np.ndarray:
        at = tuple(q + t_s * v for q, v in zip(joints, speeds, strict=True))
        return np.array(Posture(table, at, speeds).jacobian(compose(forward(table, at), tool)))

    rate = Posture(table, joints, speeds).jacobian_rate(compose(forward(table, joints), tool))
    np.testing.assert_allclose(rate, (jacobian(step_s) - jacobian(-step_s)) / (2 * step_s), atol=1e-7)
