"""Kinds of cells: what may be wrong with arm, camera, board or views, as a few numbers each.

`KINDS` are those that anybody expects of a judge. `UNSEEN` are five more that were written before any answer
of the solver had been looked at. `drawn(kind, draw)` gives the same kind with sizes of another draw: each
size times a factor between a half and two, drawn by the one number `draw`; draw 0 is the table itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.judge.lenses import LensModel


@dataclass(frozen=True)
class Kind:
    """One kind of cell. A size of 0 is no fault; directions and signs are drawn for each cell."""

    name: str

    # The arm. Angles of its joints are in units of `ArmClass.zero_rad`, so they suit every class.
    links: float = 1.0
    """Size of the errors of its links, against the class'."""
    sag: float = 0.0
    """By which a joint yields under the torque of the whole arm held out level."""
    backlash: float = 0.0
    """Between both ends of a joint's play: it rests at the end from which it came."""
    eccentric: float = 0.0
    """1σ of the amplitude of an encoder's error that is a sine of the joint's angle."""
    remastered: float = 0.0
    """Of one joint's zero, set wrongly."""
    creep: float = 0.0
    """Which a joint has still to go when the picture is taken, in a third of the views."""
    growth: float = 0.0
    """Relative, of all links from the first view to the last, as a body warms: 1 - exp(-3 t)."""
    base_drift_mm: float = 0.0
    """By which the arm's foot has moved at the last view, evenly; as many mrad."""
    slip_mrad: float = 0.0
    """By which what the flange holds has turned about the flange's axis at the last view, in three steps."""
    loose_mrad: float = 0.0
    """By which gravity turns what the flange holds from one end of its play to the other."""
    told_mm: float = 0.0
    """Step to which positions are rounded; orientations to as many tenths of a degree."""
    told_joint_deg: float = 0.0
    """Step to which joints are rounded before all else."""
    noise_mm: float = 0.0
    """1σ of a new error of each told flange, per axis; as many mrad."""

    # Camera and lens.
    lens: LensModel = "plumb_bob"
    """What the lens is. It is told to be a plumb-bob."""
    stronger: float = 1.0
    """By which it bends more than that of `lenses.LENSES`; a fisheye's focal length is shorter by that."""
    aspect: float = 0.0
    """Relative, of the pixels' height against their width."""
    given: bool = False
    """The lens is given; else it is found from the same views."""
    given_error: float = 0.002
    """1σ of a given lens: of the focal length, and of the centre against the width."""
    given_told: float = 0.002
    """What is told as that."""
    breathing_mm: float = 0.0
    """b in the picture's scale 1 + b (1/z - 1/z₀): an autofocus; off its focus the picture blurs."""
    focal_drift: float = 0.0
    """Relative, from the first view to the last."""
    bump_mm: float = 0.0
    """By which the camera is moved half-way; as many mrad times two."""
    rolling_mm: float = 0.0
    """By which the camera moves while a picture's rows are read; as many mrad."""
    dirt_px: float = 0.0
    """By which corners in four spots of the picture are moved."""
    occluded: float = 0.0
    """Largest share of the board that is hidden in half of the views."""

    # The board.
    print_x: float = 0.0
    print_y: float = 0.0
    """Relative errors of the print along both sides."""
    bend_mm: float = 0.0
    """Height of the middle of a board that is bent like a piece of a tube."""

    # The views.
    views: int = 20
    more_views: int = 0
    """As many more views at most in other draws."""
    clusters: int = 0
    """The views lie about as few places; 0: anywhere."""
    tilt_deg: float = 40.0
    """Largest tilt of the board against the picture."""
    farther: float = 1.0
    """Factor of the distances."""


KINDS = (
    Kind("clean"),
    Kind("sag", sag=1.5),
    Kind("backlash", backlash=1.5),
    Kind("eccentric encoders", eccentric=1.0),
    Kind("creep", creep=3.0),
    Kind("rolling shutter", rolling_mm=0.4),
    Kind("defocus", breathing_mm=1.5),
    Kind("focal drift", focal_drift=0.002),
    Kind("corner dirt", dirt_px=1.5),
    Kind("occlusion", occluded=0.6),
    Kind("clusters", clusters=3),
    Kind("one axis", tilt_deg=3.0),
    Kind("6 views", views=6, more_views=1),
    Kind("8 views", views=8, more_views=1),
    Kind("far board", farther=2.5),
    Kind("bump", bump_mm=1.0),
    Kind("base drift", base_drift_mm=0.5),
    Kind("poses to 0.1 mm", told_mm=0.1),
    Kind("poses to 1 mm", told_mm=1.0),
    Kind("joints to 0.01°", told_joint_deg=0.01),
    Kind("factory lens, right", given=True),
    Kind("factory lens, too tight", given=True, given_error=0.003, given_told=0.0005),
    Kind("fisheye as plumb-bob", lens="equidistant"),
    Kind("rational as plumb-bob", lens="rational_polynomial"),
    Kind("non-square pixels", aspect=0.01),
    Kind("ChArUco print", print_x=0.002, print_y=0.001),
    Kind("independent noise", links=0.0, noise_mm=0.2),
)
UNSEEN = (
    Kind("warming links", growth=0.0005),
    Kind("bent board", bend_mm=0.5),
    Kind("loose bracket", loose_mrad=2.0),
    Kind("slipping flange", slip_mrad=2.0),
    Kind("remastered joint", remastered=4.0),
)
EVERY = {kind.name: kind for kind in (*KINDS, *UNSEEN)}

_SIZES = (
    "sag", "backlash", "eccentric", "remastered", "creep", "growth", "base_drift_mm", "slip_mrad",
    "loose_mrad", "told_mm", "told_joint_deg", "noise_mm", "aspect", "given_error", "breathing_mm",
    "focal_drift", "bump_mm", "rolling_mm", "dirt_px", "print_x", "print_y", "bend_mm",
)  # fmt: skip
"""What another draw scales. The rest is drawn by its own rule below."""


def drawn(kind: Kind, draw: int) -> Kind:
    """The kind with the sizes of this draw; 0: as it stands. The same draw gives the same sizes."""
    if draw == 0:
        return kind
    rng = np.random.default_rng([draw, *kind.name.encode()])
    sizes: dict[str, float] = {}
    for name in _SIZES:
        factor = float(2.0 ** rng.uniform(-1.0, 1.0))
        sizes[name] = factor * float(getattr(kind, name))
    if not kind.given or kind.given_told == kind.given_error:
        # A lens that is told rightly stays so.
        sizes["given_told"] = sizes["given_error"]
    changed = replace(kind, **sizes)  # type: ignore[arg-type]
    occluded = kind.occluded * float(rng.uniform(0.5, 1.2))
    farther = 1.0 + (kind.farther - 1.0) * float(rng.uniform(0.5, 1.3))
    stronger = 1.0 if kind.lens == "plumb_bob" else float(rng.uniform(0.7, 1.2))
    tilt_deg = kind.tilt_deg if kind.tilt_deg > 10 else kind.tilt_deg * float(rng.uniform(0.5, 2.0))
    clusters = kind.clusters + int(rng.integers(0, 3)) if kind.clusters else 0
    views = kind.views + int(rng.integers(0, kind.more_views + 1))
    return replace(
        changed,
        stronger=stronger,
        occluded=occluded,
        farther=farther,
        tilt_deg=tilt_deg,
        clusters=clusters,
        views=views,
    )
