"""The configuration: what an owner may write, and what is said when it is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from station.config_file import load_config
from station.errors import ConfigError

GOOD = """\
robot: {model: UR10, host: 192.0.2.10}
camera: {driver: aravis, device: KJ001}
board: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}
limits:
  speed_m_s: 0.2
  planes: [{name: table, point_m: [0, 0, 0], normal: [0, 0, 1]}]
"""


def test_a_good_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD)
    config, content = load_config(path)
    assert config.limits.speed_m_s == 0.2
    assert content == GOOD.encode()


def test_a_missing_file_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Write one with") as caught:
        load_config(tmp_path / "station.yaml")
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("speed_m_s: 0.2", "speed_m_s: 0.3", "at most 0.25"),
        ("model: UR10", "model: UR11", "UR10e"),
        ("normal: [0, 0, 1]", "normal: [0, 0, 0]", "'table' is zero"),
        ("device: KJ001", "device: KJ001, trigger: hardware", "section 'trigger'"),
        ("host: 192.0.2.10", "host: ''", "robot.host"),
        ("speed_m_s: 0.2", "speed_mm_s: 200", "did you mean 'speed_m_s'"),
    ],
)
def test_what_cannot_be_is_said(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert said in str(caught.value)
    assert "station.yaml" in str(caught.value)
