"""Randomness: one seed a scenario, and a stream of its own for each use of it."""

import random

Stream = random.Random
"""A random stream, for those who draw from one but may not make one."""


def spawn(seed: int, *path: int | str) -> Stream:
    """Return the random stream that belongs to ``path`` under ``seed``.

    Streams of different paths are independent; the same seed and path give the same stream in every
    process and on every machine (string seeds are hashed with SHA-512 by the standard library).
    """
    return random.Random("/".join(map(str, ("canopy", seed, *path))))  # noqa: S311  not for secrets
