"""Fields of a calibration file, for programs that read it without msgspec: standard library alone.

One table. A test holds it to the structs of `calibration` and below: a field more there is a row more here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from calibrate.files.earlier import FORMATS


class Kind(Protocol):
    """What a value may be."""

    def problems(self, value: Any, at: str) -> Iterator[str]:
        """Yield what is wrong with the value at this place, as sentences; nothing: it is of this kind."""


@dataclass(frozen=True)
class Plain:
    name: str
    """For people, with its article."""
    type: type | None
    """True is no whole number. None: any value."""

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if self.type is not None and type(value) is not self.type:
            yield f"{at} is not {self.name}"


@dataclass(frozen=True)
class Number:
    """Any number that a double can hold."""

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if type(value) is int:
            try:
                float(value)
            except OverflowError:
                yield f"{at} is too large a number"
        elif type(value) is not float:
            yield f"{at} is not a number"


@dataclass(frozen=True)
class Whole:
    """A whole number from `least` to `most`."""

    least: int
    most: int

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if type(value) is not int or not self.least <= value <= self.most:
            yield f"{at} is not a whole number from {self.least} to {self.most}"


@dataclass(frozen=True)
class Word:
    """One of these texts."""

    words: tuple[str, ...]

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if type(value) is not str or value not in self.words:
            yield f"{at} is not one of {', '.join(self.words)}"


@dataclass(frozen=True)
class Items:
    """A list, of any length where `count` is None."""

    of: Kind
    count: int | None = None

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if type(value) is not list:
            yield f"{at} is not a list"
        elif self.count is not None and len(value) != self.count:
            yield f"{at} has {len(value)} values, {self.count} are needed"
        else:
            for place, item in enumerate(value):
                yield from self.of.problems(item, f"{at}[{place}]")


@dataclass(frozen=True)
class Entries:
    """Values by names that the file chooses."""

    of: Kind

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if not _has_texts_as_keys(value):
            yield f"{at} is not a list of names with values"
        else:
            for name, item in value.items():
                yield from self.of.problems(item, f"{at}.{name}")


@dataclass(frozen=True)
class OrNone:
    """The same, or null."""

    of: Kind

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if value is not None:
            yield from self.of.problems(value, at)


@dataclass(frozen=True)
class Nested:
    """The fields of one of `RECORDS`."""

    record: str

    def problems(self, value: Any, at: str) -> Iterator[str]:
        if not _has_texts_as_keys(value):
            yield f"{at} is not a list of fields"
            return
        fields = RECORDS[self.record]
        for field in fields:
            if field.name in value:
                yield from field.kind.problems(value[field.name], f"{at}.{field.name}")
            elif field.required:
                yield f"{at}.{field.name} is missing"
        if self.record in CLOSED and (unknown := value.keys() - {field.name for field in fields}):
            yield f"{at} has a key that this version does not know: {min(unknown)}"


def _has_texts_as_keys(value: Any) -> bool:
    return type(value) is dict and all(type(key) is str for key in value)


@dataclass(frozen=True)
class Field:
    name: str
    kind: Kind
    required: bool = True


TEXT = Plain("a text", str)
FLAG = Plain("true or false", bool)
WHOLE = Plain("a whole number", int)
ANYTHING = Plain("anything", None)
NUMBER = Number()

RECORDS: dict[str, tuple[Field, ...]] = {
    "Calibration": (
        Field("format", Word(FORMATS[-1:])),
        Field("created", TEXT),
        Field("source", Word(("imported", "playback", "real", "simulated"))),
        Field("mount", Word(("eye-in-hand", "eye-to-hand"))),
        Field("result", Nested("FramePose")),
        Field("sigma", Nested("Sigma")),
        Field("covariance", Items(Items(NUMBER))),
        Field("confidence_threshold", NUMBER),
        Field("board_place", Nested("FramePose")),
        Field("intrinsics", Nested("Lens")),
        Field("board", Nested("BoardSpec")),
        Field("robot", Nested("RobotIdentity")),
        Field("camera", Nested("CameraIdentity")),
        Field("views", Nested("Views")),
        Field("quality", Nested("Quality")),
        Field("provenance", Nested("Provenance")),
        Field("override", OrNone(Nested("Override")), required=False),
        Field("verification", Items(Nested("Touch")), required=False),
        Field("arm_table", OrNone(Nested("CorrectedArm")), required=False),
        Field("posterior", OrNone(Nested("Posterior")), required=False),
        Field("excluded", OrNone(Nested("Excluded")), required=False),
    ),
    "Excluded": (
        Field("views", Items(WHOLE)),
        Field("who", TEXT),
        Field("all_views", Nested("AllViews")),
    ),
    "AllViews": (
        Field("problem", TEXT, required=False),
        Field("error_mm", OrNone(NUMBER), required=False),
        Field("holdout_m", OrNone(NUMBER), required=False),
        Field("failed", Items(TEXT), required=False),
        Field("shift", Items(NUMBER), required=False),
        Field("views", Items(Nested("ViewQuality")), required=False),
        Field("weights", Items(Nested("ViewWeight")), required=False),
    ),
    "FramePose": (
        Field("parent_frame", TEXT),
        Field("child_frame", TEXT),
        Field("translation_m", Items(NUMBER, 3)),
        Field("rotation_xyzw", Items(NUMBER, 4)),
        Field("matrix", Items(Items(NUMBER))),
    ),
    "Sigma": (
        Field("translation_mm", NUMBER),
        Field("rotation_deg", NUMBER),
    ),
    "Lens": (
        Field("width", WHOLE),
        Field("height", WHOLE),
        Field("matrix", Items(Items(NUMBER, 3))),
        Field("distortion", Items(NUMBER)),
        Field("distortion_model", Word(("equidistant", "plumb_bob", "rational_polynomial"))),
        Field("rms_px", OrNone(NUMBER)),
        Field("found", Word(("from these pictures", "given", "not known"))),
        Field("sigma", Entries(NUMBER), required=False),
    ),
    "BoardSpec": (
        Field(
            "kind",
            Word(
                (
                    "april-grid",
                    "april-tag",
                    "aruco",
                    "asymmetric-circles",
                    "charuco",
                    "chessboard",
                    "circles",
                    "unseen",
                )
            ),
        ),
        Field("columns", WHOLE, required=False),
        Field("rows", WHOLE, required=False),
        Field("square_m", NUMBER, required=False),
        Field("marker_m", OrNone(NUMBER), required=False),
        Field("dictionary", OrNone(TEXT), required=False),
        Field("legacy", FLAG, required=False),
        Field("id", WHOLE, required=False),
        Field("square_tolerance", OrNone(NUMBER), required=False),
        Field("flatness_m", OrNone(NUMBER), required=False),
        Field("square_guessed", FLAG, required=False),
    ),
    "RobotIdentity": (
        Field("model", TEXT, required=False),
        Field("serial", TEXT, required=False),
        Field("controller_version", TEXT, required=False),
        Field("tcp_offset", Items(NUMBER, 6), required=False),
        Field("payload_kg", NUMBER, required=False),
        Field("arm_class", TEXT, required=False),
    ),
    "CameraIdentity": (
        Field("vendor", TEXT, required=False),
        Field("model", TEXT, required=False),
        Field("serial", TEXT, required=False),
        Field("driver", TEXT, required=False),
        Field("name", TEXT, required=False),
    ),
    "Views": (
        Field("used", Items(WHOLE)),
        Field("rejected", Items(Nested("RejectedView")), required=False),
        Field("turned", Items(WHOLE), required=False),
        Field("weights", Items(Nested("ViewWeight")), required=False),
    ),
    "RejectedView": (
        Field("index", WHOLE),
        Field("name", TEXT),
        Field("reason", TEXT),
        Field("kind", TEXT, required=False),
        Field("belongs_to", OrNone(WHOLE), required=False),
        Field("wrong_number", OrNone(WHOLE), required=False),
        Field("slip", NUMBER, required=False),
    ),
    "ViewWeight": (
        Field("index", WHOLE),
        Field("weight", NUMBER),
    ),
    "Quality": (
        Field("gates", Items(Nested("Gate"))),
        Field("certificate", Nested("Certificate")),
        Field("holdout", OrNone(Nested("HoldoutScore")), required=False),
        Field("rms_px", OrNone(NUMBER), required=False),
        Field("views", Items(Nested("ViewQuality")), required=False),
        Field("board_spread_mm", OrNone(NUMBER), required=False),
        Field("board_spread_deg", OrNone(NUMBER), required=False),
        Field("predicted_error_mm", OrNone(NUMBER), required=False),
        Field("working_distance_m", OrNone(NUMBER), required=False),
        Field("noise", Entries(NUMBER), required=False),
        Field("error_shares", Entries(NUMBER), required=False),
        Field("weakest", TEXT, required=False),
        Field("board", OrNone(Nested("BoardShape")), required=False),
        Field("cross_validation", OrNone(Nested("CrossValidation")), required=False),
        Field("point", OrNone(Nested("PointError")), required=False),
        Field("session", OrNone(Nested("SessionReading")), required=False),
        Field("arm", OrNone(Nested("Arm")), required=False),
        Field("warnings", Items(TEXT), required=False),
        Field("warning_codes", Items(TEXT), required=False),
    ),
    "PointError": (
        Field("error_mm", NUMBER),
        Field("at_m", NUMBER),
        Field("p95_mm", NUMBER),
        Field("workspace_mm", NUMBER),
        Field("from_x_mm", NUMBER),
        Field("from_arm_mm", NUMBER),
        Field("from_board_lens_mm", NUMBER),
        Field("floor_mm", NUMBER),
        Field("with_more_views_mm", NUMBER),
        Field("arm", Word(("told", "learned", "assumed"))),
        Field("arm_class", TEXT, required=False),
        Field("corrected_mm", OrNone(NUMBER), required=False),
    ),
    "Gate": (
        Field("name", TEXT),
        Field("passed", FLAG),
        Field("value", OrNone(NUMBER)),
        Field("limit", OrNone(NUMBER)),
        Field("text", TEXT),
        Field("unit", TEXT, required=False),
        Field("remedy", TEXT, required=False),
        Field("sense", OrNone(Word(("≤", "≥"))), required=False),
    ),
    "Certificate": (
        Field("certified", FLAG),
        Field("relative_gap", NUMBER),
        Field("objective", NUMBER),
        Field("distance_sigma", OrNone(NUMBER), required=False),
        Field("problem", TEXT, required=False),
        Field("lower_bound", NUMBER, required=False),
        Field("floor", NUMBER, required=False),
    ),
    "HoldoutScore": (
        Field("e_t_m", NUMBER),
        Field("e_R", NUMBER),
        Field("samples_e_t_m", Items(NUMBER)),
        Field("samples_e_R", Items(NUMBER)),
        Field("pairs", Items(Items(WHOLE, 2))),
        Field("fitted_views", WHOLE),
        Field("note", TEXT, required=False),
    ),
    "ViewQuality": (
        Field("index", WHOLE),
        Field("rms_px", OrNone(NUMBER), required=False),
        Field("robot_mm", OrNone(NUMBER), required=False),
        Field("robot_deg", OrNone(NUMBER), required=False),
    ),
    "BoardShape": (
        Field("scale", NUMBER),
        Field("anisotropy", NUMBER),
        Field("bend_m", Items(NUMBER, 3)),
        Field("sigma", Items(NUMBER, 5)),
    ),
    "CrossValidation": (
        Field("rms_mm", NUMBER),
        Field("rms_deg", NUMBER),
        Field("claimed_mm", NUMBER),
        Field("folds", WHOLE),
        Field("limit", NUMBER, required=False),
    ),
    "SessionReading": (
        Field("hypothesis", TEXT),
        Field("text", TEXT),
        Field("others", Items(TEXT), required=False),
        Field("changed_from", OrNone(WHOLE), required=False),
        Field("changed_between", OrNone(Items(WHOLE, 2)), required=False),
    ),
    "Arm": (
        Field("applied", FLAG),
        Field("log_bayes", NUMBER),
        Field("size_mm", NUMBER),
        Field("table", Items(Nested("ArmErrorValue"))),
        Field("size_mrad", NUMBER, required=False),
    ),
    "ArmErrorValue": (
        Field("parameter", TEXT),
        Field("value", NUMBER),
        Field("sigma", NUMBER),
    ),
    "Provenance": (
        Field("recording", TEXT),
        Field("recording_sha256", TEXT),
        Field("session", TEXT),
        Field("software", Entries(TEXT)),
        Field("profile", TEXT),
        Field("seed", WHOLE),
        Field("options", Entries(ANYTHING), required=False),
        Field("recorded_wall_ns", Whole(0, 9223372036854775807), required=False),
        Field("plan_sha256", TEXT, required=False),
    ),
    "Override": (
        Field("reason", TEXT),
        Field("who", TEXT),
        Field("overridden", Items(TEXT)),
    ),
    "Touch": (
        Field("corner", WHOLE),
        Field("corner_mm", Items(NUMBER, 2)),
        Field("offset_mm", Items(NUMBER, 2)),
        Field("sigma_mm", Items(NUMBER, 2)),
        Field("found", Word(("read from the arm", "told by a person"))),
        Field("who", TEXT),
        Field("wall", TEXT),
        Field("pointer", TEXT, required=False),
        Field("note", TEXT, required=False),
    ),
    "CorrectedArm": (
        Field("offered", FLAG),
        Field("model", TEXT),
        Field("nominal_source", Word(("factory", "learned", "published"))),
        Field("covariance", Items(Items(NUMBER))),
        Field("with_table_mm", NUMBER),
        Field("without_table_mm", NUMBER),
        Field("nominal", OrNone(Nested("DhTable")), required=False),
        Field("learned", OrNone(Nested("LearnedArm")), required=False),
        Field("joints_rad", Items(Items(NUMBER, 2)), required=False),
        Field("held_out", OrNone(Nested("HeldOutViews")), required=False),
        Field("refused", TEXT, required=False),
        Field("corrected", OrNone(Nested("DhTable")), required=False),
        Field("corrected_chain", OrNone(Nested("LearnedArm")), required=False),
        Field("result", OrNone(Nested("FramePose")), required=False),
    ),
    "DhTable": (
        Field("a_m", Items(NUMBER, 6)),
        Field("d_m", Items(NUMBER, 6)),
        Field("alpha_rad", Items(NUMBER, 6)),
        Field("theta_rad", Items(NUMBER, 6)),
        Field("beta_rad", Items(NUMBER, 6)),
    ),
    "LearnedArm": (
        Field("axes", Items(Items(NUMBER))),
        Field("points", Items(Items(NUMBER))),
        Field("posture_rad", Items(NUMBER)),
        Field("flange", Items(Items(NUMBER))),
    ),
    "HeldOutViews": (
        Field("without_table_mm", NUMBER),
        Field("with_table_mm", NUMBER),
        Field("views", WHOLE),
    ),
    "Posterior": (
        Field("X", Items(Items(NUMBER))),
        Field("lens", Items(NUMBER)),
        Field("shape", Items(NUMBER)),
        Field("errors", Items(NUMBER)),
        Field("covariance_lower", Items(NUMBER)),
        Field("robot_noise", Items(NUMBER, 2)),
        Field("corner_noise_px", Items(NUMBER, 3)),
        Field("class_shares", Items(NUMBER)),
        Field("freedom", NUMBER),
        Field("board_extent_m", Items(Items(NUMBER))),
        Field("arm", OrNone(Nested("LearnedArm")), required=False),
        Field("stated_arm_error", OrNone(Items(Items(NUMBER))), required=False),
        Field("level", OrNone(Items(NUMBER)), required=False),
        Field("flange_extent_m", OrNone(Items(NUMBER)), required=False),
        Field("without_joints", OrNone(Nested("Posterior")), required=False),
    ),
}
"""The file is the first of them."""

CLOSED = frozenset({"BoardSpec", "RobotIdentity", "CameraIdentity"})
"""Records that have no other keys than these. In all others an unknown key is ignored."""


def wrong_field(plain: dict[str, Any]) -> str:
    """Say what is wrong with the first field of a calibration file of today that is; empty: nothing."""
    return next(Nested("Calibration").problems(plain, "the file"), "").replace("the file.", "", 1)
