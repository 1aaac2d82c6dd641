"""The user's URDF with the joints of the corrected arm, and the camera mounted on it.

Only the tags `<origin>` of its joints change, in place: comments, meshes, limits and everything else stay,
byte for byte. The chain of the file is recognised by its forward kinematics over the joints recorded.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import accumulate, product
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from calibrate.arms.chain import Chain
from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment
from calibrate.files.exports.models import camera, commented, numbers, table_of
from calibrate.handeye.arm_table import CorrectedArm
from calibrate.handeye.axxb.global_start import solve_global
from calibrate.handeye.axxb.pairs import all_pairs
from calibrate.handeye.metrics import mean_pose
from calibrate.handeye.workspace import sample_range
from recordings.geometry import (
    Array,
    difference,
    inverse,
    pose,
    roll_pitch_yaw,
    rotation_angle,
    rotation_exp,
    rotation_from_rpy,
)

_MAX_OFF_M, _MAX_OFF_RAD = 5e-3, 2e-2
"""Rms differences of flanges up to which a URDF is this arm: a maker's calibration of an arm is less, another
arm of the same build is more."""
_EXACT = 1e-12
LARGEST = 1e9
"""Of a number in a file of frames, metres or radians: more is no place in a cell, its square overflows."""


def corrected_urdf(calibration: Calibration, frames: FrameNames, given: bytes) -> bytes:
    """Write the corrected origins into a URDF, and the camera pose that belongs to them.

    base_from_flange of the file is then that of the corrected arm. Where base and flange of the controller
    are elsewhere than the links of these names, by a constant each, they stay so. Raises UsageError, where
    it is no plain URDF or not of this arm, and as `CorrectedArm.installable`.
    """
    arm = table_of(calibration)
    true, (_, X) = arm.chain, arm.installable()
    try:
        robot = Urdf.read(given)
        own = {frames.attach} if frames.attach else {frames.body, frames.camera}
        if taken := own & {element.get("name") for element in robot.root}:
            raise ValueError(
                f"{min(taken)} is in it already: name others with --camera and --body, or --attach"
            )
        found, B, T = _recognise(list(_paths(robot, len(true.axes), frames)), arm)
    except (ElementTree.ParseError, expat.ExpatError, LookupError, TypeError, ValueError) as problem:
        raise UsageError("urdf", why=str(problem)) from None
    origins, tip_from_flange = found.corrected(true.at(np.zeros(len(true.axes))), B, T)
    in_hand = calibration.mount == "eye-in-hand"
    parent, place = (found.tip, tip_from_flange) if in_hand else (found.base, inverse(B))
    note = commented(comment(calibration, frames, corrected=True))
    added = (note + camera(place @ X.matrix, parent, frames)).encode("ascii", "xmlcharrefreplace")
    changes = [(robot.end, robot.end, added)]
    for joint, was, origin in zip(found.joints, found.origins, origins, strict=True):
        if np.abs(was - origin).max() > _EXACT:
            changes.append(robot.with_origin(joint, origin))
    for start, end, text in sorted(changes, reverse=True):
        given = given[:start] + text + given[end:]
    return given


# --- reading ---
@dataclass(frozen=True, eq=False)
class Urdf:
    """A plain URDF. ValueError and expat's errors for anything else."""

    given: bytes
    root: Element
    at: dict[Element, int]
    """Where in the file each element begins."""
    end: int
    """Where the tag that ends the robot begins."""
    joints: dict[str, Element]
    """By the link that each carries."""

    @classmethod
    def read(cls, given: bytes) -> Urdf:
        if b"xacro:" in given or b"<!DOCTYPE" in given or b"\0" in given:
            raise ValueError("it is no plain URDF in UTF-8 (xacro robot.xacro > robot.urdf)")
        starts, ends = list[int](), list[int]()
        parser = expat.ParserCreate()
        parser.StartElementHandler = lambda *_: starts.append(parser.CurrentByteIndex)
        parser.EndElementHandler = lambda *_: ends.append(parser.CurrentByteIndex)
        parser.Parse(given, True)
        root = ElementTree.fromstring(given)
        joints = {_child(joint, "child").attrib["link"]: joint for joint in root.findall("joint")}
        return cls(given, root, dict(zip(root.iter(), starts, strict=True)), ends[-1], joints)

    def joints_to(self, link: str) -> list[Element]:
        """List the joints between the root and a link; no longer than all, where links carry each other."""
        found: list[Element] = []
        while link in self.joints and len(found) < len(self.joints):
            found.insert(0, self.joints[link])
            link = _child(found[0], "parent").attrib["link"]
        return found

    def with_origin(self, joint: Element, origin: Array) -> tuple[int, int, bytes]:
        """Make the change that gives a joint another origin: begin and end of what goes, and the new text."""
        old = joint.find("origin")
        tag = _TAG.match(self.given, self.at[joint if old is None else old])
        assert tag is not None
        xyz, rpy = numbers(origin[:3, 3]), numbers(roll_pitch_yaw(origin[:3, :3]))
        closing = "/>" if old is None or tag[0].endswith(b"/>") else ">"
        start = tag.end() if old is None else tag.start()
        return start, tag.end(), f'<origin xyz="{xyz}" rpy="{rpy}"{closing}'.encode()


