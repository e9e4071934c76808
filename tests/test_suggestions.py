"""Messages for unknown names."""

import pytest

from sqt_jax.suggestions import did_you_mean, expects_one_of


@pytest.mark.parametrize(
    ("name", "hint"),
    [("humanoit", "; did you mean humanoid?"), ("anz", "; did you mean ant?"), ("xyz", ""), ("", ""), (7, "")],
)
def test_the_nearest_name_is_suggested_if_it_is_similar(name, hint):
    assert did_you_mean(name, iter(["ant", "humanoid"])) == hint


def test_the_message_lists_the_known_names_in_their_order():
    message = "expects one of mjx, mujoco, not 'mjxx'; did you mean mjx?"
    assert expects_one_of("mjxx", iter(["mjx", "mujoco"])) == message
    assert expects_one_of(None, ["mjx"]) == "expects one of mjx, not None"
