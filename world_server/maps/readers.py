"""Readers of graph files: ``.edges``, GraphML and node-link JSON.

The order of the edges in a file numbers the ports, so every reader keeps it; a file that means the
same graph in another order is another map. Vertices are numbered in the order in which the file
names them (GraphML and JSON: in the order of their node list). Whatever the bytes are, a reader
gives a graph or raises `protocol.errors.MapError` with one line: file, place, found, expected.
"""

import math
import re
import stat
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated
from xml.parsers import expat  # declarations of entities are refused: see _Graphml

import msgspec

from protocol.errors import MapError
from protocol.graph import PortGraph

GRAPHML_NAMESPACE = "http://graphml.graphdrawing.org/xmlns"
LENGTH_EXPECTED = "a finite length >= 0"
POSITION_ATTRIBUTES = (("x", "y"), ("Longitude", "Latitude"))
SHOWN = 60
"""Characters of a file's content that an error message repeats."""


def read_graph(path: Path) -> PortGraph:
    """Read a graph from a file whose suffix tells its format.

    Args:
        path: A file ending in ``.edges``, ``.graphml``, ``.xml`` or ``.json`` (any case).

    Returns:
        The graph, all components of it; ports are numbered by edge in file order.

    Raises:
        MapError: If the file cannot be read or does not hold a graph with at least one vertex.
    """
    data = load(path, "a graph file", "a graph with at least one vertex", READERS)
    return READERS[path.suffix.lower()](path, data)


