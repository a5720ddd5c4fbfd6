"""Map files: what the readers accept, what they refuse and with which words."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import networkx as nx
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from protocol.errors import MapError
from protocol.graph import PortGraph
from world_server.maps import read_graph
from world_server.maps.readers import READERS
from world_server.maps.writers import write_node_link

ROOT = Path(__file__).resolve().parent.parent
NAMES = st.text(st.characters(categories=["L", "N", "P", "S"]), min_size=1, max_size=8)
LENGTHS = st.none() | st.floats(0, 1e6)


def parse(content: str | bytes, suffix: str) -> PortGraph:
    """Read content as a file of a format would be read, without the file."""
    data = content.encode() if isinstance(content, str) else content
    return READERS[suffix](Path("map" + suffix), data)


def same(one: PortGraph, other: PortGraph) -> bool:
    parts = [(g.names, g.ends, g.lengths, g.positions) for g in (one, other)]
    return parts[0] == parts[1]


@st.composite
def graphs(draw: st.DrawFn, positions: bool = False) -> PortGraph:
    names = draw(st.lists(NAMES, min_size=1, max_size=8, unique=True))
    vertex = st.integers(0, len(names) - 1)
    edges = draw(st.lists(st.tuples(vertex, vertex, LENGTHS), max_size=16))
    coordinate = st.floats(-1e6, 1e6)
    places = st.lists(st.tuples(coordinate, coordinate), min_size=len(names), max_size=len(names))
    return PortGraph(
        names,
        [(u, v) for u, v, _ in edges],
        [length for _, _, length in edges],
        draw(st.none() | places) if positions else None,
    )


# Ports -------------------------------------------------------------------------------------------


@given(graphs())
def test_far_and_back_are_inverse_and_every_edge_has_two_ends(graph: PortGraph) -> None:
    ends: dict[int, list[tuple[int, int]]] = {edge: [] for edge in range(len(graph.ends))}
    for vertex in range(len(graph.names)):
        for port in range(graph.degree(vertex)):
            there, arrival = graph.far[vertex][port], graph.back[vertex][port]
            assert (graph.far[there][arrival], graph.back[there][arrival]) == (vertex, port)
            assert graph.edge_at[there][arrival] == graph.edge_at[vertex][port]
            ends[graph.edge_at[vertex][port]].append((vertex, port))
    assert all(len(set(pair)) == 2 for pair in ends.values())
    for edges in graph.edge_at:
        assert list(edges) == sorted(edges)


def test_ports_follow_the_file_with_parallels_and_loops() -> None:
    graph = parse("a b\nb b\nb a\n", ".edges")
    assert graph.far == ((1, 1), (0, 1, 1, 0))
    assert graph.back == ((0, 3), (0, 2, 1, 1))
    assert graph.edge_at == ((0, 2), (0, 1, 1, 2))


# Edge lists --------------------------------------------------------------------------------------


def test_an_edge_list_in_every_spelling() -> None:
    text = "\ufeff# head\r\n\r\n b\ta 1.5 # tail\r\nlone\r\n  # more\nb c\ra#1 b 0\na a -0"
    graph = parse(text, ".edges")
    assert graph.names == ("b", "a", "lone", "c", "a#1")
    assert graph.ends == ((0, 1), (0, 3), (4, 0), (1, 1))
    assert graph.lengths == (1.5, None, 0.0, 0.0)
    assert str(graph.lengths[3]) == "0.0"
    assert graph.positions is None


@given(graphs(), st.sampled_from(["\n", "\r\n", "\r"]), st.booleans(), st.booleans())
def test_edge_lists_keep_the_order_of_edges(
    graph: PortGraph, line_end: str, final: bool, mark: bool
) -> None:
    # All vertices first, so that their numbers are kept as well. A name that looks like a comment
    # cannot be written.
    names = [name.replace("#", "") or f"v{vertex}" for vertex, name in enumerate(graph.names)]
    names = [f"{name}.{vertex}" for vertex, name in enumerate(names)]
    lines = list(names)
    for (u, v), length in zip(graph.ends, graph.lengths, strict=True):
        lines.append(f"{names[u]}\t{names[v]}" + ("" if length is None else f"\t{length!r}"))
    text = ("\ufeff" if mark else "") + line_end.join(lines) + (line_end if final else "")
    assert same(parse(text, ".edges"), PortGraph(names, graph.ends, graph.lengths))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a b\nc d 1 2\n", "map.edges:2: found 4 fields in 'c d 1 2', expected two vertices"),
        ("a b\r\n\r\na c x\r\n", "map.edges:3: found 'x', expected a finite length >= 0"),
        ("a b -1", "map.edges:1: found '-1', expected a finite length >= 0"),
        ("a b nan", "map.edges:1: found 'nan', expected a finite"),
        ("a b inf", "map.edges:1: found 'inf', expected a finite"),
        ("a b 1e999", "map.edges:1: found '1e999', expected a finite"),
        ("a b 1_0", "map.edges:1: found '1_0', expected a finite"),
        ("a b ٣", "map.edges:1: found '٣', expected a finite"),
        ("a b\na\0c b", "map.edges:2: found vertex name 'a\\x00c', expected printable"),
        ("# only\n\n  # comments", "map.edges: found only blank lines and comments, expected"),
        (b"a b\nb \xff\n", "map.edges:2: found byte 0xff, expected text in UTF-8"),
        (b"\xef\xbb\xbfa\n\n\xfe", "map.edges:3: found byte 0xfe, expected text in UTF-8"),
        ("a b\n".encode("utf-16"), "map.edges:1: found byte 0xff, expected text in UTF-8"),
        ("a b " + "9" * 999, "map.edges:1: found '" + "9" * 57 + "...', expected a finite"),
    ],
)
def test_malformed_edge_lists(content: str | bytes, message: str) -> None:
    refused(content, ".edges", message)


def refused(content: str | bytes, suffix: str, message: str) -> None:
    with pytest.raises(MapError) as caught:
        parse(content, suffix)
    text = str(caught.value)
    assert text.startswith(message)
    assert len(text.splitlines()) == 1
    assert "found " in text


# GraphML -----------------------------------------------------------------------------------------


def graphml(body: str, keys: str = "") -> str:
    space = "http://graphml.graphdrawing.org/xmlns"
    return (
        f'<?xml version="1.0"?>\n<graphml xmlns="{space}">{keys}<graph>\n{body}</graph></graphml>'
    )


KEYS = (
    '<key id="w" for="edge" attr.name="weight" attr.type="double"/>'
    '<key id="l" for="edge" attr.name="length" attr.type="double"/>'
    '<key id="x" for="node" attr.name="x"/><key id="y" for="all" attr.name="y"/>'
    '<key id="u" for="node" attr.name="Longitude"/><key id="v" for="node" attr.name="Latitude"/>'
)
AB = '<node id="a"/>\n<node id="b"/>\n'


def test_graphml_keeps_the_order_of_the_file() -> None:
    # networkx would give 1-2 after both edges of 0, and number the parallels by adjacency.
    body = (
        '<edge source="1" target="2"/><edge source="0" target="2"/><edge source="2" target="2"/>'
        '<node id="2"/><node id="1"/><node id="0"/><edge source="2" target="1"/>'
    )
    graph = parse(graphml(body), ".graphml")
    assert graph.names == ("2", "1", "0")
    assert graph.ends == ((1, 0), (2, 0), (0, 0), (0, 1))


def test_graphml_takes_length_before_weight_before_default() -> None:
    keys = KEYS + '<key id="d" for="edge" attr.name="weight"><default> 7 </default></key>'
    body = (
        AB + '<edge source="a" target="b"><data key="w">2</data><data key="l">1</data></edge>'
        '<edge source="a" target="b"><data key="w"> 2e0 </data></edge>'
        '<edge source="a" target="b"><data key="other">x</data></edge>'
    )
    assert parse(graphml(body, keys), ".xml").lengths == (1, 2, 7)
    assert parse(graphml(body, KEYS), ".xml").lengths == (1, 2, None)


@pytest.mark.parametrize(("one", "two"), [("x", "y"), ("u", "v")])
def test_graphml_positions_need_every_node(one: str, two: str) -> None:
    placed = (
        '<node id="{}"><data key="' + one + '">1</data><data key="' + two + '">-2</data></node>'
    )
    both = graphml(placed.format("a") + placed.format("b"), KEYS)
    assert parse(both, ".graphml").positions == ((1, -2), (1, -2))
    assert parse(graphml(placed.format("a") + '<node id="b"/>', KEYS), ".xml").positions is None


def test_graphml_passes_over_what_editors_add() -> None:
    extra = '<y:Shape xmlns:y="http://example.org/y"><node id="z"/><data key="l">x</data></y:Shape>'
    body = f'<node id="a"><port name="p"/><data key="g">{extra}</data></node>'
    assert parse(graphml(body, KEYS), ".graphml").names == ("a",)
    latin = '<?xml version="1.0" encoding="iso-8859-1"?>'
    latin += '<graphml><graph><node id="\xe9"/></graph></graphml>'
    assert parse(latin.encode("latin-1"), ".graphml").names == ("\xe9",)
    assert parse(graphml('<node id="a"/>').encode("utf-16"), ".graphml").names == ("a",)


BOMB = (
    '<?xml version="1.0"?>\n<!DOCTYPE graphml [<!ENTITY a "ha">'
    + "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12)).replace("&a0;", "&a;")
    + "]>\n<graphml><graph><node id='&a11;'/></graph></graphml>"
)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BOMB, "map.graphml:2: found declarations in <!DOCTYPE>, expected GraphML without them"),
        ("<a>\n<b></a>", "map.graphml:1: found root element <a>, expected <graphml>"),
        ("<graphml>\n<b></graphml>", "map.graphml:2: expected well-formed XML, found mismatched"),
        ("a b 1\n", "map.graphml:1: expected well-formed XML, found syntax error"),
        (b"<graphml>\n\xff", "map.graphml:2: found byte 0xff, expected text in UTF-8"),
        ('<?xml version="1.0" encoding="klingon"?><a/>', "map.graphml:1: "),
        ("<graphml>\n</graphml>", "map.graphml:2: found no <graph> element, expected one"),
        ("<graphml><graph/>\n<graph/></graphml>", "map.graphml:2: found a second <graph>"),
        (graphml(""), "map.graphml: found no <node> element, expected at least one vertex"),
        (graphml("<node/>"), "map.graphml:3: found <node> without id, expected one"),
        (graphml(AB + '<node id="a"/>'), "map.graphml:5: found vertex 'a' again, expected each"),
        (graphml('<node id=""/>'), "map.graphml:3: found vertex name '', expected printable"),
        (graphml('<node id="a&#10;b"/>'), "map.graphml:3: found vertex name 'a\\nb', expected"),
        (graphml(AB + '<edge source="a"/>'), "map.graphml:5: found <edge> without target"),
        (
            graphml(AB + '<edge source="a" target="c"/>'),
            "map.graphml:5: found edge target 'c', expected a node id",
        ),
        (
            graphml(AB + '<edge source="a" target="b"><data key="l">far</data></edge>', KEYS),
            "map.graphml:5: found 'far', expected a finite length >= 0",
        ),
        (
            graphml(AB + '<edge source="a" target="b"><data>1</data></edge>', KEYS),
            "map.graphml:5: found <data> without key, expected one",
        ),
        (
            graphml('<node id="a"><data key="x">?</data><data key="y">1</data></node>', KEYS),
            "map.graphml:3: found '?', expected a finite coordinate",
        ),
        (
            graphml('<node id="a">\n<graph><node id="b"/></graph></node>'),
            "map.graphml:4: found <graph> in <node>, expected a plain graph",
        ),
        (
            graphml(AB + "<hyperedge/>"),
            "map.graphml:5: found <hyperedge> in <graph>, expected a plain graph",
        ),
    ],
)
def test_malformed_graphml(content: str | bytes, message: str) -> None:
    refused(content, ".graphml", message)


def test_a_deep_or_long_document_does_not_hang() -> None:
    refused("<graphml>" + "<a>" * 100_000, ".graphml", "map.graphml:1: expected well-formed XML")
    refused("<graphml a='" + "x" * 1_000_000, ".graphml", "map.graphml:1: expected well-formed")


# Node-link JSON ----------------------------------------------------------------------------------


@given(graphs(positions=True))
def test_what_is_written_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, graph: PortGraph
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.json"
    write_node_link(graph, path)
    assert same(read_graph(path), graph)
    as_networkx = nx.node_link_graph(json.loads(path.read_bytes()), edges="edges")
    assert isinstance(as_networkx, nx.MultiGraph)
    assert list(as_networkx) == list(graph.names)
    assert as_networkx.number_of_edges() == len(graph.ends)


@pytest.mark.parametrize("edges", ["edges", "links"])
@pytest.mark.parametrize("kind", [nx.Graph, nx.DiGraph, nx.MultiGraph, nx.MultiDiGraph])
def test_what_networkx_writes_is_read(kind: type[nx.Graph], edges: str) -> None:
    graph = kind([(5, 3), (3, "s"), (5, "s")])
    graph.add_edge(3, 5, weight=2)
    graph.add_node((0, 1))
    read = parse(json.dumps(nx.node_link_data(graph, edges=edges)), ".json")
    assert read.names == ("5", "3", "s", "0,1")
    assert len(read.ends) == graph.number_of_edges()
    assert set(read.lengths) == {None, 2}


def test_length_comes_before_weight_and_null_is_none() -> None:
    text = (
        '{"nodes":[{"id":1,"x":null,"y":2},{"id":"b"}],"links":[{"source":1,"target":"b","key":0,'
        '"length":3,"weight":4},{"source":"1","target":1,"length":null,"weight":4}]}'
    )
    graph = parse(text, ".json")
    assert (graph.ends, graph.lengths, graph.positions) == (((0, 1), (0, 0)), (3, 4), None)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"nodes":\n[}', "map.json:2: expected well-formed JSON, found JSON is malformed"),
        ('{"nodes":[]\n\n', "map.json:3: expected well-formed JSON, found Input data was trunc"),
        ("[]", "map.json: found no node-link graph: Expected `object`, got `array`"),
        ("{}", "map.json: found no node-link graph: Object missing required field `nodes`"),
        ('{"nodes":[{"id":1}]}', "map.json: found neither of `$.edges` and `$.links`, expected"),
        ('{"nodes":[{"id":1}],"edges":[],"links":[]}', "map.json: found both of `$.edges`"),
        ('{"nodes":[],"edges":[]}', "map.json: found `$.nodes` empty, expected at least one"),
        (
            '{"nodes":[{"id":true}],"edges":[]}',
            "map.json: found no node-link graph: Expected `int | float | str | array`",
        ),
        (
            '{"nodes":[{"id":1,"x":"a"}],"edges":[]}',
            "map.json: found no node-link graph: Expected `float | null`, got `str`",
        ),
        (
            '{"nodes":[{"id":1},{"id":"1"}],"edges":[]}',
            "map.json: `$.nodes[1].id`: found vertex '1' again, expected each id once",
        ),
        ('{"nodes":[{"id":""}],"edges":[]}', "map.json: `$.nodes[0].id`: found vertex name ''"),
        (
            '{"nodes":[{"id":1}],"links":[{"source":1,"target":2}]}',
            "map.json: `$.links[0].target`: found '2', expected the id of a node",
        ),
        (
            '{"nodes":[{"id":1}],"edges":[{"source":1}]}',
            (
                "map.json: found no node-link graph: Object missing required field `target` "
                "- at `$.edges[0]`"
            ),
        ),
        (
            '{"nodes":[{"id":1}],"edges":[{"source":1,"target":1,"length":-1}]}',
            "map.json: found no node-link graph: Expected `float` >= 0.0 - at `$.edges[0].length`",
        ),
        (
            '{"nodes":[{"id":1e999}],"edges":[]}',
            "map.json: found no node-link graph: Number out",
        ),
        ('{"nodes":[{"id":NaN}],"edges":[]}', "map.json:1: expected well-formed JSON, found"),
        ('{"a":' + "[" * 100_000, "map.json: found JSON nested too deeply, expected nodes"),
        (b'{"nodes":[\n{"id":"\xff"}]}', "map.json:2: found byte 0xff, expected text in UTF-8"),
    ],
)
def test_malformed_node_link(content: str | bytes, message: str) -> None:
    refused(content, ".json", message)


# Any bytes ---------------------------------------------------------------------------------------

PIECES = {
    ".edges": ["a", "b", "#", "1.5", "-1", "nan", "\t", " ", "\n", "\r", "\ufeff", "\0", "\x85"],
    ".graphml": [
        *('<?xml version="1.0"', ' encoding="', "utf-8", "utf-16", "idna", "hex", '"?>', "<!--"),
        *("<graphml>", "</graphml>", "<graph>", "</graph>", '<node id="a"/>', '<node id="', '"/>'),
        *('<edge source="a" target="a">', "</edge>", '<data key="l">', "</data>", "&#0;", "&a;"),
        *(
            '<key id="l" for="edge" attr.name="length">',
            "</key>",
            "<default>",
            "1",
            "x:",
            "<![CDATA[",
        ),
        *("<!DOCTYPE graphml", ' SYSTEM "x"', "[", "]", '<!ENTITY a "b">', ">", "\n", "\ufeff"),
    ],
    ".json": [
        *('{"nodes":[', '{"id":', '"x":', '"y":', '"edges":[', '"links":[', '{"source":', "}", "]"),
        *(
            '"target":',
            '"length":',
            '"weight":',
            ",",
            "1",
            "-1",
            "1e999",
            '"\\ud800"',
            '"a"',
            "null",
        ),
        *("[", "{", '"', "\\", "9" * 5000, "NaN", "true", "\n", "\ufeff"),
    ],
}


def mixtures(suffix: str) -> st.SearchStrategy[bytes]:
    pieces = [piece.encode() for piece in PIECES[suffix]]
    mixed = st.lists(st.sampled_from(pieces) | st.binary(max_size=3), max_size=30).map(b"".join)
    return st.one_of(mixed, st.binary(max_size=60), st.text(max_size=40).map(str.encode))


@given(st.sampled_from(sorted(PIECES)).flatmap(lambda s: st.tuples(st.just(s), mixtures(s))))
@example((".graphml", b'<?xml version="1.0" encoding="utf-7"?><graphml/>'))
@example((".graphml", b'<?xml version="1.0" encoding="idna"?><graphml/>'))
@example((".json", b'{"nodes":[{"id":' + b"9" * 5000 + b'}],"edges":[]}'))
@example((".json", b'{"nodes":[{"id":"\\ud800"}],"edges":[]}'))
def test_any_bytes_give_a_graph_or_a_map_error_of_one_line(case: tuple[str, bytes]) -> None:
    suffix, data = case
    try:
        graph = parse(data, suffix)
    except MapError as error:
        text = str(error)
        assert text.startswith(f"map{suffix}:")
        assert len(text.splitlines()) == 1
        assert len(text) < 300
    else:
        assert graph.names


# Files -------------------------------------------------------------------------------------------


def test_suffixes_in_any_case(tmp_path: Path) -> None:
    path = tmp_path / "MAP.EDGES"
    path.write_text("a b\n")
    assert read_graph(path).names == ("a", "b")


@pytest.mark.parametrize("suffix", sorted(READERS))
@pytest.mark.parametrize("content", [b"", b"\n \t\r\n", b"\xef\xbb\xbf", b"\xef\xbb\xbf\n"])
def test_empty_files(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"map{suffix}"
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"map\.\w+: the file is empty, expected a graph with"):
        read_graph(path)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    def message(path: Path) -> str:
        with pytest.raises(MapError) as caught:
            read_graph(path)
        return str(caught.value)

    assert message(tmp_path / "a.edges").endswith("a.edges: no such file, expected a graph file")
    assert message(tmp_path).endswith(": is a directory, expected a graph file")
    (tmp_path / "a.gml").touch()
    assert message(tmp_path / "a.gml").endswith(
        "a.gml: unknown suffix '.gml', expected one of .edges, .graphml, .xml, .json"
    )
    (tmp_path / "a").touch()
    assert "unknown suffix ''" in message(tmp_path / "a")
    assert "not a directory" in message(tmp_path / "a" / "b.edges").lower()
    assert "cannot be read" in message(tmp_path / "a\0.edges")
    assert "cannot be read" in message(tmp_path / ("a" * 5000 + ".edges"))
    os.mkfifo(tmp_path / "pipe.edges")
    assert message(tmp_path / "pipe.edges").endswith("is no regular file, expected a graph file")


def test_the_shipped_cave() -> None:
    graph = read_graph(ROOT / "deploy" / "maps" / "cave.json")
    assert (len(graph.names), len(graph.ends)) == (180, 191)
    assert -1 not in graph.distances(0)
    assert graph.positions is not None
    assert None not in graph.lengths


@pytest.mark.parametrize(
    ("file", "vertices", "edges", "first", "radius"),
    [
        ("cave/DowProv.edges", 711, 714, "dowcave.dow1.1", 315),
        ("nav2_route/turtlebot4_graph.edges", 34, 39, "1", None),
        ("osm/planet_10.068,48.135_10.071,48.137.edges", 38, 36, "7119017425", 16),
        ("rmf/clinic.edges", 95, 99, "L1:363", 15),
        ("rmf/office.edges", 29, 30, "L1:39", 8),
        ("subt/cave_circuit_01.edges", 158, 163, "0", 61),
        ("subt/niosh_sr_config_a.edges", 12, 17, "0", 4),
        ("subt/tunnel_circuit_practice_01.edges", 253, 309, "0", 23),
        ("zoo/Cogentco.edges", 197, 243, "0", 24),
        ("zoo/Cogentco.graphml", 197, 245, "0", 24),
    ],
)
def test_real_maps(
    *,
    shared: Callable[..., Path],
    file: str,
    vertices: int,
    edges: int,
    first: str,
    radius: int | None,
) -> None:
    graph = read_graph(shared("maps", "graphs", *file.split("/")))
    assert (len(graph.names), len(graph.ends), graph.names[0]) == (vertices, edges, first)
    if radius is not None:
        assert max(graph.distances(0)) == radius


def test_real_graphml_is_in_file_order(shared: Callable[..., Path]) -> None:
    path = shared("maps", "graphs", "zoo", "Cogentco.graphml")
    graph = read_graph(path)
    listed = re.findall(r'<edge source="(\d+)" target="(\d+)"', path.read_text())
    assert [(graph.names[u], graph.names[v]) for u, v in graph.ends] == listed
    assert graph.positions is None  # 11 of its nodes have no coordinates
