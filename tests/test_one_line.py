"""Exceptions as one line."""

from sqt_jax.one_line import one_line


class Speechless(Exception):
    """Has no text: `str` fails."""

    def __str__(self):
        raise ValueError("no text")


def test_type_and_message():
    assert one_line(ValueError("two\n  lines")) == "ValueError: two lines"
    assert one_line(KeyboardInterrupt()) == "KeyboardInterrupt"
    assert one_line(ValueError(9 * "long "), limit=15) == "ValueError: lon"


def test_an_error_whose_own_text_fails_is_named():
    assert one_line(Speechless()) == "Speechless"
