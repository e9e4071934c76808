"""What is said of a name that a table does not have."""

import difflib
from collections.abc import Iterable


def nearest(name: object, known: Iterable[str]) -> str:
    """'; did you mean X?' where a known name is similar, else nothing."""
    match = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {match[0]}?" if match else ""


def unknown(name: object, known: Iterable[str]) -> str:
    """All the known names, and the nearest one."""
    known = list(known)
    return f"expects one of {', '.join(known)}, not {name!r}{nearest(name, known)}"
