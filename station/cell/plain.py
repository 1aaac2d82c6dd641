"""Values of other libraries, converted by their type to what a message may hold."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from recordings.errors import plain_value
from recordings.schema.messages import Image

R = TypeVar("R")


def builtins_of(value: object) -> Any:
    """Convert structs, enums, arrays and scalars of other libraries to dict, list, text and number.

    What is none of these becomes its text. A number that is not finite stays as it is.
    """
    return msgspec.to_builtins(value, enc_hook=_plain)


def plain_struct(made: R) -> R:
    """Convert every field of a message's struct to its declared type, here where it was made.

    A number of NumPy's in it would be found by whoever encodes it, somewhere else and later. What is no
    struct comes back as it is, and so does an image, which is no message. msgspec.ValidationError where a
    field holds another kind of thing.
    """
    if not isinstance(made, msgspec.Struct) or isinstance(made, Image):
        return made
    return msgspec.convert(builtins_of(made), type(made))


def _plain(value: object) -> Any:
    """Convert what msgspec does not know."""
    to_list = getattr(value, "tolist", None)
    return to_list() if callable(to_list) else plain_value(value)