_TAG = re.compile(rb"""<[^\s/>"']+(?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*\s*/?>""")


def _child(element: Element, tag: str) -> Element:
    found = element.find(tag)
    return Element(tag) if found is None else found


def _three(element: Element, name: str, default: str = "0 0 0") -> Array:
    found = np.array([float(word) for word in element.get(name, default).split()])
    if found.shape != (3,) or not np.abs(found).max() <= LARGEST:
        raise ValueError(f"{element.get(name)!r} is not three numbers")
    return found


def origin_of(joint: Element) -> Array:
    """Read parent_from_child (4, 4) of a joint at 0."""
    origin = _child(joint, "origin")
    return pose(rotation_from_rpy(_three(origin, "rpy")), _three(origin, "xyz"))


# --- recognising ---
@dataclass(frozen=True, eq=False)
class _Path:
    """Joints from a base to a tip, k of which n turn."""

    base: str
    tip: str
    start: Array
    """(4, 4) base_from_link of the link where the path begins."""
    joints: list[Element]
    origins: Array
    """(k, 4, 4)"""
    turning: list[int]
    """Places of the joints that turn."""
    axes: Array
    """(n, 3) unit axis of each in its own frame, by which the recorded joint turns."""

    @property
    def links(self) -> Array:
        """base_from_link (k, 4, 4) of the link behind each joint, all joints at 0."""
        return np.array(list(accumulate(self.origins, np.matmul, initial=self.start)))[1:]

    @property
    def chain(self) -> Chain:
        links = self.links
        R, points = links[self.turning, :3, :3], links[self.turning, :3, 3]
        return Chain(np.einsum("nij,nj->ni", R, self.axes), points, np.zeros(len(R)), links[-1])

    def corrected(self, true: Chain, B: Array, T: Array) -> tuple[Array, Array]:
        """Compute the new origins, and tip_from_flange; true: the corrected arm at joints 0.

        A link may be moved along its joint's axis and turned about it without any effect on the arm: it goes
        as near as it can to where it was, so meshes stay in place.
        """
        base, end = inverse(B), inverse(B) @ true.flange @ inverse(T)
        links, found, last, before = self.links, self.origins.copy(), self.turning[-1], self.start
        links[last] = end @ inverse(links[-1]) @ links[last]
        for place, origin in enumerate(self.origins):
            now = end if place == len(found) - 1 > last else before @ origin
            if place in self.turning:
                k = self.turning.index(place)
                line = base[:3, :3] @ true.points[k] + base[:3, 3], base[:3, :3] @ true.axes[k]
                now = _onto(links[place], self.axes[k], *line)
            found[place], before = inverse(before) @ now, now
        return found, inverse(before) @ end @ T


def _onto(frame: Array, axis: Array, point: Array, direction: Array) -> Array:
    """Turn and shift a frame as little as needed for its axis to lie on a line."""
    was = frame[:3, :3] @ axis
    across = np.cross(was, direction)
    sine = float(np.linalg.norm(across))
    turn = rotation_exp(across / max(sine, 1e-300) * np.arctan2(sine, was @ direction))
    return pose(turn @ frame[:3, :3], point + direction * (direction @ (frame[:3, 3] - point)))


