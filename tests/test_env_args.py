"""Arguments of environments as text."""

import pytest

from sqt_jax.envs.env_args import parse


@pytest.mark.parametrize(
    ("text", "arguments"),
    [
        ("", {}),
        ("continuous=true,gravity=-9.8", {"continuous": True, "gravity": -9.8}),
        ("n=3", {"n": 3}),
        ("size=[1,2],name=a b", {"size": [1, 2], "name": "a b"}),
        ('options={"a":1,"b":[2]},x=1', {"options": {"a": 1, "b": [2]}, "x": 1}),
        ("flag=False,none=None,also=null", {"flag": False, "none": None, "also": None}),
        ("path=/a=b,text=1,2", {"path": "/a=b", "text": "1,2"}),
        ("number=NaN,empty=", {"number": "NaN", "empty": ""}),
        ("a.b_1.c=1,d.e=[2,3]", {"a.b_1.c": 1, "d.e": [2, 3]}),
    ],
)
def test_arguments(text, arguments):
    assert parse(text) == arguments


@pytest.mark.parametrize(
    "text", ["continuous", "=1", "1a=2", "a b=1", "a=\n", "a=" + 3000 * "x", ",", "a..b=1", ".a=1", "a.=1", "a.1=1"]
)
def test_other_text(text):
    with pytest.raises(ValueError, match="expects NAME=VALUE,..."):
        parse(text)


def test_an_argument_twice():
    with pytest.raises(ValueError, match="expects each argument once, not a twice"):
        parse("a=1,a=2")
