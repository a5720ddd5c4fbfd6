"""An ant walk: each vertex passes its visitors on by its ports in turn.

The tag of a vertex holds the port that is next. Robots need neither memory nor radio, and as the
tags stay where they are, the others finish what a lost robot has begun. Nobody knows when all is
covered: a robot stops after ``patience`` moves in a row that led to no new vertex.
"""

from msgspec import Struct

from agents.body import Body


class Options(Struct, frozen=True, forbid_unknown_fields=True):
    """What ``[algorithm_options]`` may say."""

    patience: int = 300


async def ant_walk(body: Body, options: Options) -> None:
    """Walk until nothing new turns up."""
    here = await body.look()
    in_vain = 0
    while in_vain < options.patience and here.degree > 0:
        in_vain = in_vain + 1 if here.tag else 0  # a blank tag: nobody was here before
        exit_ = int.from_bytes(here.tag, "big")
        after = (exit_ + 1) % here.degree
        here = await body.move(exit_, tag=after.to_bytes(2, "big"))
