"""Edits of an XML file that leave every other byte as it was.

The elements are located by the byte they start at; a change is a span of bytes and what replaces
it. Nothing is ever written from a tree, so comments, order, quotes and line ends survive.
"""

import codecs
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from xml.parsers import expat

from robotid.exceptions import ModelError

__all__ = [
    "Document",
    "Edit",
    "Element",
    "apply",
    "insert",
    "parse",
    "remove",
    "replace",
    "set_attributes",
]

# the tag at the start of an element; an attribute's value may hold ">"
_TAG = re.compile(rb"<[^\s/>]+(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_ATTRIBUTE = re.compile(rb"\s([^\s=/>]+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_BOMS = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}


@dataclass(frozen=True)
class Element:
    """One element and the bytes it takes.

    Attributes:
        tag: Its name as written, with the prefix.
        attributes: Its attributes.
        start: First byte of ``<tag``.
        inside: First byte after the ``>`` that ends the start tag.
        close: First byte of ``</tag``; equal to ``inside`` if the tag closes itself.
        end: First byte after the element.
        children: The elements directly inside.
    """

    tag: str
    attributes: Mapping[str, str]
    start: int
    inside: int
    close: int
    end: int
    children: tuple["Element", ...]

    @property
    def is_self_closing(self) -> bool:
        """Whether it is written as ``<tag/>``."""
        return self.inside == self.end

    def find_all(self, tag: str) -> tuple["Element", ...]:
        """Return the elements of one name directly inside, in the order of the file.

        Args:
            tag: Their name.

        Returns:
            The elements.
        """
        return tuple(child for child in self.children if child.tag == tag)


@dataclass(frozen=True)
class Document:
    """An XML file, read.

    Attributes:
        data: Its text in UTF-8; the offsets of the elements count these bytes.
        root: Its outermost element.
        codec: The codec of the file itself.
    """

    data: bytes
    root: Element
    codec: str


@dataclass(frozen=True)
class Edit:
    """A span of bytes and what comes in its place.

    Attributes:
        start: First byte replaced.
        stop: First byte kept again; equal to ``start`` to insert.
        text: The new bytes.
    """

    start: int
    stop: int
    text: bytes


def parse(data: bytes, where: str) -> Document:
    """Locate the elements of an XML file.

    Args:
        data: Content of the file, in any encoding that XML names.
        where: Name of the file, for errors.

    Returns:
        The document.

    Raises:
        ModelError: If it is not well-formed, or an element comes out of an entity.
    """
    codec = _codec(data, where)
    try:
        text = data.decode(codec).encode("utf-8")
    except UnicodeDecodeError as error:
        raise ModelError(f"{where} is not {codec} as it says: {error}") from error
    reader = _Reader(text, where)
    reader.run()
    return Document(text, reader.done[0], codec)


def apply(document: Document, edits: Iterable[Edit]) -> bytes:
    """Return the file with spans replaced, in its own encoding.

    Args:
        document: The file.
        edits: The changes; spans must not overlap.

    Returns:
        Content of the new file.

    Raises:
        ModelError: If two spans overlap.
    """
    pieces, at = [], 0
    for edit in sorted(edits, key=lambda e: (e.start, e.stop)):
        if edit.start < at:
            raise ModelError(f"two changes of the XML overlap at byte {edit.start}")
        pieces += [document.data[at : edit.start], edit.text]
        at = edit.stop
    text = b"".join([*pieces, document.data[at:]])
    return text if document.codec == "utf-8" else text.decode("utf-8").encode(document.codec)


def replace(document: Document, element: Element, lines: Sequence[str]) -> Edit:
    """Return the change that writes something else in the place of an element.

    Args:
        document: The file.
        element: What is replaced.
        lines: The new element, line by line: first, inner ones, last. They are indented like the
            file where the element starts a line of its own, and joined to one line elsewhere.

    Returns:
        The change.
    """
    indent = _indent(document, element)
    return Edit(element.start, element.end, _layout(document, lines, indent))


def remove(document: Document, element: Element) -> Edit:
    """Return the change that takes an element out, with its lines if nothing else is on them.

    Args:
        document: The file.
        element: What is removed.

    Returns:
        The change.
    """
    data = document.data
    indent = _indent(document, element)
    rest = re.compile(rb"[ \t]*(\r\n|\n|\r)").match(data, element.end)
    if indent is None or rest is None:
        return Edit(element.start, element.end, b"")
    return Edit(element.start - len(indent), rest.end(), b"")


def insert(document: Document, parent: Element, lines: Sequence[str]) -> Edit:
    """Return the change that puts a new element behind the last one inside another.

    Args:
        document: The file.
        parent: Where it goes.
        lines: The new element, as for ``replace``.

    Returns:
        The change.
    """
    outer = _indent(document, parent)
    if parent.children:
        last = parent.children[-1]
        indent = _indent(document, last)
        lead = b"" if indent is None else _newline(document) + indent
        return Edit(last.end, last.end, lead + _layout(document, lines, indent))
    indent = None if outer is None else outer + _unit(document)
    lead = b"" if indent is None else _newline(document) + indent
    text = lead + _layout(document, lines, indent)
    if parent.is_self_closing:
        tail = b"" if outer is None else _newline(document) + outer
        closing = b"</" + parent.tag.encode() + b">"
        return Edit(parent.end - 2, parent.end, b">" + text + tail + closing)
    return Edit(parent.inside, parent.inside, text)


def set_attributes(document: Document, element: Element, values: Mapping[str, str]) -> list[Edit]:
    """Return the changes that give attributes of an element new values.

    Args:
        document: The file.
        element: The element.
        values: New values by attribute; one that the element lacks is added behind the others.

    Returns:
        The changes.
    """
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


@dataclass
class _Reader:
    """Expat's events put together to elements; open ones wait in ``stack``."""

    data: bytes
    where: str
    stack: list[tuple[str, dict[str, str], int, int]] = field(default_factory=list)
    children: list[list[Element]] = field(default_factory=lambda: [[]])

    @property
    def done(self) -> list[Element]:
        return self.children[0]

    def run(self) -> None:
        self.parser = expat.ParserCreate("utf-8")
        self.parser.StartElementHandler = self._open
        self.parser.EndElementHandler = self._close
        try:
            self.parser.Parse(self.data, True)
        except expat.ExpatError as error:
            raise ModelError(f"{self.where} is not well-formed XML: {error}") from error

    def _open(self, tag: str, attributes: dict[str, str]) -> None:
        start = self.parser.CurrentByteIndex
        match = _TAG.match(self.data, start)
        if match is None or not self.data.startswith(b"<" + tag.encode(), start):
            raise ModelError(
                f"{self.where}: <{tag}> near byte {start} comes out of an entity, where it cannot "
                "be edited; expand the entities of the file first: xmllint --noent"
            )
        self.stack.append((tag, attributes, start, match.end()))
        self.children.append([])

    def _close(self, tag: str) -> None:
        _, attributes, start, inside = self.stack.pop()
        inner = tuple(self.children.pop())
        close = end = inside
        if self.data[inside - 2 : inside] != b"/>":
            close = self.parser.CurrentByteIndex
            end = self.data.index(b">", close) + 1
        self.children[-1].append(Element(tag, attributes, start, inside, close, end, inner))


def _codec(data: bytes, where: str) -> str:
    for bom, codec in _BOMS.items():
        if data.startswith(bom):
            return codec
    declared = re.compile(rb"(?:\xef\xbb\xbf)?<\?xml[^>]*?\sencoding\s*=\s*[\"']([\w.:-]+)").match(
        data
    )
    try:
        return codecs.lookup(declared[1].decode() if declared else "utf-8").name
    except LookupError as error:
        raise ModelError(f"{where}: {error}; save the file as UTF-8") from error


def _indent(document: Document, element: Element) -> bytes | None:
    """Return the blanks in front of an element that starts a line, None for any other."""
    data, start = document.data, element.start
    line = 1 + max(data.rfind(b"\n", 0, start), data.rfind(b"\r", 0, start))
    blanks = data[line:start]
    return blanks if line > 0 and not blanks.strip(b" \t") else None


def _unit(document: Document) -> bytes:
    """Return by how much the file indents: that of the first element inside the outermost one."""
    for child in document.root.children:
        indent = _indent(document, child)
        if indent:
            return indent
    return b"  "


def _newline(document: Document) -> bytes:
    found = re.search(rb"\r\n|\n|\r", document.data)
    return found[0] if found else b"\n"


def _layout(document: Document, lines: Sequence[str], indent: bytes | None) -> bytes:
    encoded = [line.encode() for line in lines]
    if indent is None:
        return b"".join(encoded)
    inner = indent + _unit(document)
    middle = [inner + line for line in encoded[1:-1]]
    last = [indent + line for line in encoded[1:][-1:]]
    return _newline(document).join([*encoded[:1], *middle, *last])