def load(path: Path, kind: str, content: str, suffixes: Collection[str] | None = None) -> bytes:
    """Load a file that belongs to a map, for a reader.

    Args:
        path: The file.
        kind: What sort of file is expected, for messages.
        content: What it must hold, for messages.
        suffixes: Those that can be read, in lower case; ``None`` if the suffix does not matter.

    Returns:
        The bytes of the file, not all of them white space.

    Raises:
        MapError: If the suffix is unknown, or the file is missing, unreadable or empty.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise MapError(f"{path}: no such file, expected {kind}") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL character
        raise MapError(f"{path!s:.{SHOWN}}: cannot be read: {_reason(error)}") from None
    if stat.S_ISDIR(mode):
        raise MapError(f"{path}: is a directory, expected {kind}")
    if suffixes is not None and path.suffix.lower() not in suffixes:
        known = ", ".join(suffixes)
        raise MapError(f"{path}: unknown suffix {path.suffix!r}, expected one of {known}")
    if not stat.S_ISREG(mode):  # reading a pipe or a device might never end
        raise MapError(f"{path}: is no regular file, expected {kind}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {_reason(error)}") from None
    if not data.removeprefix(b"\xef\xbb\xbf").strip():
        raise MapError(f"{path}: the file is empty, expected {content}")
    return data


def _read_edges(path: Path, data: bytes) -> PortGraph:
    """Read a plain edge list: ``u v``, ``u v length`` or a lone vertex on each line.

    Fields are separated by white space, so a name cannot contain any. A field that begins with
    ``#`` turns the rest of its line into a comment.

    Args:
        path: Where the bytes come from, for messages.
        data: Content of the file, UTF-8 with or without byte order mark.

    Returns:
        The graph; vertices in order of first appearance.

    Raises:
        MapError: If a line is not as described, or no vertex is named.
    """
    number: dict[str, int] = {}
    ends: list[tuple[int, int]] = []
    lengths: list[float | None] = []
    for index, line in enumerate(lines_of(path, data), start=1):
        fields = line.split()
        for position, field in enumerate(fields):
            if field.startswith("#"):
                del fields[position:]
                break
        if not fields:
            continue
        where = f"{path}:{index}"
        if len(fields) > 3:
            raise MapError(
                f"{where}: found {len(fields)} fields in {show(line.strip())}, "
                "expected two vertices and perhaps a length, or one isolated vertex"
            )
        vertices = [number.setdefault(_name(where, name), len(number)) for name in fields[:2]]
        if len(vertices) == 2:
            ends.append((vertices[0], vertices[1]))
            lengths.append(_length(where, fields[2]) if len(fields) == 3 else None)
    if not number:
        raise MapError(f"{path}: found only blank lines and comments, expected at least one vertex")
    return PortGraph(list(number), ends, lengths)


class _Element:
    """A ``node`` or ``edge`` element of a GraphML file, as found.

    Attributes:
        line: Line of its start tag.
        attributes: The attributes of that tag.
        data: Text of each ``data`` child by the id of its key.
    """

    __slots__ = ("attributes", "data", "line")

    def __init__(self, line: int, attributes: dict[str, str]) -> None:
        self.line = line
        self.attributes = attributes
        self.data: dict[str, str] = {}


class _Graphml:
    """Collects the elements of a GraphML document while expat walks it.

    Attributes:
        nodes: The node elements in file order.
        edges: The edge elements in file order.
        encoding: The encoding that the XML declaration names, if any.
    """

    def __init__(self, path: Path) -> None:
        self.nodes: list[_Element] = []
        self.edges: list[_Element] = []
        self.encoding: str | None = None
        self._path = path
        self._open: list[str] = []
        self._graphs = 0
        self._keys: list[dict[str, str]] = []
        self._defaults: dict[str, str] = {}
        self._element: _Element | None = None
        self._data_key = ""
        self._text: list[str] = []
        self._parser = expat.ParserCreate(namespace_separator=" ")
        self._parser.buffer_text = True
        self._parser.XmlDeclHandler = self._declaration
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._text.append

    def parse(self, data: bytes) -> None:
        """Walk the whole document.

        Args:
            data: Content of the file.

        Raises:
            MapError: If the document is no GraphML with one plain graph.
            ExpatError: If it is not well-formed.
            LookupError: If it names an encoding that does not exist.
            ValueError: If it names an encoding that expat cannot use.
        """
        self._parser.Parse(data, True)
        if not self._graphs:
            raise self._error("found no <graph> element, expected one")

    def attribute_keys(self, of: str, name: str) -> dict[str, str | None]:
        """Return the ids of the keys of an attribute, with the default value of each.

        Args:
            of: ``"node"`` or ``"edge"``.
            name: Name of the attribute, as in ``attr.name``.
        """
        return {
            key["id"]: self._defaults.get(key["id"])
            for key in self._keys
            if "id" in key and key.get("attr.name") == name and key.get("for", "all") in {of, "all"}
        }

    def _error(self, text: str) -> MapError:
        return MapError(f"{self._path}:{self._parser.CurrentLineNumber}: {text}")

    def _declaration(self, _version: str, encoding: str | None, _standalone: int) -> None:
        self.encoding = encoding

    def _doctype(self, _name: str, _system: str | None, _public: str | None, inner: int) -> None:
        # Entities that expand to entities grow exponentially, and default attributes quadratically.
        # Both need declarations inside the file, which no GraphML needs. References to outside are
        # harmless: without a handler expat does not follow them.
        if inner:
            raise self._error("found declarations in <!DOCTYPE>, expected GraphML without them")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        namespace, _, local = name.rpartition(" ")
        if namespace not in {"", GRAPHML_NAMESPACE}:
            local = ""  # drawing data of editors: passed over with all that is in it
        parent = self._open[-1] if self._open else None
        self._open.append(local)
        del self._text[:]
        line = self._parser.CurrentLineNumber
        match parent, local:
            case None, "graphml":
                pass
            case None, _:
                raise self._error(f"found root element <{_cut(name)}>, expected <graphml>")
            case "graphml", "key":
                self._keys.append(attributes)
            case "graphml", "graph":
                self._graphs += 1
                if self._graphs > 1:
                    raise self._error("found a second <graph>, expected one")
            case "graph", "node":
                self._element = _Element(line, attributes)
                self.nodes.append(self._element)
            case "graph", "edge":
                self._element = _Element(line, attributes)
                self.edges.append(self._element)
            case "node" | "edge", "data":
                self._data_key = self._attribute("data", attributes, "key")
            case "node" | "edge" | "graph", "graph" | "hyperedge":
                raise self._error(f"found <{local}> in <{parent}>, expected a plain graph")
            case _:
                pass

    def _end(self, _name: str) -> None:
        local = self._open.pop()
        parent = self._open[-1] if self._open else ""
        if local == "data" and parent in {"node", "edge"} and self._element is not None:
            self._element.data[self._data_key] = "".join(self._text)
        elif local == "default" and parent == "key" and "id" in self._keys[-1]:
            self._defaults[self._keys[-1]["id"]] = "".join(self._text)

    def _attribute(self, element: str, attributes: dict[str, str], name: str) -> str:
        try:
            return attributes[name]
        except KeyError:
            raise self._error(f"found <{element}> without {name}, expected one") from None


def _read_graphml(path: Path, data: bytes) -> PortGraph:
    """Read a GraphML file; edge lengths from ``length`` or ``weight``, positions if complete.

    The file is parsed here and not by networkx because the latter gives edges by adjacency, which
    is not their order in the file, and because it names no lines. The parser takes the whole file
    at once (in pieces a long token costs quadratic time) and refuses declarations of entities.

    Args:
        path: Where the bytes come from, for messages.
        data: Content of the file, in an encoding that XML can declare.

    Returns:
        The graph; a directed edge counts as undirected.

    Raises:
        MapError: If the file is no GraphML, or holds nested graphs, hyperedges or no vertex.
    """
    document = _Graphml(path)
    try:
        document.parse(data)
    except expat.ExpatError as error:
        if document.encoding is None and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
            decode(path, data)
        problem = expat.ErrorString(error.code) or "an error"
        where = f"{path}:{error.lineno}"
        raise MapError(f"{where}: expected well-formed XML, found {problem}") from None
    except (LookupError, ValueError):
        found = show(document.encoding or "")
        raise MapError(f"{path}:1: found encoding {found}, expected utf-8") from None
    number: dict[str, int] = {}
    for node in document.nodes:
        where = f"{path}:{node.line}"
        name = _name(where, _required(where, "node", node, "id"))
        if number.setdefault(name, len(number)) != len(number) - 1:
            raise MapError(f"{where}: found vertex {show(name)} again, expected each id once")
    if not number:
        raise MapError(f"{path}: found no <node> element, expected at least one vertex")
    ends: list[tuple[int, int]] = []
    for edge in document.edges:
        where = f"{path}:{edge.line}"
        pair = [_required(where, "edge", edge, end) for end in ("source", "target")]
        for end, name in zip(("source", "target"), pair, strict=True):
            if name not in number:
                raise MapError(f"{where}: found edge {end} {show(name)}, expected a node id")
        ends.append((number[pair[0]], number[pair[1]]))
    length_keys = {
        **document.attribute_keys("edge", "length"),
        **document.attribute_keys("edge", "weight"),
    }
    lengths: list[float | None] = []
    for edge in document.edges:
        text = _value(edge, length_keys)
        lengths.append(None if text is None else _length(f"{path}:{edge.line}", text))
    return PortGraph(list(number), ends, lengths, _graphml_positions(path, document))


def _graphml_positions(path: Path, document: _Graphml) -> list[tuple[float, float]] | None:
    """Return the position of each vertex if every one has the same pair of attributes."""
    for names in POSITION_ATTRIBUTES:
        horizontal, vertical = (document.attribute_keys("node", name) for name in names)
        positions: list[tuple[float, float]] = []
        for node in document.nodes:
            x, y = _value(node, horizontal), _value(node, vertical)
            if x is None or y is None:
                break
            where = f"{path}:{node.line}"
            expected = "a finite coordinate"
            positions.append((finite(where, x, expected), finite(where, y, expected)))
        else:
            return positions
    return None


def _value(element: _Element, keys: Mapping[str, str | None]) -> str | None:
    """Return the first of the values that ``element`` has under ``keys``, or their default."""
    for key in keys:
        if key in element.data:
            return element.data[key]
    return next((default for default in keys.values() if default is not None), None)


def _required(where: str, tag: str, element: _Element, attribute: str) -> str:
    """Return an attribute that ``element`` must have."""
    try:
        return element.attributes[attribute]
    except KeyError:
        raise MapError(f"{where}: found <{tag}> without {attribute}, expected one") from None


_Id = str | int | float | list[str | int | float]
_Length = Annotated[float, msgspec.Meta(ge=0)] | None


class _Node(msgspec.Struct, gc=False):
    """An entry of ``nodes``; attributes that are not named here are passed over."""

    id: _Id
    x: float | None = None
    y: float | None = None


class _Link(msgspec.Struct, gc=False):
    """An entry of ``edges`` or ``links``; its key only tells parallels apart, so it is not read."""

    source: _Id
    target: _Id
    length: _Length = None
    weight: _Length = None


class _NodeLink(msgspec.Struct):
    """The node-link document, as networkx writes it (``links`` up to version 3.3)."""

    nodes: list[_Node]
    edges: list[_Link] | None = None
    links: list[_Link] | None = None
    directed: bool = False


_NODE_LINK = msgspec.json.Decoder(_NodeLink)


def _read_node_link(path: Path, data: bytes) -> PortGraph:
    """Read node-link JSON; edge lengths from ``length`` or else ``weight``.

    Args:
        path: Where the bytes come from, for messages.
        data: Content of the file, UTF-8 with or without byte order mark.

    Returns:
        The graph; an edge of a directed graph counts as undirected.

    Raises:
        MapError: If the document is not node-link JSON, or lists no vertex.
    """
    document = _decode_node_link(path, decode(path, data))
    if (document.edges is None) == (document.links is None):
        found = "neither" if document.edges is None else "both"
        raise MapError(f"{path}: found {found} of `$.edges` and `$.links`, expected one of them")
    if not document.nodes:
        raise MapError(f"{path}: found `$.nodes` empty, expected at least one vertex")
    number: dict[str, int] = {}
    for index, node in enumerate(document.nodes):
        where = f"{path}: `$.nodes[{index}].id`"
        name = _name(where, _identity(node.id))
        if number.setdefault(name, len(number)) != index:
            raise MapError(f"{where}: found vertex {show(name)} again, expected each id once")
    place, links = "edges", document.edges
    if links is None:
        place, links = "links", document.links or []
    ends: list[tuple[int, int]] = []
    for index, link in enumerate(links):
        pair = (_identity(link.source), _identity(link.target))
        for end, name in zip(("source", "target"), pair, strict=True):
            if name not in number:
                where = f"{path}: `$.{place}[{index}].{end}`"
                raise MapError(f"{where}: found {show(name)}, expected the id of a node")
        ends.append((number[pair[0]], number[pair[1]]))
    return PortGraph(
        list(number),
        ends,
        [link.weight if link.length is None else link.length for link in links],
        _node_link_positions(document.nodes),
    )


def _decode_node_link(path: Path, text: str) -> _NodeLink:
    """Decode the JSON and check its types."""
    try:
        return _NODE_LINK.decode(text)
    except msgspec.ValidationError as error:
        raise MapError(f"{path}: found no node-link graph: {one_line(str(error))}") from None
    except msgspec.DecodeError as error:
        # msgspec names the byte; people look for a line.
        byte = re.search(r"\(byte (\d+)\)", str(error))
        line = 1 + text.encode().count(b"\n", 0, int(byte[1])) if byte else 1 + text.count("\n")
        problem = one_line(str(error))
        raise MapError(f"{path}:{line}: expected well-formed JSON, found {problem}") from None
    except RecursionError:
        raise MapError(f"{path}: found JSON nested too deeply, expected nodes and edges") from None


def _node_link_positions(nodes: Sequence[_Node]) -> list[tuple[float, float]] | None:
    """Return the position of each vertex if all have one."""
    positions: list[tuple[float, float]] = []
    for node in nodes:
        if node.x is None or node.y is None:
            return None
        positions.append((node.x, node.y))
    return positions


def _identity(value: _Id) -> str:
    """Return the name of a vertex; networkx writes the tuples of its grids as lists."""
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def lines_of(path: Path, data: bytes) -> list[str]:
    """Decode a whole file and split it into lines, the last of them empty if it ends in a newline.

    Line ends are normalised by hand: str.splitlines also breaks at form feeds and the like, and the
    line numbers in messages would no longer be those of an editor.
    """
    return decode(path, data).replace("\r\n", "\n").replace("\r", "\n").split("\n")


def decode(path: Path, data: bytes) -> str:
    """Decode a whole file, without its byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # The codec counts from behind the byte order mark; its own copy of the bytes does too.
        line = 1 + error.object.count(b"\n", 0, error.start)
        found = f"byte 0x{error.object[error.start]:02x}"
        raise MapError(f"{path}:{line}: found {found}, expected text in UTF-8") from None


