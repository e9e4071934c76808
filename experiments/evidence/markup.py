"""HTML as a tree of elements, so that no text can become markup, and figures as parts of such a tree.

Names of runs and what their files say come from anywhere: they are only ever text or the value of an attribute.
"""

import base64
import hashlib
import re
import xml.etree.ElementTree as ET
from xml.etree.ElementTree import Element

from experiments.commandline.arguments import printable

SVG = "{http://www.w3.org/2000/svg}"
# Of matplotlib's, and of no use in a page.
LEFT_OUT = {"metadata", "style"}
REFERENCE = re.compile(r"url\(#([^)]+)\)")


def element(tag: str, *children: str | Element, **attributes: str | None) -> Element:
    """An element with text and elements in it.

    `aria_label="x"` and `class_="x"` are the attributes that they look like; None is none. Characters that are not to
    be seen are shown as escapes, but for line breaks and tabs.
    """
    made = Element(tag)
    for name, value in attributes.items():
        if value is not None:
            made.set(name.strip("_").replace("_", "-"), printable(value))
    for child in children:
        if isinstance(child, Element):
            made.append(child)
        elif len(made):
            made[-1].tail = (made[-1].tail or "") + printable(child, kept="\n\t")
        else:
            made.text = (made.text or "") + printable(child, kept="\n\t")
    return made


def inline_svg(content: bytes, prefix: str, described_by: str) -> Element:
    """One of matplotlib's SVG files as an element of a page.

    Its ids get a prefix, for several figures share a page. Styles become attributes, which mean the same and which a
    page without inline styles can show.

    Args:
      prefix: of its ids, another one for each figure.
      described_by: the id of the element that says what is to be seen.
    """
    # Comments hold the figure's texts, with characters that XML need not have.
    root = ET.fromstring(re.sub(rb"<!--.*?-->", b"", content, flags=re.DOTALL))
    svg = _plain(root, prefix)
    # What matplotlib's style sheet says of all elements.
    svg.attrib |= {"stroke-linejoin": "round", "stroke-linecap": "butt", "role": "img", "aria-labelledby": described_by}
    return svg


def _plain(node: Element, prefix: str) -> Element:
    """Without namespaces, as HTML has it, and without styles."""
    attributes: dict[str, str] = {}
    for name, value in node.attrib.items():
        name = name.rpartition("}")[2]
        if name == "style":
            pairs = [pair.split(":", 1) for pair in value.split(";") if pair.strip()]
            attributes |= {key.strip(): REFERENCE.sub(rf"url(#{prefix}\1)", text.strip()) for key, text in pairs}
        elif name == "id":
            attributes["id"] = prefix + value
        elif name == "href":
            attributes["href"] = "#" + prefix + value.removeprefix("#")
        else:
            attributes[name] = REFERENCE.sub(rf"url(#{prefix}\1)", value)
    made = Element(node.tag.removeprefix(SVG), attributes)
    made.extend(_plain(child, prefix) for child in node if child.tag.removeprefix(SVG) not in LEFT_OUT)
    return made


def document(title: str, style: str, script: str, *body: Element) -> str:
    """A whole page, which can run and load nothing but what is given here.

    Args:
      style: CSS.
      script: JavaScript; it and the CSS are taken as they are.
    """
    policy = {
        "default-src": "'none'",
        "style-src": f"'{_hash(style)}'",
        "script-src": f"'{_hash(script)}'",
        "img-src": "data:",  # the empty icon
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content="; ".join(map(" ".join, policy.items()))),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("link", rel="icon", href="data:,"),  # else a server is asked for one
        element("title", title),
        _verbatim("style", style),
    )
    page = element("html", head, element("body", *body, _verbatim("script", script)), lang="en")
    return f"<!DOCTYPE html>\n{ET.tostring(page, encoding='unicode', method='html')}\n"


def _verbatim(tag: str, content: str) -> Element:
    if f"</{tag}" in content.lower():
        raise ValueError(f"a {tag} that ends itself")
    made = Element(tag)
    made.text = content
    return made


def _hash(content: str) -> str:
    """As a Content-Security-Policy names a style or a script."""
    return f"sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}"
