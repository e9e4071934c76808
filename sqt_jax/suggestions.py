"""Messages for an unknown name: the known names, and "did you mean ...?"."""

import difflib
from collections.abc import Iterable


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """ "; did you mean X?" if a known name is similar, else "": to be appended to a message."""
    match = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {match[0]}?" if match else ""


def expects_one_of(name: object, known: Iterable[str]) -> str:
    """ "expects one of A, B, C, not 'D'", and `did_you_mean`."""
    known = list(known)
    return f"expects one of {', '.join(known)}, not {name!r}{did_you_mean(name, known)}"
