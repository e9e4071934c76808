"""HTML elements, inline figures and complete pages; no text becomes markup."""

import base64
import hashlib
import re

import pytest
from html_reader import Reader
from matplotlib.figure import Figure

from experiments.evidence.figures import image
from experiments.evidence.markup import document, element, inline_svg

pytestmark = pytest.mark.filterwarnings("ignore:Glyph 1 ")  # a control character in a figure

HOSTILE = "<script>alert(1)</script> \"'& --> ]]>"


def ids(svg):
    return [node.attrib["id"] for node in svg.iter() if "id" in node.attrib]


@pytest.fixture
def figure():
    made = Figure(layout="constrained")
    axes = made.subplots()
    axes.plot([0, 1], [1, 2], "--", marker="o", label=HOSTILE + "\x01")
    axes.fill_between([0, 1], [1, 2], [2, 3], alpha=0.2)
    axes.legend()
    return made


def test_text_and_attributes_are_never_markup():
    made = document("t", "", "", element("p", HOSTILE, element("b", "x"), HOSTILE, aria_label=HOSTILE, class_="a"))
    read = Reader(made)
    assert read.tags.count("script") == 1 and read.tags.count("p") == 1
    assert ("aria-label", HOSTILE) in read.attributes and ("class", "a") in read.attributes
    assert "".join(read.texts).count(HOSTILE) == 2


def test_an_element():
    made = element("p", "a", "b", element("b", "c"), "d", "e", title=None, class_="", data_sort="1")
    assert (made.text, made[0].tail) == ("ab", "de")
    assert made.attrib == {"class": "", "data-sort": "1"}
    assert element("p", "a\n\tb\x00\ud800\u202e").text == "a\n\tb\\x00\\ud800\\u202e"


def test_figures_on_a_page_share_no_id_and_keep_their_references(figure):
    content = image(figure, "svg")
    one, two = inline_svg(content, "figure-1-", "a"), inline_svg(content, "figure-2-", "b")
    assert len(ids(one)) > 10 and len({*ids(one), *ids(two)}) == 2 * len(ids(one))
    values = [(name, value) for node in one.iter() for name, value in node.attrib.items()]
    glyphs = {value.removeprefix("#") for name, value in values if name == "href"}
    clips = {found for _, value in values for found in re.findall(r"url\(#(.+?)\)", value)}
    assert glyphs and clips and glyphs | clips <= {*ids(one)}
    assert one.attrib["aria-labelledby"] == "a" and one.attrib["viewBox"]


def test_a_figure_needs_no_inline_style(figure):
    svg = inline_svg(image(figure, "svg"), "x-", "a")
    assert {node.tag for node in svg.iter()} <= {"svg", "g", "path", "use", "defs", "clipPath", "rect"}
    assert not any("style" in node.attrib for node in svg.iter())
    assert any(node.attrib.get("stroke-dasharray") for node in svg.iter())
    assert any(node.attrib.get("fill-opacity") == "0.2" for node in svg.iter())


def test_a_page_allows_only_its_own_style_and_script():
    style, script = "p > b { color: red }", 'if (1 < 2 && "é") { }'
    text = document("a & b", style, script, element("p", "x"))
    assert text.startswith("<!DOCTYPE html>\n<html") and f"<style>{style}</style>" in text
    assert f"<script>{script}</script>" in text and "<title>a &amp; b</title>" in text
    policy = re.search(r'Policy" content="([^"]+)"', text)[1]

    def hashed(content):
        return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"

    assert policy.split("; ")[:3] == [
        "default-src 'none'",
        f"style-src {hashed(style)}",
        f"script-src {hashed(script)}",
    ]
    assert "unsafe" not in policy


def test_a_script_with_its_closing_tag_is_rejected():
    with pytest.raises(ValueError, match="the script contains its closing tag"):
        document("t", "", "'</SCRIPT>'")
