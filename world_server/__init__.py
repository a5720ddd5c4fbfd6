"""The world: what robots can sense, what they do to it, and the one clock that they share."""
