import pytest

from robotid.base.exceptions import ModelError
from robotid.output.files.xml_splice import (
    Edit,
    apply,
    insert,
    parse,
    remove,
    replace,
    set_attributes,
)

LINES = ["<new>", "<a/>", "</new>"]


def edited(data, change, where="x.urdf"):
    document = parse(data, where)
    edits = change(document)
    return apply(document, edits if isinstance(edits, list) else [edits])


def first(document, *tags):
    element = document.root
    for tag in tags:
        element = element.find_all(tag)[0]
    return element


@pytest.mark.parametrize(
    "data",
    [
        b"<r/>",
        b'<?xml version="1.0"?>\r\n<!-- > -->\r\n<r a=">" b=\'"\' >\r\n<c/ ></r>'.replace(
            b"/ >", b"/>"
        ),
        b'\xef\xbb\xbf<r xmlns:x="u"><x:c><![CDATA[<d>]]></x:c><?p <d>?></r>\n\n',
        '<?xml version="1.0" encoding="ISO-8859-1"?><r n="é"/>'.encode("latin-1"),
        '\ufeff<r n="é">\n</r>'.encode("utf-16-le"),
        '\ufeff<r n="é">\n</r>'.encode("utf-16-be"),
    ],
)
def test_a_file_without_changes_comes_back_byte_for_byte(data):
    assert edited(data, lambda document: []) == data


def test_a_replaced_element_is_indented_like_the_file():
    data = b"<r>\r\n\t<l>\r\n\t\t<old/>\r\n\t</l>\r\n</r>"
    new = edited(data, lambda d: replace(d, first(d, "l", "old"), LINES))
    assert new == (b"<r>\r\n\t<l>\r\n\t\t<new>\r\n\t\t\t<a/>\r\n\t\t</new>\r\n\t</l>\r\n</r>")


def test_a_self_closing_element_is_opened():
    data = b'<r>\n    <l n="a" />\n</r>'
    assert edited(data, lambda d: insert(d, first(d, "l"), LINES)) == (
        b'<r>\n    <l n="a" >\n        <new>\n            <a/>\n        </new>\n    </l>\n</r>'
    )


def test_a_removed_element_takes_its_lines_along_only_if_it_has_them_alone():
    alone = b"<r>\n  <l>\n    <old>\n    </old>  \n    <k/>\n  </l>\n</r>"
    assert edited(alone, lambda d: remove(d, first(d, "l", "old"))) == (
        b"<r>\n  <l>\n    <k/>\n  </l>\n</r>"
    )
    shared = b"<r>\n  <l>\n    <old/> <!-- kept -->\n  </l>\n</r>"
    assert edited(shared, lambda d: remove(d, first(d, "l", "old"))) == (
        b"<r>\n  <l>\n     <!-- kept -->\n  </l>\n</r>"
    )


def test_attributes_are_changed_in_place_and_missing_ones_added():
    data = b"<r><d a='1' note=\"damping='3'\"  damping = '2' /></r>"
    new = edited(
        data, lambda d: set_attributes(d, first(d, "d"), {"damping": "5", "friction": "6"})
    )
    assert new == b"<r><d a='1' note=\"damping='3'\"  damping = '5' friction=\"6\" /></r>"


def test_what_cannot_be_edited_is_refused():
    with pytest.raises(ModelError, match=r"x.urdf is not well-formed XML: mismatched tag"):
        parse(b"<r><l></r>", "x.urdf")
    with pytest.raises(ModelError, match=r"x.urdf declares utf-8, but has other bytes"):
        parse(b'<r n="\xe9"/>', "x.urdf")
    entity = b'<!DOCTYPE r [<!ENTITY e "<l/>">]><r>&e;</r>'
    with pytest.raises(ModelError, match=r"<l> near byte \d+ is inside an entity"):
        parse(entity, "x.urdf")
    with pytest.raises(ModelError, match=r"x.urdf: unknown encoding: klingon"):
        parse(b'<?xml version="1.0" encoding="klingon"?><r/>', "x.urdf")
    document = parse(b"<r><l/></r>", "x.urdf")
    with pytest.raises(ModelError, match="two edits of the XML overlap at byte 4"):
        apply(document, [Edit(3, 7, b""), Edit(4, 5, b"")])
