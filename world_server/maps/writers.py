"""Writing a graph to a file that `world_server.maps.read_graph` reads back unchanged."""

from pathlib import Path

import msgspec

from protocol.graph import PortGraph


def write_node_link(graph: PortGraph, path: Path) -> None:
    """Write a graph as node-link JSON, one vertex or edge a line, edges in port order.

    Args:
        graph: The graph; its names must be distinct.
        path: The file to write, replaced if it exists.

    Raises:
        OSError: If the file cannot be written.
    """
    nodes: list[bytes] = []
    for vertex, name in enumerate(graph.names):
        node: dict[str, str | float] = {"id": name}
        if graph.positions is not None:
            node["x"], node["y"] = graph.positions[vertex]
        nodes.append(msgspec.json.encode(node))
    edges: list[bytes] = []
    for (u, v), length in zip(graph.ends, graph.lengths, strict=True):
        edge: dict[str, str | float] = {"source": graph.names[u], "target": graph.names[v]}
        if length is not None:
            edge["length"] = length
        edges.append(msgspec.json.encode(edge))
    # Of a multigraph, so that networkx keeps parallel edges when it reads the file.
    document = (
        b'{"directed":false,"multigraph":true,"graph":{},\n"nodes":[\n'
        + b",\n".join(nodes)
        + b'\n],\n"edges":[\n'
        + b",\n".join(edges)
        + b"\n]}\n"
    )
    path.write_bytes(document)
