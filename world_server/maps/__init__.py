"""Map files and generated maps: everything that gives a graph or a grid."""

from world_server.maps.grids import GridFile, read_grid, read_map
from world_server.maps.readers import read_graph

__all__ = ["GridFile", "read_graph", "read_grid", "read_map"]
