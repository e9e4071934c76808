"""The format of a film is its file's ending."""

from pathlib import Path

import pytest

from experiments.playing.film_formats import format_of


@pytest.mark.parametrize(("name", "expected"), [("film.mp4", "mp4"), ("a/FILM.GIF", "gif"), ("film.x.html", "html")])
def test_endings(name, expected):
    assert format_of(Path(name)) == expected


@pytest.mark.parametrize("name", ["film", "film.avi", ".mp4", "film.mp4.txt", ""])
def test_other_endings_are_rejected(name):
    with pytest.raises(ValueError, match="expects a file with the ending .mp4, .gif, .html"):
        format_of(Path(name))
