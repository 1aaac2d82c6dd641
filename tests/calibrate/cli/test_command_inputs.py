"""What a person gives to the commands (recordings, boards, lenses, limits): each wrong thing is named."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibrate.cli.inputs import read_camera
from calibrate.errors import CalibrationError
from calibrate.files.calibration import read_calibration
from calibrate.files.install import install
from recordings.errors import UnfinishedRecordingError
from recordings.exporters.export import export_recording
from recordings.importers.folder import import_folder
from recordings.reader import open_recording
from recordings.schema.messages import CameraModel
from tests.calibrate.calling import refused, run

UNFINISHED = UnfinishedRecordingError.code


def test_recordings_that_are_not_whole(session_file: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session_file.read_bytes()[:-5000])
    refused(run("solve", cut, cwd=tmp_path), 1, UNFINISHED, "cut.mcap")
    assert not list(tmp_path.glob("*.yaml"))
    assert not list(tmp_path.glob(".*tmp"))


def test_wrong_usage_is_exit_2_and_says_what_is_allowed(session_file: Path, tmp_path: Path) -> None:
    files = {
        "precious.yaml": "not: a calibration\n",
        "board.yaml": "kind: chesboard\ncolums: 7\nrows: 6\nsquare_m: 0.025\n",
        "gates.yaml": "view: 20\n",
        "camera.yaml": "image_width: 3\ncamera_matrix: {data: [1]}\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    for option, value, code, *named in (
        ("-o", "precious.yaml", "target-exists", "precious.yaml", "-o"),
        ("-o", "no/such/c.yaml", "output", "no/such"),
        ("--report", "no/such/r.html", "output", "no/such"),
        ("--board", "board.yaml", "input-file", "line 1", "kind", "line 2", "colums", "columns"),
        ("--gates", "gates.yaml", "input-file", "gates.yaml", "view"),
        ("--camera", "camera.yaml", "input-file", "camera_info"),
        ("--square-mm", "-4", "board-impossible", "square_m"),
        ("--profile", "nix", "", "robust"),
        ("--arm-class", "cheap", "choice", "universal-robots", "servo"),
    ):
        refused(run("solve", session_file, option, value, cwd=tmp_path), 2, code, *named)
    assert (tmp_path / "precious.yaml").read_text() == files["precious.yaml"]
    assert not list(tmp_path.glob("*.calibration.yaml")), "said before the solve, not after it"
    for option in ("--threads", "--time-limit-s", "--memory-limit-mib", "--seed", "--working-distance-mm"):
        refused(run("solve", session_file, option, "-3", cwd=tmp_path), 2, "", option)
        refused(run("solve", session_file, option, "1e300", cwd=tmp_path), 2, "", option)
    refused(run("install", "c.yaml", "--max-age-days", "3000000", cwd=tmp_path), 2, "", "36500")
    both = ("--camera", "camera.yaml", "--estimate-intrinsics")
    refused(run("solve", session_file, *both, cwd=tmp_path), 2, "options")
    refused(run("solve", cwd=tmp_path), 2)
    refused(run("export", "c.yaml", "--to", "nix", cwd=tmp_path), 2, "", "urdf")


def test_nothing_installed_is_said(session_file: Path, tmp_path: Path) -> None:
    refused(run("drift-check", session_file, cwd=tmp_path), 1, "nothing-installed")
    refused(run("rollback", cwd=tmp_path), 1, "nothing-installed")
    refused(run("withdraw", "a pallet hit it", cwd=tmp_path), 1, "nothing-installed")
    refused(run("show", cwd=tmp_path), 1, "nothing-installed")
    assert list(tmp_path.iterdir()) == [], "a slip in --root or --camera makes no folder"


def test_a_check_of_the_wrong_kind_is_refused(session_file: Path, real_file: Path, tmp_path: Path) -> None:
    done = run("drift-check", session_file, "--calibration", real_file, cwd=tmp_path)
    refused(done, 2, "views-of-another-cell", "simulated", "real")


def test_a_lens_known_before_can_be_given(session_file: Path, real_file: Path, tmp_path: Path) -> None:
    exported = run("export", real_file, "--to", "ros-camera-info", "-o", "info.yaml", cwd=tmp_path)
    assert exported.returncode == 0, exported.stderr
    by_info = run("solve", session_file, "--camera", "info.yaml", "-o", "a.yaml", "--json", cwd=tmp_path)
    by_file = run("solve", session_file, "--camera", real_file, "-o", "b.yaml", "--json", cwd=tmp_path)
    first, second = json.loads(by_info.stdout), json.loads(by_file.stdout)
    # A calibration file states how well it knows its lens, which ROS cannot: it may pull harder.
    sigmas = [answer["sigma"]["translation_mm"] for answer in (first, second)]
    assert sigmas[1] < sigmas[0]
    apart = np.subtract(first["result"]["translation_m"], second["result"]["translation_m"])
    assert 1e3 * np.linalg.norm(apart) < sigmas[0]
    assert CameraModel(480, 384).width == first["intrinsics"]["width"]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("distortion_model", "fisheye"),
        ("distortion_model", None),
        ("image_width", float("inf")),
        ("image_height", 0),
        ("camera_matrix", {"data": [900, 0, 240, 9, 900, 190, 0, 0, 1]}),
        ("camera_matrix", {"data": [900, 0, 0, 0, 900, 0, 240, 190, 1]}),
        ("camera_matrix", {"data": [900, 0, 240, 0, 900, 190, 0, 0, 2]}),
        ("camera_matrix", {"data": [900, 0, 240, 0, 900, float("nan"), 0, 0, 1]}),
        ("distortion_coefficients", {"data": [0] * 9}),
    ],
)
def test_a_lens_that_is_none_is_never_used(tmp_path: Path, field: str, value: object) -> None:
    """Taken for another model or read in another order it would give a wrong X, and no gate need fail."""
    info = {
        "image_width": 480,
        "image_height": 384,
        "camera_matrix": {"data": [900, 0, 240, 0, 900, 190, 0, 0, 1]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"data": ["1e-05", 0, 0, 0, 0]},  # 1e-05 is a text to PyYAML
    }
    path = tmp_path / "info.yaml"
    path.write_text(yaml.safe_dump(info))
    assert read_camera(path)[0].distortion[0] == 1e-5
    path.write_text(yaml.safe_dump(info | {field: value}))
    with pytest.raises(CalibrationError):
        read_camera(path)


def test_poses_are_left_out_by_hand_and_the_file_says_so(session_file: Path, tmp_path: Path) -> None:
    target = tmp_path / "c.yaml"
    done = run("solve", session_file, "-o", target, "--without", "2,5", "--json", cwd=tmp_path)
    assert done.returncode in (0, 4), done.stderr
    views = json.loads(done.stdout)["views"]
    by_hand = [view["index"] for view in views["rejected"] if view["kind"] == "by-hand"]
    assert by_hand == [1, 4] and not {1, 4} & set(views["used"])
    assert read_calibration(target).provenance.options["without"] == [2, 5]
    refused(run("solve", session_file, "--without", "99", cwd=tmp_path), 1, "no-such-view", "--without 99")
    few = ",".join(str(number) for number in range(1, 8))
    refused(run("solve", session_file, "--without", few, cwd=tmp_path), 1, "too-few-views", "--without")
    assert run("solve", session_file, "--without", "a", cwd=tmp_path).returncode == 2


def test_a_view_given_twice_is_refused_by_solve_and_check(
    session_file: Path, real_file: Path, tmp_path: Path
) -> None:
    """It would count as one more and halve the stated variance: the check would seem surer than it is."""
    folder = export_recording(open_recording(session_file), tmp_path / "folder", "folder")
    header, *rows = (folder / "poses.csv").read_text().splitlines()
    image, numbers = rows[2].split(",", 1)
    shutil.copy(folder / image, folder / "again.png")
    (folder / "poses.csv").write_text("\n".join([header, *rows, f"again.png,{numbers}"]) + "\n")
    twice = import_folder(folder, tmp_path / "twice.mcap").path
    for done in (
        run("solve", twice, cwd=tmp_path),
        run("drift-check", twice, "--calibration", real_file, cwd=tmp_path),
    ):
        refused(done, 1, done.error.code, "--without 11")


def test_what_an_arm_or_a_solve_was_needed_for_is_never_written_over(
    session_file: Path, real_file: Path, tmp_path: Path
) -> None:
    """A slip of the name after -o must not cost a recording, a calibration or a device."""
    recording = Path(shutil.copy(session_file, tmp_path / "s.mcap"))
    calibration = Path(shutil.copy(real_file, tmp_path / "c.yaml"))
    (tmp_path / "notes.txt").write_text("mine")
    for name in ("s.mcap", "c.yaml", "notes.txt"):
        told = run("solve", recording, "-o", "new.yaml", "--report", name, cwd=tmp_path)
        refused(told, 2, "target-exists", name)
    same = run("solve", recording, "-o", "new.yaml", "--report", "./new.yaml", cwd=tmp_path)
    refused(same, 2, "target-exists", "new.yaml")
    for name in ("s.mcap", "c.yaml"):
        refused(
            run("export", calibration, "--to", "opencv", "-o", name, cwd=tmp_path), 2, "target-exists", name
        )
    for _ in range(2):
        assert run("export", calibration, "--to", "opencv", "-o", "c.yml", cwd=tmp_path).returncode == 0
    os.mkfifo(tmp_path / "pipe")
    for command in (("export", calibration, "--to", "opencv"), ("solve", recording)):
        refused(run(*command, "-o", "pipe", cwd=tmp_path), 2, "output", "pipe")
    version = install(calibration, tmp_path / "s").path
    for name in ("s/calibrations/current", version):
        refused(run("solve", recording, "-o", name, cwd=tmp_path), 2, "target-exists", name)
    assert recording.read_bytes() == session_file.read_bytes()
    assert calibration.read_bytes() == version.read_bytes() == real_file.read_bytes()
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "new.yaml").exists()


def test_an_export_never_replaces_what_it_is_made_of(real_file: Path, tmp_path: Path) -> None:
    urdf = "<robot name='r'><link name='a'/><link name='b'/><joint name='j' type='fixed'>"
    urdf += "<parent link='a'/><child link='b'/></joint></robot>"
    (tmp_path / "driver.urdf").write_text(urdf)
    words = ("export", real_file, "--to", "urdf", "--driver-tf", "driver.urdf", "-o", "./driver.urdf")
    refused(run(*words, cwd=tmp_path), 2, "target-exists", "driver.urdf")
    assert (tmp_path / "driver.urdf").read_text() == urdf


def test_a_file_of_another_kind_is_named_with_what_to_give(session_file: Path, tmp_path: Path) -> None:
    next_step = f"calibrate solve {session_file}"
    refused(run("install", session_file, cwd=tmp_path), 1, "not-a-calibration", next_step)
    refused(run("show", session_file, cwd=tmp_path), 1, "not-a-calibration", next_step)
    for name, content in (
        ("empty", b""),
        ("latin", b"caf\xe9: 1\n"),
        ("cut", b"a: [1,2\n"),
        ("huge", b"#" * 300_000),
    ):
        path = tmp_path / f"{name}.yaml"
        path.write_bytes(content)
        done = run("solve", session_file, "--camera", path, cwd=tmp_path)
        refused(done, 2, "input-file", f"{name}.yaml: ")
        assert done.stderr.count("\n") == 1, "one line says it"
    word = tmp_path / "word.yaml"
    word.write_text("board\n")
    refused(run("solve", session_file, "--board", word, cwd=tmp_path), 2, "input-file", "word.yaml")
