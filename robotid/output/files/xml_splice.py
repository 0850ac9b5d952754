"""Edits of an XML file that do not change any other byte.

Elements are located by their first byte. An edit is a range of bytes and its replacement. The file
is not written from a tree, so comments, order, quotes and line ends are unchanged.
"""

import codecs
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from xml.parsers import expat

from robotid.base.exceptions import ModelError

# the tag at the start of an element; the value of an attribute may contain ">"
_TAG = re.compile(rb"<[^\s/>]+(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_ATTRIBUTE = re.compile(rb"\s([^\s=/>]+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_ENCODING = re.compile(rb"(?:\xef\xbb\xbf)?<\?xml[^>]*?\sencoding\s*=\s*[\"']([\w.:-]+)")
_BOMS = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}


@dataclass(frozen=True)
class Element:
    """One element and its range of bytes."""

    tag: str  # as written, with the prefix
    attributes: Mapping[str, str]
    start: int  # first byte of "<tag"
    inside: int  # first byte after the ">" that ends the start tag
    end: int  # first byte after the element
    children: tuple["Element", ...]  # the elements directly inside

    def find_all(self, tag: str) -> tuple["Element", ...]:
        """Return the elements of one name directly inside, in the order of the file."""
        return tuple(child for child in self.children if child.tag == tag)


@dataclass(frozen=True)
class Document:
    """The content of an XML file."""

    data: bytes  # its text in UTF-8; offsets of elements count these bytes
    root: Element  # the outermost element
    codec: str  # the encoding of the file


@dataclass(frozen=True)
class Edit:
    """A range of bytes and its replacement."""

    start: int  # first byte replaced
    stop: int  # first byte after the range; equal to start for an insertion
    text: bytes


def parse(data: bytes, where: str) -> Document:
    """Locate the elements of an XML file."""
    codec = _codec(data, where)
    try:
        text = data.decode(codec).encode("utf-8")
    except UnicodeDecodeError as error:
        raise ModelError(f"{where} declares {codec}, but has other bytes: {error}") from error
    return Document(text, _root(text, where), codec)


def apply(document: Document, edits: Iterable[Edit]) -> bytes:
    """Return the file with its edits, in its own encoding."""
    pieces, at = [], 0
    for edit in sorted(edits, key=lambda e: (e.start, e.stop)):
        if edit.start < at:
            raise ModelError(f"two edits of the XML overlap at byte {edit.start}")
        pieces += [document.data[at : edit.start], edit.text]
        at = edit.stop
    text = b"".join([*pieces, document.data[at:]])
    return text if document.codec == "utf-8" else text.decode("utf-8").encode(document.codec)


def replace(document: Document, element: Element, lines: Sequence[str]) -> Edit:
    """Return the edit that replaces an element."""
    text = _layout(document, lines, _indent(document, element))
    return Edit(element.start, element.end, text)


def remove(document: Document, element: Element) -> Edit:
    """Return the edit that removes an element, with its lines if they have no other content."""
    indent = _indent(document, element)
    rest = re.compile(rb"[ \t]*(\r\n|\n|\r)").match(document.data, element.end)
    if indent is None or rest is None:
        return Edit(element.start, element.end, b"")
    return Edit(element.start - len(indent), rest.end(), b"")


def insert(document: Document, parent: Element, lines: Sequence[str]) -> Edit:
    """Return the edit that inserts a new element as the last child of another."""
    outer = _indent(document, parent)
    if parent.children:
        at, indent = parent.children[-1].end, _indent(document, parent.children[-1])
    else:
        at, indent = parent.inside, None if outer is None else outer + _unit(document)
    text = _line_break(document, indent) + _layout(document, lines, indent)
    if parent.inside != parent.end:  # not <tag/>
        return Edit(at, at, text)
    closing = _line_break(document, outer) + b"</" + parent.tag.encode() + b">"
    return Edit(parent.end - 2, parent.end, b">" + text + closing)


def set_attributes(document: Document, element: Element, values: Mapping[str, str]) -> list[Edit]:
    """Return the edits that set attributes of an element."""
    edits, missing = [], dict(values)
    for match in _ATTRIBUTE.finditer(document.data, element.start, element.inside):
        value = missing.pop(match[1].decode(), None)
        if value is not None:
            edits.append(Edit(match.start(2) + 1, match.end(2) - 1, value.encode()))
    if missing:
        tag = document.data[element.start : element.inside]
        at = element.start + len(tag.removesuffix(b">").removesuffix(b"/").rstrip())
        text = "".join(f' {key}="{value}"' for key, value in missing.items())
        edits.append(Edit(at, at, text.encode()))
    return edits


def _root(data: bytes, where: str) -> Element:
    """Return the outermost element, built from the events of expat."""
    parser = expat.ParserCreate("utf-8")
    top: list[Element] = []
    inner = [top]  # children of the open elements
    opened: list[tuple[dict[str, str], int, int]] = []  # attributes, start, inside of them

    def start_element(tag: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        match = _TAG.match(data, start)
        if match is None or not data.startswith(b"<" + tag.encode(), start):
            raise ModelError(
                f"{where}: <{tag}> near byte {start} is inside an entity and cannot be edited; "
                "expand the entities of the file with xmllint --noent"
            )
        opened.append((attributes, start, match.end()))
        inner.append([])

    def end_element(tag: str) -> None:
        attributes, start, end = opened.pop()
        inside = end
        if data[inside - 2 : inside] != b"/>":
            end = data.index(b">", parser.CurrentByteIndex) + 1
        children = tuple(inner.pop())
        inner[-1].append(Element(tag, attributes, start, inside, end, children))

    parser.StartElementHandler, parser.EndElementHandler = start_element, end_element
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ModelError(f"{where} is not well-formed XML: {error}") from error
    return top[0]


def _codec(data: bytes, where: str) -> str:
    for bom, codec in _BOMS.items():
        if data.startswith(bom):
            return codec
    declared = _ENCODING.match(data)
    try:
        return codecs.lookup(declared[1].decode() if declared else "utf-8").name
    except LookupError as error:
        raise ModelError(f"{where}: {error}; save the file as UTF-8") from error


def _indent(document: Document, element: Element) -> bytes | None:
    """Return the blanks before an element that starts a line, None for other elements."""
    data, start = document.data, element.start
    line = 1 + max(data.rfind(b"\n", 0, start), data.rfind(b"\r", 0, start))
    blanks = data[line:start]
    return blanks if line > 0 and not blanks.strip(b" \t") else None


def _unit(document: Document) -> bytes:
    """Return the unit of indentation: that of the first child of the outermost element."""
    indents = (_indent(document, child) for child in document.root.children)
    return next((indent for indent in indents if indent), b"  ")


def _line_break(document: Document, indent: bytes | None) -> bytes:
    """Return the line end of the file with an indentation, nothing without one."""
    found = re.search(rb"\r\n|\n|\r", document.data)
    return b"" if indent is None else (found[0] if found else b"\n") + indent


def _layout(document: Document, lines: Sequence[str], indent: bytes | None) -> bytes:
    first, *others = [line.encode() for line in lines]
    inner = None if indent is None else indent + _unit(document)
    breaks = [_line_break(document, inner)] * (len(others) - 1) + [_line_break(document, indent)]
    return first + b"".join(lead + line for lead, line in zip(breaks, others, strict=False))