def _paths(robot: Urdf, n: int, frames: FrameNames) -> Iterator[_Path]:
    """Yield the paths of n turning joints from the base, to the flange of this name if there is one."""
    links = [link.attrib["name"] for link in robot.root.findall("link")]
    for name, default in ((frames.base, FrameNames.base), (frames.flange, FrameNames.flange)):
        if name not in links and name != default:
            raise ValueError(f"it has no link {name!r}")
    base = (
        frames.base
        if frames.base in links
        else next((name for name in links if name not in robot.joints), "")
    )
    for tip in [frames.flange] if frames.flange in links else links:
        back, path = robot.joints_to(base), robot.joints_to(tip)
        while back and path and back[0] is path[0]:
            back, path = back[1:], path[1:]
        moving = [joint for joint in path if joint.get("type") != "fixed"]
        turns = all(j.get("type") in ("revolute", "continuous") and j.find("mimic") is None for j in moving)
        if len(moving) == n and turns and all(joint.get("type") == "fixed" for joint in back):
            *_, up = accumulate(map(origin_of, back), np.matmul, initial=np.eye(4))
            axes = np.array([_three(_child(joint, "axis"), "xyz", "1 0 0") for joint in moving])
            axes /= np.linalg.norm(axes, axis=1, keepdims=True)
            turning = [path.index(joint) for joint in moving]
            yield _Path(base, tip, inverse(up), path, np.array(list(map(origin_of, path))), turning, axes)


def _recognise(paths: list[_Path], arm: CorrectedArm) -> tuple[_Path, Array, Array]:
    """Find the path in the URDF that is this arm, by 40 poses of the flange as the controller computes it.

    With the constants B and T of the answer, controller's base_from_flange = B · base_from_tip · T. They are
    needed where the file's base or tip is elsewhere than the controller's base or flange. The simplest answer
    is taken: first joints that turn as the controller's do, then all choices of joints that turn the other
    way. For each: neither B nor T, then T alone (a tool on the flange), then both (a base mounted anyhow).
    Raises ValueError where two arms fit alike, UsageError where none does.
    """
    nominal, eye = arm.nominal_chain, np.eye(4)
    n = len(nominal.axes)
    if not paths:
        raise ValueError(f"no link is carried by {n} turning joints: name --base and --flange")
    q = sample_range(np.array(arm.joints_rad or [(-1.0, 1.0)] * n).T, 40)
    told, least_m = nominal.forward(q), np.inf
    turned = _turned(told)
    for signs in sorted(product((1.0, -1.0), repeat=n), key=lambda signs: -sum(signs)):
        tried = [replace(path, axes=np.array(signs)[:, None] * path.axes) for path in paths]
        pairs = [(path, path.chain.forward(q)) for path in tried]
        pairs.sort(key=lambda pair: float(np.linalg.norm((pair[1] - told)[0, :3, 3])))  # the least tool first
        if np.isfinite(least_m):  # quicker: B and T leave the angle between two poses as it is
            pairs = [
                pair for pair in pairs if np.sqrt(np.mean((_turned(pair[1]) - turned) ** 2)) <= _MAX_OFF_RAD
            ]
        for constants in ("none", "T", "B and T"):
            fitting = []
            for path, place in pairs:
                B, T = eye, eye if constants == "none" else mean_pose(inverse(place) @ told)
                if constants == "B and T":
                    T = inverse(solve_global(all_pairs(told, inverse(place))).X)
                    B = mean_pose(told @ inverse(place @ T))
                off = difference(B @ place @ T, told) ** 2
                off = np.sqrt(off.reshape(-1, 2, 3).sum(axis=2).mean(axis=0))
                least_m = min(least_m, float(off[0]))
                if (off < (_MAX_OFF_M, _MAX_OFF_RAD)).all():
                    fitting.append((path, B, T))
            for path, _, _ in fitting[1:]:
                if path.joints[path.turning[0]] is not (first := fitting[0][0]).joints[first.turning[0]]:
                    raise ValueError(f"two arms fit: name {first.tip} or {path.tip} with --flange")
            if fitting:
                return fitting[0]
    raise UsageError("urdf-other-arm", off_mm=1e3 * least_m)


def _turned(poses: Array) -> Array:
    """Compute the angles (n,) between the first pose and each."""
    return np.asarray(rotation_angle((inverse(poses[:1]) @ poses)[:, :3, :3]))
