"""HTML as a tree of elements, and figures as elements of it.

Texts from the files of runs are not trusted: they become text nodes or attribute values only, never markup.
"""

import base64
import hashlib
import re
import xml.etree.ElementTree as ET
from xml.etree.ElementTree import Element

from experiments.commandline.arguments import printable

SVG = "{http://www.w3.org/2000/svg}"
# Elements of matplotlib's SVG that a page does not need.
LEFT_OUT = {"metadata", "style"}
REFERENCE = re.compile(r"url\(#([^)]+)\)")


def element(tag: str, *children: str | Element, **attributes: str | None) -> Element:
    """An element with texts and elements as children.

    `aria_label="x"` is the attribute `aria-label`, `class_="x"` is `class`; an attribute that is None is left out.
    Unprintable characters are shown as escapes, except line breaks and tabs.
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
    """An SVG file of matplotlib as an element of a page.

    Ids get a prefix, because several figures share a page. Styles become attributes with the same meaning, because the
    page forbids inline styles.

    Args:
      prefix: of the ids, different for each figure.
      described_by: the id of the element that describes the figure.
    """
    # Comments repeat the figure's texts, which may contain characters that XML does not allow.
    root = ET.fromstring(re.sub(rb"<!--.*?-->", b"", content, flags=re.DOTALL))
    svg = _plain(root, prefix)
    # The rules of matplotlib's style sheet for all elements.
    svg.attrib |= {"stroke-linejoin": "round", "stroke-linecap": "butt", "role": "img", "aria-labelledby": described_by}
    return svg


def _plain(node: Element, prefix: str) -> Element:
    """The element without namespaces, as HTML expects it, and with attributes instead of styles."""
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
    """A complete page that can run and load only the given style and script.

    Args:
      style: CSS, inserted verbatim.
      script: JavaScript, inserted verbatim.

    Raises:
      ValueError: the style or the script contains its own closing tag.
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
        element("link", rel="icon", href="data:,"),  # otherwise browsers request one from a server
        element("title", title),
        _verbatim("style", style),
    )
    page = element("html", head, element("body", *body, _verbatim("script", script)), lang="en")
    return f"<!DOCTYPE html>\n{ET.tostring(page, encoding='unicode', method='html')}\n"


def _verbatim(tag: str, content: str) -> Element:
    if f"</{tag}" in content.lower():
        raise ValueError(f"the {tag} contains its closing tag")
    made = Element(tag)
    made.text = content
    return made


def _hash(content: str) -> str:
    """The name of a style or a script in a Content-Security-Policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}"
