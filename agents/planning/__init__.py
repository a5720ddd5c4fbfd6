"""Offline coverage: trees over a known map, the way around them, and who covers which part.

Everything here is computed before a robot moves, from the map and the starts (Agmon, Hazon and
Kaminka 2008, Sec. 3): `trees` and `create_tree` with `bridges` build the tree, `tour` goes around it,
`splits` gives each robot its part, `walks` makes walks of that.

A parent and its children (`parent_child`): `vertices` says who sees whom and where the parent stands,
`order` in which order, `child_roadmaps` who covers what around it, `following` who moves when.
"""
