"""XML from unknown sources: no entity is expanded, and depth and size are bounded."""

from __future__ import annotations

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

MOST_BYTES = 64 * 1024**2
_DEEPEST = 200


class XmlError(ValueError):
    """A document that cannot be read. `line` is 0 if the problem has no place."""

    def __init__(self, problem: str, line: int = 0) -> None:
        super().__init__(problem)
        self.line = line


def xml_tree(content: bytes | str, *, doctype: bool = False) -> Element:
    """Return the root of a document. Names of elements are without namespaces; comments are omitted.

    A document type is refused unless `doctype`, and is not loaded then. Declarations of entities are refused. Raises
    XmlError.
    """
    if len(content) > MOST_BYTES:
        raise XmlError(f"holds more than {MOST_BYTES // 1024**2} MiB of XML")
    builder, parser, depth = TreeBuilder(), expat.ParserCreate(namespace_separator=" "), 0
    parser.buffer_text = True

    def refuse_doctype(*_: object) -> None:
        if not doctype:
            raise XmlError("has a document type (<!DOCTYPE>)", parser.CurrentLineNumber)

    def refuse_entity(name: str, *_: object) -> None:
        raise XmlError(f"declares the entity {name}", parser.CurrentLineNumber)

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise XmlError(f"is nested more than {_DEEPEST} deep", parser.CurrentLineNumber)
        builder.start(name.rpartition(" ")[2], attributes)

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name.rpartition(" ")[2])

    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise XmlError(f"is not XML ({expat.ErrorString(error.code)})", error.lineno) from None
    except (UnicodeError, LookupError) as error:
        raise XmlError(f"is not XML ({error})") from None
    return builder.close()
