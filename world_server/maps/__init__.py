"""Map files and generated maps: everything that gives a `protocol.graph.PortGraph`."""

from world_server.maps.readers import read_graph

__all__ = ["read_graph"]
