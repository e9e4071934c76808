"""`~` in paths."""

import pytest

from experiments.surroundings.paths import expanded


def test_a_home_folder_is_expanded(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert expanded("~") == str(tmp_path)
    assert expanded("~/runs/a") == f"{tmp_path}/runs/a"
    for text in ("runs", "./~", "a/~/b", ""):
        assert expanded(text) == text


@pytest.mark.parametrize("text", ["~nobody_here/a", "~nobody_here", "~\0/a"])
def test_a_home_folder_that_does_not_exist_is_an_error(text):
    with pytest.raises(ValueError):
        expanded(text)


def test_a_home_that_is_no_folder_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path / "none"))
    with pytest.raises(ValueError, match="expects a folder that exists for ~; ./~/runs names a folder called ~"):
        expanded("~/runs")
