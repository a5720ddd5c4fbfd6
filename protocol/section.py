"""What the parts of a scenario are made of."""

from typing import Annotated

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]
Seconds = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
OptionValue = bool | int | float | str | tuple[int, ...]
Start = str | int | tuple[int, int]

Misfit = tuple[str, object, str]
"""A field, what was found there, and what was expected."""


class Section(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Root of all parts of a scenario."""