def _name(where: str, name: str) -> str:
    """Check that a vertex name can be printed on one line, so that messages can carry it."""
    if not name or not name.isprintable():
        raise MapError(f"{where}: found vertex name {show(name)}, expected printable characters")
    return name


def _length(where: str, text: str) -> float:
    """Read the length of an edge."""
    length = finite(where, text, LENGTH_EXPECTED)
    if length < 0:
        raise MapError(f"{where}: found {show(text)}, expected {LENGTH_EXPECTED}")
    return length + 0.0  # turns the -0.0 that "-0" gives into 0.0


def finite(where: str, text: str, expected: str) -> float:
    """Read a finite number; unlike ``float``, take no underscores and no foreign digits."""
    try:
        number = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise MapError(f"{where}: found {show(text)}, expected {expected}")
    return number


def _reason(error: Exception) -> str:
    """Say in words why the system refused a file."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _cut(text: str) -> str:
    """Shorten a piece of a file for a message."""
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


def show(text: str) -> str:
    """Quote a piece of a file for a message, on one line."""
    return ascii(_cut(text)) if not text.isprintable() else repr(_cut(text))


def one_line(text: str) -> str:
    """Put the message of a library on one line, without what makes it endless."""
    line = " ".join(text.split())
    return line if len(line) <= 3 * SHOWN else line[: 3 * SHOWN - 3] + "..."


READERS: dict[str, Callable[[Path, bytes], PortGraph]] = {
    ".edges": _read_edges,
    ".graphml": _read_graphml,
    ".xml": _read_graphml,
    ".json": _read_node_link,
}
"""The reader of each suffix."""
